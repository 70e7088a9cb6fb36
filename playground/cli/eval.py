"""`playground eval <run>`: episodes of a trained policy, measured on this machine."""

from pathlib import Path

import jax
from rich.console import Console
from rich.table import Table

from playground import config as configs
from playground import registry
from playground.errors import ConfigError
from playground.hardware.setup import setup, this_machine
from playground.learning.algorithms import make_learner
from playground.learning.checkpoints import Checkpoint, find_checkpoints
from playground.learning.evaluation import make_evaluator
from playground.rendering.video import render_video
from playground.rendering.visuals import drawn_model
from playground.runs.files import write_json
from playground.runs.job import episodes_of
from playground.runs.run_dir import RunDirectory
from playground.runs.train import randomized_models


def evaluate_run(
  path: str,
  *,
  episodes: int | None = None,
  seed: int = 0,
  deterministic: bool = False,
  video: str | None = None,
  console: Console | None = None,
) -> int:
  """Evaluates a run's newest checkpoint, or the one given, prints the scores and writes them beside the run.

  Args:
    path: a run directory, or one of its checkpoints.
    episodes: how many; the run's `num_eval_envs` if None.
    seed: of the evaluation.
    deterministic: whether the policy acts with its mode instead of sampling (the run's own setting if False).
    video: where to render the first episode to (.mp4).
    console: for the output.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such run or checkpoint, or one that does not fit.
  """
  console = console or Console()
  checkpoint = Checkpoint(find_checkpoints(path)[0])
  run_dir = RunDirectory.open(checkpoint.path.parents[1])
  run = configs.from_dict(run_dir.config)
  hardware = setup(this_machine(run.hardware))
  count = run.agent.num_eval_envs if episodes is None else episodes
  if count < 1:
    raise ConfigError(f"--episodes={count} must be above 0.")
  env = registry.load(run.choices["env"], config=run.env)
  drawn = drawn_model(env, run.video.visuals)
  _, model = randomized_models(env, run, 1, count)
  learner = make_learner(env, run.agent, hardware.mesh, hardware.network_precision)
  policy = learner.place_policy(checkpoint.restore("policy", learner.policy_shape()))
  act = lambda policy, obs, key: learner.act(policy, obs, key, deterministic or None)
  evaluate = make_evaluator(env, act, count, hardware.mesh, 1 if video else 0)
  scores, recording = evaluate(policy, jax.random.PRNGKey(seed), model)
  scores = {name: float(value) for name, value in jax.device_get(scores).items()}

  table = Table(title=f"{run.choices['env']}, {count} episodes, {checkpoint.step:,} steps trained")
  table.add_column("per episode")
  table.add_column("mean", justify="right")
  for name, value in scores.items():
    table.add_row(name.removeprefix("episode_"), f"{value:.4g}")
  console.print(table)
  report = {"checkpoint": str(checkpoint.path), "episodes": count, "seed": seed, "scores": scores} | hardware.facts
  out = run_dir.path / "eval" / f"step_{checkpoint.step:012d}_seed_{seed}.json"
  out.parent.mkdir(exist_ok=True)
  write_json(out, report)
  console.print(f"written to {out}", soft_wrap=True)
  if video:
    tape = episodes_of(recording, 1)
    render_video(drawn, out_path=Path(video), dt=env.dt * env.action_repeat, notify=console.print, **tape)
  return 0
