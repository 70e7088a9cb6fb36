"""Measures policies in C MuJoCo, and keeps the scores beside their runs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import jax

from playground.deploy.policy import ActingPolicy
from playground.deploy.trained import export_policy, load_exact
from playground.envs.base import Env
from playground.envs.locomotion.gait_metrics import with_gait_metrics
from playground.envs.wrappers import ModelFields
from playground.errors import ConfigError
from playground.files import need_folder, read_json, write_json
from playground.hardware.mesh import make_mesh
from playground.learning.evaluation import make_evaluator
from playground.pytree import PyTree
from playground.text import suffix


def measure(
  exported: ActingPolicy,
  env: Env,
  episodes: int,
  seed: int = 0,
  recorded: int = 0,
  models: ModelFields = MappingProxyType({}),
) -> tuple[dict[str, float], PyTree]:
  """Plays episodes in C MuJoCo, on randomised `models` if given.

  Returns their mean scores by name, and the states of the first `recorded` episodes.
  """
  evaluate = make_evaluator(with_gait_metrics(env), exported.act, episodes, make_mesh(1), recorded)
  scores, recording = evaluate({}, jax.random.PRNGKey(seed), dict(models), {})
  return {name: float(value) for name, value in jax.device_get(scores).items()}, recording


def result_of(
  exported: ActingPolicy,
  scores: Mapping[str, float],
  episodes: int,
  seed: int = 0,
  interval_events: bool = True,
  overrides: Sequence[str] = (),
  randomized: bool = False,
) -> dict[str, object]:
  """Returns the content of a result's file: how the policy was played, its scores and its origin."""
  played = {"simulator": "C MuJoCo", "episodes": episodes, "seed": seed, "interval_events": interval_events}
  played |= {"overrides": list(overrides)} if overrides else {}
  played |= {"randomized": True} if randomized else {}
  return played | {"scores": scores, "origin": exported.contract["origin"]}


def result_name(
  steps: int,
  seed: int,
  episodes: int,
  interval_events: bool = True,
  overrides: Sequence[str] = (),
  randomized: bool = False,
) -> str:
  """Returns the file name of a result; results of other settings have other names, so that none replaces another."""
  how = "" if interval_events else "_no_events"
  how += "_randomized" * randomized
  return f"play_step_{steps:012d}_seed_{seed}_episodes_{episodes}{how}{suffix(overrides)}.json"


def read_scores(result: Path) -> dict[str, float]:
  """Returns the scores in a result; raises ConfigError if it has none."""
  scores = read_json(result, scores=dict).get("scores")
  if not scores:
    raise ConfigError(f"{result} holds no scores: move it away, or see why `playground play` did not write it.")
  return scores


def newest_scores(run: Path, steps: int, episodes: int, interval_events: bool = True) -> dict[str, float]:
  """Returns the scores of a run's newest policy (seed 0), played now or, with the same settings, earlier.

  Args:
    run: a run directory.
    steps: of its newest checkpoint.
    episodes: number of episodes.
    interval_events: whether pushes and other interval events act.

  Raises:
    PlaygroundError: the policy cannot be played, or its result cannot be written or holds no scores.
  """
  result = run / "export" / result_name(steps, 0, episodes, interval_events)
  if not result.exists():
    need_folder(result.parent, str(result.parent), run)
    trained = load_exact(run, interval_events=interval_events)
    exported = export_policy(trained)
    scores, _ = measure(exported, trained.env, episodes)
    result.parent.mkdir(exist_ok=True)
    write_json(result, result_of(exported, scores, episodes, interval_events=interval_events))
  return read_scores(result)
