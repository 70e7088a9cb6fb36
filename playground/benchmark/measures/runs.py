"""Measures whole commands: `playground-run` to its first update or its end, and curricula stage by stage."""

import hashlib
import itertools
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import pandas as pd

from playground.benchmark.measures.machine import machine_of
from playground.benchmark.measures.subject import alone
from playground.benchmark.schema import commit_of
from playground.benchmark.worker import Rows
from playground.config import RunConfig, compose
from playground.errors import PlaygroundError, nearest
from playground.interpreter import PYTHON
from playground.runs.csv_tracker import OTHER_RETURNS, RETURN
from playground.runs.run_dir import RunDirectory

_SPEED = ("steps", "command_s", "wall_clock_s", "training_steps_per_s")
RESULT = (*_SPEED, "best_return", "final_mode_return", "final_return")
_UNITS = {"steps": "steps", "command_s": "s", "wall_clock_s": "s", "training_steps_per_s": "steps/s"}
_TIME = "time/wall_clock_s"
_CACHES = ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH")  # environment variables that replace the run's own caches


class RunFailedError(PlaygroundError):
  """The command ended with an error."""


def startup(rows: Rows, task: str, agent: str, overrides: list[str], seconds: float) -> None:
  """Emits rows `cold` and `warm`: the same command twice in new processes, up to the first update that learns.

  Evaluation is compiled, too. The evaluation before training runs after the first training call, as in any run.
  """
  del seconds  # measures one run unchanged
  chosen = [f"env={task}", f"agent={agent}", *overrides]
  with tempfile.TemporaryDirectory() as folder:
    short = [f"agent.num_timesteps={_one_update(compose(chosen))}", "agent.num_evals=2", "agent.num_resets_per_eval=0"]
    short += ["video.enable=false", "tracking=csv", f"hardware.cache_dir={folder}/cache"]
    for name in ("cold", "warm"):
      run = Path(folder) / name
      run_training([*chosen, *short, f"run_dir={run}"], without=_CACHES)
      manifest = RunDirectory(run).manifest
      rows.update(columns_of(manifest), conditions="whole command, evaluation compiled, one update, a cache of its own")
      for quantity in ("trace_s", "compile_s", "start_to_first_update_s"):
        rows.emit(quantity, manifest["timings"][quantity], "s", setting=" ".join((*overrides, name)))


def whole(rows: Rows, task: str, agent: str, overrides: list[str], setting: list[str], seeds: list[int]) -> None:
  """Emits a row for each evaluation, `step=<steps trained>`, then the rows of the whole run, the final return last.

  The run locks the device from its start, compilation included, to its end. An evaluation's row adds its step to
  `setting`.
  """
  (seed,) = seeds
  with tempfile.TemporaryDirectory() as folder:
    run = RunDirectory(Path(folder) / "run")
    chosen = [f"env={task}", f"agent={agent}", *overrides, f"seed={seed}"]
    with alone(rows.lock):
      begin = time.perf_counter()
      run_training([*chosen, "video.enable=false", "tracking=csv", f"run_dir={run.path}"])
      taken = time.perf_counter() - begin
    rows.update(columns_of(run.manifest), conditions="a whole run, evaluations and saving in its time, compiling not")
    evaluations = pd.read_csv(run.metrics_csv).dropna(subset=[RETURN])
    emit_returns(rows, evaluations[["step", RETURN, _TIME]].itertuples(index=False), setting, seed)
    if run.summary.get("final_mode_return") is not None:
      mode = OTHER_RETURNS["mode"] if OTHER_RETURNS["mode"] in evaluations else RETURN
      emit_returns(rows, evaluations[["step", mode, _TIME]].itertuples(index=False), setting, seed, "mode_return")
    rate = run.manifest["timings"]["steady_steps_per_second"]
    result = {**run.summary, "command_s": taken, "training_steps_per_s": rate}
    emit_result(rows, result, RESULT, seed=seed)


def chain(
  rows: Rows, experiment: str, overrides: list[str], runs: str, again: bool, devices: int, seeds: list[int]
) -> None:
  """Emits rows for each stage of a curriculum, `stage=<name>`, and for the whole, `stage=all`.

  An unfinished run of the same experiment, overrides, number of devices and seed is resumed; its times are sums over
  its starts. The rows of stages that were finished before have the commit, device and versions of their manifest, as
  another machine may have trained them; `again` starts a new run instead.
  """
  (seed,) = seeds
  run = _chain_run(Path(runs).expanduser(), experiment, overrides, devices, seed, again)
  finished = {path.name for path in run.path.glob("*/") if _finished(RunDirectory(path))}
  if not _finished(run):
    begun = run.config_path.is_file()
    new = [f"experiment={experiment}", f"seed={seed}", "video.enable=false", *overrides, f"run_dir={run.path}"]
    run_training([f"resume={run.path}"] if begun else new)
  stages = run.summary["stages"]
  for stage in [*stages, {**run.summary, "name": "all", "folder": stages[-1]["folder"]}]:
    manifest = RunDirectory(run.path / stage["folder"]).manifest  # a chain itself has none
    columns: dict[str, object] = {"seed": seed, "setting": " ".join((*overrides, f"stage={stage['name']}"))}
    columns |= columns_of(manifest) | (machine_of(manifest) if stage["folder"] in finished else {})
    if git := manifest.get("git"):
      columns["commit"] = commit_of(git)
    columns["conditions"] = f"task {stage['env']}, evaluations included, compiling not"
    emit_result(rows, stage, ("steps", "final_return", "wall_clock_s"), **columns)


def golden(rows: Rows, overrides: list[str], metrics: list[str], settings: list[str]) -> None:
  """Emits a row for each metric of a run: the last value of its column of metrics.csv, with its `setting`."""
  with tempfile.TemporaryDirectory() as folder:
    run = RunDirectory(Path(folder) / "run")
    run_training([*overrides, "video.enable=false", "tracking=csv", f"run_dir={run.path}"])
    rows.update(columns_of(run.manifest), conditions=f"{run.summary['steps']:,} steps")
    table = pd.read_csv(run.metrics_csv)
    for metric, setting in zip(metrics, settings, strict=True):
      if metric not in table or table[metric].dropna().empty:
        raise RunFailedError(f"metrics.csv has no {metric}.{nearest(metric, list(table))}")
      rows.emit("golden_metric", float(table[metric].dropna().iloc[-1]), "", setting=setting)


def run_training(overrides: list[str], without: tuple[str, ...] = ()) -> None:
  """Runs `playground-run` in its own process; raises RunFailedError with the last line of its output."""
  env = {key: value for key, value in os.environ.items() if key not in without}
  command = [*PYTHON, "-W", "ignore", "-c", "from playground.cli.run import main; main()", *overrides]
  with subprocess.Popen(
    command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", env=env
  ) as process:
    signal.signal(signal.SIGTERM, lambda *_: process.terminate())  # the run saves while this process waits
    out, errors = process.communicate()
  if process.returncode:
    lines = (errors or out).strip().splitlines()
    why = lines[-1] if lines else "no output"
    raise RunFailedError(f"playground-run ended with code {process.returncode}: {why}")


def columns_of(manifest: Mapping[str, object]) -> dict[str, object]:
  """Returns the columns `backend`, `devices` and `precision` of a run's rows, from its manifest."""
  precision = f"physics {manifest['matmul_precision']}, networks {manifest['network_precision']}"
  return {"backend": manifest["impl"], "devices": manifest["num_devices"], "precision": precision}


def emit_returns(
  rows: Rows,
  evaluations: Iterable[tuple[float, float, float]],
  setting: Sequence[str],
  seed: int,
  quantity: str = "return",
) -> None:
  """Emits a row for each evaluation: (steps trained, mean return, seconds into the run)."""
  for step, score, seconds in evaluations:
    columns = {"setting": " ".join((*setting, f"step={step:.0f}")), "seed": seed}
    rows.emit(quantity, score, "", **columns, conditions=f"{rows['conditions']}; after {seconds:.1f} s")


def emit_result(rows: Rows, result: Mapping[str, float | None], quantities: Sequence[str], **columns: object) -> None:
  """Emits a row for each quantity of the result of a run, in order."""
  for quantity in quantities:
    if (value := result.get(quantity)) is not None:
      rows.emit(quantity, value, _UNITS.get(quantity, ""), **columns)


def _one_update(config: RunConfig) -> int:
  """Returns the budget (control steps) of one update that learns."""
  settings = config.agent
  return (settings.prefill_updates + 1) * settings.steps_per_update * config.env.action_repeat


def _chain_run(runs: Path, experiment: str, overrides: list[str], devices: int, seed: int, again: bool) -> RunDirectory:
  """Returns the run directory of these arguments; with `again`, the first unfinished numbered one."""
  digest = [hashlib.sha256(" ".join(overrides).encode()).hexdigest()[:8]] if overrides else []
  several = [f"{devices}_devices"] if devices > 1 else []
  name = "_".join([experiment, *digest, *several, f"seed_{seed}"])
  numbered = (name if number == 1 else f"{name}_{number}" for number in itertools.count(1))
  return next(run for path in numbered if not _finished(run := RunDirectory(runs / path)) or not again)


def _finished(run: RunDirectory) -> bool:
  return run.status.get("status") == "finished"
