"""`playground eval <run>`: evaluates a trained policy on this machine."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import mujoco
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from playground.cli.header import of_events_that_are_off
from playground.envs.base import Env
from playground.envs.locomotion.gait_metrics import with_gait_metrics
from playground.files import unwritable, write_json
from playground.learning.checkpoints import of_a_better_one
from playground.learning.evaluation import Recording, make_evaluator
from playground.paper import paper_table
from playground.rendering.video import need_camera, need_place, render_video
from playground.rendering.visuals import drawn_model
from playground.runs.callbacks import episodes_of
from playground.runs.loaded_policy import load_policy
from playground.runs.train import model_sampler
from playground.text import suffix


def evaluate_run(
  path: str,
  overrides: Sequence[str] = (),
  *,
  episodes: int | None = None,
  seed: int = 0,
  deterministic: bool = False,
  video: str | None = None,
  camera: str | None = None,
) -> int:
  """Evaluates a run's newest checkpoint, or the one at `path`, prints the scores and writes them beside the run.

  Args:
    path: a run directory, or one of its checkpoints.
    overrides: of the task, such as `env.episode_length=500`.
    episodes: number of episodes; None is the run's `agent.num_eval_envs`.
    seed: of the episodes.
    deterministic: True acts on the distribution's mode, False as the run's `agent.deterministic_eval` says.
    video: the .mp4 to render the first episode to.
    camera: of the video, see `render_video`; None is the run's `video.camera`.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such run or checkpoint, or one that does not fit, an invalid override, or no such camera.
  """
  film = need_place(video, camera)
  trained = load_policy(path, overrides)
  run, env, checkpoint, hardware = trained.config, trained.env, trained.checkpoint, trained.hardware
  count = run.agent.num_eval_envs if episodes is None else episodes
  drawn = drawn_model(env, run.video.visuals)
  need_camera(drawn, camera, "--camera")
  _, model = model_sampler(env, run, 1, count)(run.seed)
  for sentence in (*of_a_better_one(path, checkpoint), *of_events_that_are_off(env.config, overrides)):
    print(sentence)
  deterministic = deterministic or run.agent.deterministic_eval
  act = lambda policy, obs, key: trained.trainer.act(policy, obs, key, deterministic)
  evaluate = make_evaluator(with_gait_metrics(env), act, count, hardware.mesh, 1 if film else 0)
  scores, recording = evaluate(trained.policy, jax.random.PRNGKey(seed), model, {})
  scores = {name: float(value) for name, value in jax.device_get(scores).items()}

  title = f"{trained.task}, {count} episodes, {checkpoint.step:,} steps trained{described(overrides)}"
  real = [row for row in paper_table("hardware") if row["task"] == trained.task]
  Console().print(_table(title, {name.removeprefix("episode_"): value for name, value in scores.items()}, real))
  for row in real:
    median = f"median {row['median']}, " if row["median"] else ""
    print(f"hardware, {row['metric']}: {row['what']}; {median}{row['trials']} trials (paper, {row['where']})")
    print(f"simulation, {row['metric']}: by default {row['simulation']}")
  report = {"checkpoint": str(checkpoint.path), "episodes": count, "seed": seed, "deterministic": deterministic}
  report |= {"overrides": list(overrides)} if overrides else {}
  report |= {"scores": scores} | hardware.machine
  report |= {"hardware_in_paper": real} if real else {}
  settings = "_deterministic" * deterministic + suffix(overrides)
  name = f"step_{checkpoint.step:012d}_seed_{seed}_episodes_{count}{settings}.json"
  save(trained.run_dir.path / "eval" / name, report, trained.run_dir.path)
  if film:
    render(film, drawn, env, camera or run.video.camera, recording)
  return 0


def described(overrides: Sequence[str]) -> str:
  """Returns the end of a title that names overrides, "" without any."""
  return f", with {' '.join(overrides)}" if overrides else ""


def save(out: Path, report: Mapping[str, object], run: Path | None = None) -> None:
  """Writes a report into a folder, of `run` if given, and says where, or why it cannot."""
  if (reason := unwritable(out.parent, run)) is None:
    out.parent.mkdir(exist_ok=True)
    write_json(out, report)
  print(f"not written: {reason}" if reason else f"written to {out}")


def render(film: Path, model: mujoco.MjModel, env: Env, camera: str | None, recording: Recording) -> None:
  """Renders a recording's first episode into `film`, or says why it cannot."""
  print(f"rendering {film}", flush=True)
  episode = episodes_of(recording, 1)
  render_video(model, out_path=film, dt=env.dt * env.action_repeat, camera=camera, notify=print, **episode)


def _table(title: str, scores: Mapping[str, float], real: Sequence[Mapping[str, str]]) -> Table:
  """Builds a table of scores, beside the paper's on real robots where benchmarks/paper/hardware.csv has them."""
  table = Table(title=escape(title))
  table.add_column("per episode")
  table.add_column("simulation, mean" if real else "mean", justify="right")
  if real:
    table.add_column("hardware, mean (paper)", justify="right")
  on_hardware = {row["metric"]: f"{row['mean']} ± {row['ci95']}".removesuffix(" ± ") for row in real}
  for name, value in scores.items():
    table.add_row(name, f"{value:.4g}", *([on_hardware.get(name, "")] if real else []))
  return table
