"""Writes metrics, checkpoints and videos of one run, and its result at the end."""

import contextlib
import time
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import jax
import mujoco
import numpy as np

from playground.config import RunConfig
from playground.envs.base import Env
from playground.errors import PlaygroundError
from playground.learning.algorithm import Policy
from playground.learning.checkpoints import BEST, Checkpoint, CheckpointStore, checksum, find_checkpoints
from playground.learning.evaluation import Recording
from playground.learning.loop import Loop, Metrics
from playground.learning.population import PARENT
from playground.learning.rollout import Step
from playground.learning.trainer import Trainer, TrainState
from playground.pytree import PyTree
from playground.rendering.video import render_video
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN, read_metrics
from playground.runs.interrupts import Interrupts
from playground.runs.nonfinite import write_dump
from playground.runs.plots import plot_learning_curve
from playground.runs.progress import Progress
from playground.runs.provenance import process_age_s
from playground.runs.restore_plan import RestorePlan
from playground.runs.run_dir import RunDirectory
from playground.runs.top_ops import format_ops, write_top_ops
from playground.runs.trackers import make_trackers

MAX_WAITING = 3  # videos, each with its recording in memory


class NonfiniteError(PlaygroundError):
  """Too many environment steps were NaN, infinite or too large: the run stops."""


class RunCallbacks:
  """Implements the loop's callbacks for one run directory (`learning.loop.Callbacks`)."""

  def __init__(
    self,
    config: RunConfig,
    run_dir: RunDirectory,
    env: Env,
    trainer: Trainer,
    progress: Progress,
    interrupts: Interrupts,
    plan: RestorePlan,
    drawn: mujoco.MjModel,
  ):
    self._config = config
    self._run_dir = run_dir
    self._env = env
    self._drawn = drawn
    self._trainer = trainer
    self._progress = progress
    self._interrupts = interrupts
    # A run that is resumed from the beginning logs all its rows again: step 0 is after "step -1".
    continued = -1 if plan.run_dir and plan.step is None else plan.step
    self._trackers = make_trackers(config.resolved, run_dir, continued, progress.print, plan.columns)
    self._store = CheckpointStore(run_dir.checkpoints, config.checkpoint.keep, continued)
    self._videos = ThreadPoolExecutor(1, thread_name_prefix="video")
    self._rendering: list[Future[Path | None]] = []  # the oldest is under way
    self._filmed: int | None = None  # step of the newest video
    self._earlier_s = plan.wall_clock_s
    self._began = time.perf_counter()
    self._trained_s = 0.0  # the run's time when training ended
    self._process_began_s = plan.began_s
    # Over all starts of the run.
    self._evaluations = int(read_metrics(run_dir.metrics_csv).filter([RETURN]).count().sum()) if plan.step else 0
    self._step = plan.step or 0
    self._return: float | None = None  # of the newest row
    self._copied = False  # whether another agent's policy has replaced this one since that row
    self._recording: Recording | None = None
    self._rates: list[float] = []  # steps per second, by row
    self._rejected = 0  # gradient steps
    self._dumped = any(run_dir.nan_dump.glob("*.npz"))  # by an earlier start of this run
    self._warned_of_buffers = False
    self._closed = False
    self._profile = run_dir.path / "profile"
    self._trace = "due" if config.profile.enable else "off"  # then "on", for one row, then "off"

  @property
  def wall_clock_s(self) -> float:
    """Returns the run's time over all its starts, without compilation, s."""
    return self._earlier_s + time.perf_counter() - self._began

  def on_metrics(self, step: int, metrics: Metrics, captured: Step | None, recording: Recording | None) -> None:
    self._store.check()
    score = metrics.get(RETURN)
    # The policy before training is evaluated after the first training steps: without them its row has that time alone.
    seconds = self.wall_clock_s if step else metrics["time/eval_s"]
    self._trackers.log(step, metrics | {"time/wall_clock_s": seconds})
    self._progress.update(step, metrics.get("time/steps_per_second"), score)
    taken = step - self._step
    if (rate := metrics.get("time/steps_per_second")) is not None:
      self._rates.append(rate)
    self._step, self._return, self._recording = step, score, recording
    self._copied = PARENT in metrics
    if score is not None:
      self._evaluations += 1
      every = self._config.video.every_evals
      if recording is not None and every and self._evaluations % every == 0:
        self._start_video(step, recording)
    self._advance_trace(metrics)
    self._check_buffers(taken, metrics)
    self._check_numbers(step, taken, metrics, captured)
    self._rejected += check_updates(metrics, self._config.on_nonfinite.max_fraction, step)

  def on_save(self, update: int, step: int, state: TrainState) -> None:
    policy, rest = self._trainer.split(state)
    meta = {
      "update": update,
      "env": self._config.choices["env"],
      "wall_clock_s": self.wall_clock_s,
      "config": self._config.resolved,
      "columns": self._trackers.columns,
      "settings": {key: np.asarray(value).tolist() for key, value in state.settings.items()},
    }
    experience = self._trainer.experience(state)
    self._store.save(step, policy, rest, meta, experience, None if self._copied else self._return)

  def should_stop(self) -> bool:
    return self._interrupts.signum is not None

  def end_training(self) -> None:
    """Waits for pending checkpoints, takes the run's time and starts the last video, for which `finish` waits."""
    self._progress.phase("saving")
    self._store.wait()
    self._trained_s = self.wall_clock_s
    wanted = self._config.video.enable and self._config.video.at_end and not self.should_stop()
    if not wanted or self._filmed == self._step:
      return
    if self._recording is not None:
      self._start_video(self._step, self._recording, at_end=True)
    elif not self._video_at(self._step).exists():  # killed after the last evaluation, resumed without one
      command = f"`playground play {self._run_dir.path} --video <file>.mp4`"
      self._progress.print(f"No video of the last evaluation: {command} films an episode.")

  def finish(self, loop: Loop, policy: Policy, completed: bool) -> None:
    """Waits for the video, and writes the run's result with the last policy; call `end_training` first."""
    for video in self._rendering:
      self._progress.phase("rendering the video")
      if self.should_stop():
        self._videos.shutdown(wait=False, cancel_futures=True)
      if not video.cancelled():
        video.result()
    plot_learning_curve(self._run_dir.metrics_csv, self._run_dir.plots)
    self.close("finished" if completed else "preempted")
    if self._rejected:
      self._progress.print(
        f"{self._rejected:,} gradient steps were NaN or infinite and left out (training/nonfinite_updates)."
      )
    if self._config.profile.enable and self._profile.is_dir():  # a run of one row has traced nothing
      for line in format_ops(write_top_ops(self._profile)):
        self._progress.print(line)
    timings = {
      "start_to_first_update_s": self._from_start(loop.first_update_at),
      "first_update_s": loop.first_update_s,
      "train_s": loop.train_s,
      "steady_steps_per_second": float(np.median(self._rates)) if self._rates else None,
    }
    self._run_dir.update_manifest(timings=timings)
    self._run_dir.write_summary(
      {
        "status": "finished" if completed else "preempted",
        "env": self._config.choices["env"],
        **self._scores(),
        "wall_clock_s": self._trained_s,
        "params_sha256": checksum([np.asarray(x) for x in jax.device_get(jax.tree.leaves(policy))]),
      }
    )

  def close(self, status: str = "failed") -> None:
    """Ends what is being written, and videos and trackers, once; the default status is that of a run that failed."""
    if not self._closed:
      self._closed = True
      with contextlib.ExitStack() as closing:  # all of them, from the last to the first, whatever one raises
        closing.callback(self._trackers.close, status)
        closing.callback(self._videos.shutdown, cancel_futures=True)
        closing.callback(self._store.close)
        if self._trace == "on":  # the run ended while it was traced
          jax.profiler.stop_trace()

  def _scores(self) -> dict[str, float | None]:
    """Returns the result from metrics.csv, which covers all starts of the run, and the best checkpoint."""
    table = read_metrics(self._run_dir.metrics_csv)
    column = lambda name: np.asarray(table[name] if name in table else np.full(len(table), np.nan), float)
    steps, returns, rate = (column(name) for name in ("step", RETURN, "time/steps_per_second"))
    last = lambda name: next((value for value in column(name)[::-1].tolist() if np.isfinite(value)), None)
    acts_by_mode = self._trainer.config.deterministic_eval or not self._trainer.algorithm.samples
    chosen = "mode" if acts_by_mode else "sampled"
    best = self._run_dir.checkpoints / BEST
    if best.is_dir():  # the policy itself: metrics.csv may have lost its row, or have one of a checkpoint that is gone
      checkpoint = Checkpoint(find_checkpoints(best)[0])
      best_return, best_step = checkpoint.meta["return"], checkpoint.step
    else:  # a file system without links; the last of equal returns, and none of the untrained policy
      own = np.isfinite(returns) & ~np.isfinite(column(PARENT)) & (steps > 0)
      scores = [(float(value), int(step)) for value, step in zip(returns[own], steps[own], strict=True)]
      best_return, best_step = max(scores, default=(None, None))
    trained = np.isfinite(rate)
    taken = np.diff(steps, prepend=0)[trained]
    seconds = float((taken / rate[trained]).sum())
    return {
      "final_return": last(RETURN),
      "final_sampled_return": last(RETURN if chosen == "sampled" else OTHER_RETURNS["sampled"]),
      "final_mode_return": last(RETURN if chosen == "mode" else OTHER_RETURNS["mode"]),
      "best_return": best_return,
      "best_step": best_step,
      "steps": self._step,
      "steps_per_second": float(taken.sum()) / seconds if seconds else None,
    }

  def _from_start(self, at: float | None) -> float | None:
    """Returns the seconds from the start of the process or stage to a time of `time.perf_counter`."""
    return None if at is None else process_age_s() - self._process_began_s - (time.perf_counter() - at)

  def _video_at(self, step: int) -> Path:
    return self._run_dir.videos / f"step_{step:012d}.mp4"

  def _start_video(self, step: int, recording: Recording, at_end: bool = False) -> None:
    """Renders the first recorded episodes in a child process while training continues.

    Where rendering takes longer than the time between evaluations, it leaves out videos, but not the one `at_end`.
    """
    view = self._config.video
    self._rendering = [video for video in self._rendering if not video.done()]
    if len(self._rendering) > MAX_WAITING and not at_end:
      self._progress.print(f"No video after {step:,} steps: {MAX_WAITING} others wait to be rendered.")
      return
    self._filmed = step
    self._rendering.append(
      self._videos.submit(
        render_video,
        self._drawn,
        out_path=self._video_at(step),
        dt=self._env.dt * self._env.action_repeat,
        camera=view.camera,
        width=view.width,
        height=view.height,
        notify=self._progress.print,
        **episodes_of(recording, view.episodes),
      )
    )

  def _advance_trace(self, metrics: Metrics) -> None:
    """Traces training between the first two trained rows, with `profile.enable`."""
    if self._trace == "on":
      jax.profiler.stop_trace()
      self._trace = "off"
    elif self._trace == "due" and "time/steps_per_second" in metrics:
      jax.profiler.start_trace(str(self._profile))
      self._trace = "on"
      self._progress.print(f"tracing into {self._profile}")

  def _check_buffers(self, taken: int, metrics: Metrics) -> None:
    """Warns once if Warp's buffers are too small for the task."""
    overflows = metrics.get("training/overflows", 0.0)
    if overflows and not self._warned_of_buffers:
      self._warned_of_buffers = True
      tune = f"playground tune-buffers {self._config.choices['env']} --run {self._run_dir.path}"
      self._progress.print(
        f"{overflows:.0f} of {taken // self._env.action_repeat:,} actions needed more than Warp's buffers hold, and "
        f"lost contacts or constraints: `{tune}` measures the sizes that env.njmax and its "
        "companions need, once there is a checkpoint."
      )

  def _check_numbers(self, step: int, taken: int, metrics: Metrics, captured: Step | None) -> None:
    """Dumps the first non-finite step, and stops the run if too many steps are non-finite."""
    bad = metrics.get("training/nonfinite", 0.0) * self._env.action_repeat
    if not bad:
      return
    where = ""
    if not self._dumped:
      self._dumped = True
      dump = write_dump(self._run_dir.nan_dump, step, captured, self._config.resolved)
      where = f" The first is in {dump}: replay it with `playground replay {dump}`." if dump else ""
      self._progress.print(f"{bad:.0f} of {taken:,} steps before step {step:,} went NaN, infinite or too large.{where}")
    check_fraction(bad / max(taken, 1), self._config.on_nonfinite.max_fraction, step, where)


class NonMainCallbacks:
  """Implements the loop's callbacks (`learning.loop.Callbacks`) in processes other than 0, which write nothing."""

  def __init__(self, config: RunConfig, env: Env, interrupts: Interrupts, step: int | None):
    self._allowed = config.on_nonfinite.max_fraction
    self._action_repeat = env.action_repeat
    self._interrupts = interrupts
    self._step = step or 0

  def on_metrics(self, step: int, metrics: Metrics, captured: Step | None, recording: Recording | None) -> None:
    taken, self._step = step - self._step, step
    bad = metrics.get("training/nonfinite", 0.0)
    check_fraction(bad * self._action_repeat / max(taken, 1), self._allowed, step)
    check_updates(metrics, self._allowed, step)

  def on_save(self, update: int, step: int, state: TrainState) -> None:
    """Does nothing: process 0 saves."""

  def should_stop(self) -> bool:
    return self._interrupts.signum is not None


def check_fraction(fraction: float, allowed: float, step: int, where: str = "") -> None:
  """Raises NonfiniteError if the fraction of non-finite environment steps before `step` is above `allowed`."""
  if fraction > allowed:
    raise NonfiniteError(
      f"{fraction:.1%} of the environment steps before step {step:,} went NaN, infinite or too large, more than "
      f"on_nonfinite.max_fraction={allowed:g}.{where}"
    )


def check_updates(metrics: Metrics, allowed: float, step: int) -> int:
  """Counts a row's gradient steps that were skipped because they were not finite.

  Raises:
    NonfiniteError: the fraction of skipped gradient steps is above `allowed`.
  """
  bad, taken = (round(metrics.get(f"training/{name}", 0.0)) for name in ("nonfinite_updates", "gradient_steps"))
  if bad > allowed * taken:
    raise NonfiniteError(
      f"{bad:,} of {taken:,} gradient steps before step {step:,} were NaN or infinite and left out, more than "
      f"on_nonfinite.max_fraction={allowed:g} allows: training has diverged. A lower agent.learning_rate, or for PPO "
      "agent.max_grad_norm=1, may prevent it; what was saved stays."
    )
  return bad


def episodes_of(recording: Recording, count: int) -> dict[str, PyTree]:
  """Returns the first `count` recorded episodes, concatenated: `qpos` [T, nq] and mocap poses."""
  arrays = {name: np.asarray(value) for name, value in recording.items()}
  active = arrays.pop("active")[:, :count] > 0
  columns, rows = np.nonzero(active.T)
  return {name: value[rows, columns] for name, value in arrays.items() if value.size}
