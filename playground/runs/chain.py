"""Trains a chain of runs (fine-tuning): each stage starts from the previous stage's weights, with a new optimiser.

Every stage is an ordinary run directory inside the chain's, `<chain>/<number>_<stage>/`. All stage directories are
written, with resolved configurations, before the first stage is trained. So the remaining work is on disk, and a
resumed chain resumes its first unfinished stage, whether that stage has started or not.

The stages run one after another in this process. A child process for each would free its memory, too, but would
start JAX and the device again for every stage, and would have to forward signals and the terminal.
"""

import contextlib
import gc
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace

from playground import registry
from playground.config import RunConfig, in_stage, stage_folders
from playground.errors import ConfigError
from playground.files import write_text
from playground.hardware.distributed import any_process, is_main, noting_loss, share
from playground.hardware.setup import setup
from playground.learning.checkpoints import describe
from playground.learning.trainer import Trainer
from playground.randomization import Randomizer
from playground.rendering.video import need_camera
from playground.runs.csv_tracker import STAGE, read_metrics
from playground.runs.interrupts import Interrupts
from playground.runs.plots import plot_learning_curve
from playground.runs.progress import format_return
from playground.runs.provenance import process_age_s
from playground.runs.restore_plan import RestorePlan, networks_of, weights_of
from playground.runs.run_dir import RETURNS, RunDirectory
from playground.settings import Plain, Section

_RESULT = ("env", *RETURNS, "best_step", "params_sha256")
_OF_A_RUN = (*_RESULT, "steps", "steps_per_second", "wall_clock_s")
TrainRun = Callable[[RunConfig, Interrupts, float], int]


def train_chain(config: RunConfig, interrupts: Interrupts, train_run: TrainRun) -> int:
  """Runs the stages of a new chain, or the unfinished stages of a resumed one.

  Args:
    config: of the chain, with its stages.
    interrupts: signals that the process received.
    train_run: trains one run: (its config, interrupts, age of the process) -> exit code.

  Returns:
    The exit code, as of a run.

  Raises:
    PlaygroundError: a stage failed; the message names the stage. An invalid stage raises before anything is trained
      or written.
  """
  folders = stage_folders(config.curriculum)
  if config.resume is None:
    _check(config)
    opened = _laid_out(config)
  else:
    chain = RunDirectory.open(config.resume)
    # Else a stage was trained longer by itself, or is to be: it was interrupted in that.
    stages = _stages(chain, folders)  # raises for a damaged summary before a stage trains
    if chain.status.get("status") == "finished" and chain.summary.get("stages") == stages:
      print(f"{chain.path} is finished: nothing to resume (init_from={chain.path} trains on from its weights).")
      return 0
    opened = contextlib.nullcontext((chain, list(config.stages)))
  setup(config.hardware)  # afterwards a process knows whether it writes
  began_s, before = 0.0, None  # the config of the first stage names its weights
  with (
    opened as (chain, stages),
    chain.recorded() if is_main() else contextlib.nullcontext(),
    noting_loss(chain.note_loss),
  ):
    try:
      for stage, (name, folder) in zip(stages, folders.items(), strict=True):
        run_dir = RunDirectory(chain.path / folder)
        if share(run_dir.status.get("status", "")) != "finished":
          if is_main():
            chain.set_status("running", f"stage {folder}")
            if before is not None:
              _write_curve(chain, folders)  # of the stages so far
            print(f"\nStage {folder} of {chain.path}: {stage.agent.num_timesteps:,} steps of {stage.choices['env']}")
          with in_stage(name):
            train_run(replace(stage, init_from=before), interrupts, began_s)
          interrupts.stop_saving()
          began_s = process_age_s()
          gc.collect()  # frees the stage's device memory now, not at the next garbage collection
        if any_process(interrupts.signum is not None):
          break
        before = str(run_dir.path)
    finally:
      if is_main():
        _write_result(chain, folders)
  if is_main():
    _say_where(chain)
  return interrupts.exit_code(share(str(chain.summary["status"]) if is_main() else "") == "finished")


def _check(config: RunConfig) -> None:
  """Builds every stage, so that an invalid stage ends the chain before any is trained.

  Tracing a task's reset for its observation sizes takes seconds; training a stage takes minutes.
  """
  if config.resolved["run_dir"] is not None:
    RunDirectory(str(config.run_dir)).must_be_new()
  print(f"Checking the stages {', '.join(stage_folders(config.curriculum))}")
  hardware = setup(config.hardware)
  before: tuple[str, dict[str, object]] | None = None
  for stage, name in zip(config.stages, stage_folders(config.curriculum), strict=True):
    with in_stage(name):
      env = registry.load(stage.choices["env"], config=stage.env)
      need_camera(env.mj_model, stage.video.camera, "video.camera")
      Randomizer(env.mj_model, stage.env.events, impl=env.impl)
      trainer = Trainer(env, stage.agent, hardware.mesh, hardware.network_precision)
      trainer.notices()  # raises for a replay buffer larger than device memory
      size = env.observation_size
      sizes: dict[str, object] = {"agent.name": stage.agent_name, "size of the action": env.action_size}
      sizes |= {f"size of observation {k!r}": v for k, v in (size.items() if isinstance(size, dict) else [("", size)])}
      sizes |= networks_of(stage.resolved["agent"])
      sizes |= {leaf: f"{dtype}{shape}" for leaf, shape, dtype in describe(trainer.policy_shape())}
      if before is None and config.init_from is not None:
        plan = RestorePlan(weights=weights_of(config.init_from))
        plan.restore(trainer, stage, lambda: ({}, {}))
      if before is not None:
        _compare(f"env={stage.choices['env']}", sizes, *before)
      before = name, sizes


def _compare(env: str, sizes: dict[str, object], before: str, theirs: dict[str, object]) -> None:
  """Raises ConfigError where a stage's networks differ from the previous stage's."""
  for key in {**sizes, **theirs}:
    if sizes.get(key) != theirs.get(key):
      here, there = (side.get(key, "not there") for side in (sizes, theirs))
      raise ConfigError(f"{env} cannot start from the weights of stage {before}: {key} is {here}, and {there} there.")


@contextlib.contextmanager
def _laid_out(config: RunConfig) -> Iterator[tuple[RunDirectory, list[RunConfig]]]:
  """Makes the directories of the chain and its stages; yields the stages' configurations, as for resumed runs.

  Process 0 makes the directories, and locks the chain for the block; the other processes wait.
  """
  whole = RestorePlan(weights=weights_of(config.init_from) if config.init_from else None).to_write(config)
  with contextlib.ExitStack() as claim:
    if is_main():
      numbered = config.resolved["run_dir"] is None
      chain = claim.enter_context(RunDirectory.claimed(str(config.run_dir), numbered))
    else:
      chain = RunDirectory(share())
    before, stages = whole["init_from"], []
    for stage, folder in zip(config.stages, stage_folders(config.curriculum).values(), strict=True):
      path = str(chain.path / folder)
      tracking = stage.resolved["tracking"]
      wandb, sweep = dict(tracking["wandb"]), os.environ.get("WANDB_RUN_GROUP")
      if sweep:  # whose group W&B takes where none is given
        wandb["name"] = wandb["name"] or f"{chain.path.name}/{folder}"
      else:
        wandb["group"] = wandb["group"] or chain.path.resolve().name
      resolved = {**stage.resolved, "tracking": {**tracking, "wandb": wandb}, "run_dir": path, "init_from": before}
      if is_main():
        RunDirectory(path).write_config(resolved, stage.overrides)
      going_on = {**resolved, "resume": path, "init_from": None}
      stages.append(replace(stage, resolved=going_on, run_dir=path, resume=path, init_from=None))
      before = path
    if is_main():
      chain.write_config(whole, config.overrides)  # last: the chain can be resumed from here on
      share(str(chain.path.absolute()))
    yield chain, stages


def _write_result(chain: RunDirectory, folders: Mapping[str, str]) -> None:
  """Writes metrics.csv, plots and summary.json of a chain from its stages' files.

  Args:
    chain: directory of the chain.
    folders: names of the stages' folders, by stage.
  """
  _write_curve(chain, folders)
  stages = _stages(chain, folders)
  begun = [stage for stage in stages if stage["steps"] is not None]
  open_ = [stage["status"] for stage in stages if stage["status"] != "finished"]
  last: Section = begun[-1] if begun else {}
  steps, rates = sum(stage["steps"] for stage in begun), [stage["steps_per_second"] for stage in begun]
  seconds = sum(stage["steps"] / rate for stage, rate in zip(begun, rates, strict=True) if rate)
  status = "finished" if not open_ else "failed" if "failed" in open_ else "preempted"
  chain.write_summary(
    {
      "status": status,
      # Stages may have different rewards, so return and step are those of the last stage.
      **{key: last.get(key) for key in _RESULT},
      "steps": steps,
      "steps_per_second": steps / seconds if seconds else None,
      "wall_clock_s": sum(stage["wall_clock_s"] or 0.0 for stage in begun),
      "stages": stages,
    }
  )


def _stages(chain: RunDirectory, folders: Mapping[str, str]) -> list[dict[str, Plain]]:
  """Returns the result of each stage; values that a stage has not reached are None."""
  stages = []
  for name, folder in folders.items():
    run = RunDirectory(chain.path / folder)
    status, summary = run.status.get("status", "not begun"), run.summary
    stages.append({"name": name, "folder": folder, "status": status, **{key: summary.get(key) for key in _OF_A_RUN}})
  return stages


def _write_curve(chain: RunDirectory, folders: Mapping[str, str]) -> None:
  """Writes and plots one table of all stages: steps and wall-clock time accumulate, column `stage` names the stage."""
  import pandas as pd

  tables, steps, seconds = [], 0, 0.0
  for name, folder in folders.items():
    table = read_metrics(RunDirectory(chain.path / folder).metrics_csv)
    if table.empty:
      break
    table.insert(1, STAGE, name)
    table["step"] += steps
    steps = int(table["step"].iloc[-1])
    if "time/wall_clock_s" in table:
      table["time/wall_clock_s"] += seconds
      seconds = float(table["time/wall_clock_s"].iloc[-1])
    tables.append(table)
  if tables:
    write_text(chain.metrics_csv, pd.concat(tables, ignore_index=True).to_csv(index=False))
  plot_learning_curve(chain.metrics_csv, chain.plots)


def _say_where(chain: RunDirectory) -> None:
  """Prints how the stages of a chain ended, and the paths of its files."""
  summary = chain.summary
  print(f"\n{summary['status']}: {summary['steps']:,} steps in all")
  for stage in summary["stages"]:
    score = format_return(stage["final_return"])
    result = f"return {score}, {stage['steps']:,} steps" if stage["steps"] is not None else ""
    print(f"  {stage['folder']:20}{stage['status']:12}{result}")
  for name, path in {"metrics": chain.metrics_csv, "plots": chain.plots}.items():
    print(f"  {name:20}{path}")
