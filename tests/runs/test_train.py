"""Whole runs: what they leave behind, and that nothing that ends one early changes what comes out."""

import contextlib
import errno
import functools
import math
import os
import pty
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
import pytest

from playground.config import compose
from playground.errors import CheckpointError
from playground.files import is_locked
from playground.hardware.setup import setup
from playground.learning import checkpoints
from playground.learning.checkpoints import Checkpoint, checksum, find_checkpoints
from playground.learning.loop import Loop, schedule
from playground.runs import train as train_module
from playground.runs.callbacks import MAX_WAITING, RunCallbacks
from playground.runs.loaded_policy import load_policy
from playground.runs.restore_plan import RestorePlan, networks_of
from playground.runs.run_dir import RunDirectory
from playground.runs.train import cut_short, open_run, say_where, sets_schedule, train
from tests.processes import WITHOUT_WARP
from tests.runs.helpers import TASK, make_run, resume, truncate

BATCH = 80  # environment steps of one training step with debug=fast
STEPS = 240_000  # seconds of training, so that a signal finds the run at work
# A checkpoint every quarter. XLA reads its flags when it starts, which may be long before this process resumes a run.
LONG = [*TASK, f"agent.num_timesteps={STEPS - 10}", "agent.num_evals=5", "hardware.xla_flags="]
COMMAND = [sys.executable, "-c", "from playground.cli.run import main; main()"]
slow = functools.partial(pytest.param, marks=pytest.mark.slow)
pytestmark = pytest.mark.stored_programs


def start(run: Path, cache: Path, *overrides: str, resumed: bool = False) -> "subprocess.Popen[str]":
  """Starts `playground-run` in a process of its own."""
  log = run.with_suffix(".log").open("w")
  what = [f"resume={run}"] if resumed else [*LONG, f"run_dir={run}"]
  args = [*COMMAND, *what, f"hardware.cache_dir={cache}", *overrides]
  env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"} | WITHOUT_WARP
  return subprocess.Popen(args, stdout=log, stderr=subprocess.STDOUT, text=True, env=env)


def stop(process: "subprocess.Popen[str]", signum: int, when: Callable[[], bool]) -> int:
  """Sends a signal as soon as something is so; returns how the process ended."""
  until = time.monotonic() + 240
  while not when():
    assert process.poll() is None, "the run ended before it could be stopped"
    assert time.monotonic() < until, "what the test waits for does not come"
    time.sleep(0.002)
  process.send_signal(signum)
  return process.wait(60)


def last_row(run: Path) -> int:
  """Steps of the last whole row of metrics.csv, -1 if there is none."""
  try:
    rows = (run / "metrics.csv").read_text().rpartition("\n")[0].splitlines()[1:]
  except FileNotFoundError:
    return -1
  return int(rows[-1].split(",")[0]) if rows else -1


def assert_same_result(run: Path, whole: Path) -> None:
  """Same parameters, same best ones and same rows as the run that was left alone."""
  ours, theirs = RunDirectory(run), RunDirectory(whole)
  assert ours.status["status"] == "finished"
  for key in ("params_sha256", "final_return", "best_return", "best_step", "steps", "status"):
    assert ours.summary[key] == theirs.summary[key], key
  assert ours.summary["steps_per_second"] > 0
  best = [Checkpoint(find_checkpoints(path / "checkpoints/best")[0]) for path in (run, whole)]
  assert best[0].meta["sha256"] == best[1].meta["sha256"]
  assert [(it.step, it.meta["return"]) for it in best] == [(ours.summary["best_step"], ours.summary["best_return"])] * 2
  tables = [pd.read_csv(path / "metrics.csv") for path in (run, whole)]
  ours, theirs = (table.filter(regex="^(?!time/)") for table in tables)
  assert len(theirs) == 101
  pd.testing.assert_frame_equal(ours, theirs, check_like=True, check_exact=True)
  assert sorted(tables[0]) == sorted(tables[1])


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, cache: Path) -> Path:
  """The run that nothing happens to, started with an empty compilation cache."""
  run = tmp_path_factory.mktemp("whole") / "run"
  assert start(run, cache).wait(300) == 0, run.with_suffix(".log").read_text()
  return run


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
  """The whole run as it would lie there had its process been killed right after the last checkpoint."""
  run = shutil.copytree(whole, tmp_path / "copy")
  (run / "summary.json").unlink()
  RunDirectory(run).set_status("running")
  return run


def test_a_run_leaves_everything_behind(whole: Path) -> None:
  run = RunDirectory(whole)
  assert run.config["agent"]["num_timesteps"] == STEPS - 10
  assert run.config["env"]["episode_length"] == 20, "resolved: debug=fast is in it"
  assert f"agent.num_timesteps={STEPS - 10}" in run.overrides
  assert run.status["status"] == "finished"

  manifest = run.manifest
  assert (manifest["seed"], manifest["task"], manifest["platform"]) == (1, "CartpoleBalance", "cpu")
  assert (manifest["matmul_precision"], manifest["network_precision"]) == ("highest", "tensorfloat32")
  assert manifest["versions"]["jax"] == jax.__version__
  timings = manifest["timings"]
  for name in ("trace_s", "compile_s", "start_to_compiled_s", "start_to_first_update_s", "first_update_s", "train_s"):
    assert timings[name] > 0, name
  assert timings["trace_s"] + timings["compile_s"] < timings["start_to_compiled_s"] < timings["start_to_first_update_s"]

  table = pd.read_csv(run.metrics_csv)
  assert table["step"].is_monotonic_increasing and table["time/wall_clock_s"].is_monotonic_increasing
  assert table["time/wall_clock_s"].to_numpy()[0] == table["time/eval_s"].to_numpy()[0], "no training before step 0"
  assert np.isfinite(table["eval/episode_reward"].to_numpy()).sum() == 5
  rates = table["time/steps_per_second"].dropna()
  assert timings["steady_steps_per_second"] == pytest.approx(rates.median())
  summary = run.summary
  assert STEPS - 10 <= summary["steps"] < STEPS - 10 + BATCH, "the budget is met to within one batch"
  assert table["step"].to_numpy()[-1] == summary["steps"]
  assert summary["final_return"] == summary["final_sampled_return"] == table["eval/episode_reward"].to_numpy()[-1]
  assert summary["final_mode_return"] == table["eval/mode/episode_reward"].to_numpy()[-1]
  assert "eval/mode/episode_length" in table and not any(name.startswith("eval/mode/episode_reward/") for name in table)
  returns = table[table["step"] > 0].set_index("step")["eval/episode_reward"]
  assert (summary["best_return"], summary["best_step"]) == (returns.max(), returns.idxmax())
  assert summary["steps_per_second"] == pytest.approx(summary["steps"] / timings["train_s"])
  assert summary["wall_clock_s"] > timings["train_s"]
  saved = sorted(returns.dropna().index)
  (best,) = find_checkpoints(run.checkpoints / "best")
  kept = find_checkpoints(whole)
  assert {int(path.name) for path in kept} == {*saved[-3:], summary["best_step"]}, "checkpoint.keep, and the best"
  assert Checkpoint(best).meta["return"] == summary["best_return"]
  checkpoint = Checkpoint(kept[0])
  assert checkpoint.step == summary["steps"]
  assert checkpoint.meta["sha256"]["policy"] == summary["params_sha256"]
  assert {p.name for p in run.plots.iterdir()} == {"return_over_steps.png", "return_over_wall_clock.png"}
  log = whole.with_suffix(".log").read_text()
  assert all(str(path) in log for path in (run.metrics_csv, run.plots, run.checkpoints))


@pytest.mark.parametrize("moment", [slow("before the first checkpoint"), "while one is written", slow("after one")])
def test_sigkill_and_resume_change_nothing(
  moment: str, whole: Path, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  run = tmp_path / "run"
  checkpoints = run / "checkpoints"
  when: dict[str, Callable[[], bool]] = {
    "before the first checkpoint": lambda: last_row(run) > 0,
    "while one is written": lambda: (checkpoints / f"{STEPS // 4:012d}").exists() and any(checkpoints.glob("*tmp*")),
    "after one": lambda: last_row(run) > 0.6 * STEPS and (checkpoints / f"{STEPS // 2:012d}").exists(),
  }
  assert stop(start(run, cache), signal.SIGKILL, when[moment]) == -signal.SIGKILL
  assert RunDirectory(run).status["status"] == "running"
  found = {int(p.name): p for p in checkpoints.glob("*") if p.name.isdigit()}
  assert bool(found) == (moment != "before the first checkpoint")
  assert resume(run) == 0
  said = capsys.readouterr().out
  assert (f"training state of {found[max(found)]}" if found else f"{run} stopped before its first checkpoint") in said
  assert_same_result(run, whole)
  assert len(RunDirectory(run).manifest["earlier_starts"]) == 1


@pytest.mark.parametrize("signum", [signal.SIGTERM, slow(signal.SIGINT)])
def test_a_signal_saves_and_leaves(signum: int, whole: Path, cache: Path, tmp_path: Path) -> None:
  run = tmp_path / "run"
  assert stop(start(run, cache), signum, lambda: last_row(run) > 0.3 * STEPS) == 128 + signum
  assert RunDirectory(run).status["status"] == "preempted"
  summary = RunDirectory(run).summary
  newest = find_checkpoints(run)[0]
  assert Checkpoint(newest).step == summary["steps"] == last_row(run), "saved where it was, not at the last evaluation"
  assert 0.3 * STEPS < summary["steps"] < STEPS
  assert resume(run) == 0
  assert_same_result(run, whole)


@pytest.mark.slow
def test_a_signal_while_compiling(whole: Path, cache: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  run = tmp_path / "run"
  log = run.with_suffix(".log")
  compiling_since: list[float] = []

  def compiling() -> bool:
    if not compiling_since and "compiling for" in log.read_text(errors="replace"):  # half a letter at its end
      compiling_since.append(time.monotonic())
    return bool(compiling_since) and time.monotonic() > compiling_since[0] + 3

  process = start(run, cache, "hardware.compilation_cache=false")
  assert stop(process, signal.SIGTERM, compiling) == 143
  status = RunDirectory(run).status
  assert (status["status"], "SIGTERM" in status["reason"]) == ("preempted", True)
  assert "Traceback" not in log.read_text()
  assert resume(run) == 0
  assert "stopped before its first checkpoint: starting from the beginning" in capsys.readouterr().out
  assert_same_result(run, whole)


@pytest.mark.slow
def test_a_second_start_traces_nothing_and_ends_the_same(whole: Path, cache: Path, tmp_path: Path) -> None:
  run = tmp_path / "run"
  assert start(run, cache).wait(300) == 0
  assert_same_result(run, whole)
  timings = [RunDirectory(path).manifest["timings"] for path in (whole, run)]
  assert timings[0]["trace_s"] > 0 == timings[1]["trace_s"]

  programs = {program: program.read_bytes() for program in cache.rglob("*.program")}  # other tests have theirs, too
  for program, content in programs.items():
    program.write_bytes(content[:-1])
  damaged = tmp_path / "damaged"
  assert start(damaged, cache).wait(300) == 0
  log = " ".join(damaged.with_suffix(".log").read_text().split())
  sentence = "The stored program {} was removed: it is damaged. The program is traced again."
  (removed,) = [program for program in programs if sentence.format(program) in log]
  assert_same_result(damaged, whole)
  again = tmp_path / "again"
  assert start(again, cache).wait(300) == 0
  assert removed.is_file() and RunDirectory(again).manifest["timings"]["trace_s"] == 0, "stored again"


@pytest.mark.parametrize("what", ["damaged", slow("not a checkpoint")])
def test_a_damaged_checkpoint_is_passed_over(
  what: str, whole: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  newest, before, *_ = find_checkpoints(copy)
  if what == "damaged":
    truncate(newest)
  else:  # a kill while it was deleted, or half a copy
    shutil.rmtree(newest)
    newest.mkdir()
  assert resume(copy) == 0
  said = capsys.readouterr().out
  assert f"{newest} is {what}" in said
  assert "Falling back to the checkpoint before it." in said
  assert f"training state of {before}" in said
  assert newest.with_name(f"damaged_{newest.name}").is_dir()
  assert_same_result(copy, whole)


@pytest.mark.parametrize("what", ["open files", "shape", "newer"])
def test_a_checkpoint_that_is_not_damaged_is_never_passed_over(
  what: str, copy: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
  """Going on from an older one would throw its training away."""
  newest, *_ = find_checkpoints(copy)
  if what == "open files":
    monkeypatch.setattr(checkpoints, "_RETRY_AFTER_S", ())
    monkeypatch.setattr(Checkpoint, "_read_arrays", lambda *_: (_ for _ in ()).throw(OSError(errno.EMFILE, "Too many")))
    expected = f"{newest} cannot be read now"
  elif what == "shape":
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace("num_envs: 8", "num_envs: 16"))
    expected = f"{newest} does not fit this run"
  else:
    meta = newest / "meta/metadata"
    meta.write_text(meta.read_text().replace(checkpoints.FORMAT, "playground-run/9"))
    expected = f"{newest} was written by a newer version"
  before = sorted(os.listdir(copy / "checkpoints"))
  assert expected in refused(f"resume={copy}")
  assert sorted(os.listdir(copy / "checkpoints")) == before
  assert last_row(copy) == int(newest.name)


@pytest.mark.parametrize(
  ("was", "now", "sentence"),
  [
    (
      "    activation: swish",
      "    activation: relu",
      "was trained with agent.network.activation=swish: a run with agent.network.activation=relu cannot",
    ),
    ("  env: CartpoleBalance\n", "  env: CartpoleSwingup\n", "was trained on CartpoleBalance, but its run is one of"),
  ],
)
def test_a_checkpoint_of_another_task_or_network_neither_plays_nor_goes_on(
  was: str, now: str, sentence: str, copy: Path, refused: Callable[..., str]
) -> None:
  """Of the same shapes, it would compute something else."""
  (newest, *_), text = find_checkpoints(copy), (copy / "config.yaml").read_text()
  assert was in text
  (copy / "config.yaml").write_text(text.replace(was, now))
  with pytest.raises(CheckpointError, match=re.escape(f"{newest} {sentence}")):
    load_policy(copy)
  assert f"{newest} {sentence}" in refused(f"resume={copy}")


def test_a_run_killed_after_its_last_checkpoint_ends_with_the_same_result(whole: Path, copy: Path) -> None:
  assert resume(copy) == 0
  assert_same_result(copy, whole)


def test_damaged_metrics_are_rebuilt(whole: Path, copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
  metrics = copy / "metrics.csv"
  damaged = metrics.read_text().partition("\n")[2].replace("\n", '\n"', 1)
  metrics.write_text(damaged)
  assert resume(copy) == 0
  assert "its header is missing): it is kept as metrics_damaged.csv, 101 rows are rebuilt." in capsys.readouterr().out
  assert (copy / "metrics_damaged.csv").read_text() == damaged
  assert_same_result(copy, whole)


def test_lost_metrics_lose_not_the_best(whole: Path, copy: Path) -> None:
  (copy / "metrics.csv").write_text("")
  assert resume(copy) == 0
  ours, theirs = (RunDirectory(run).summary for run in (copy, whole))
  assert (ours["best_return"], ours["best_step"]) == (theirs["best_return"], theirs["best_step"])


def test_a_best_policy_that_is_gone_is_not_named(whole: Path, copy: Path) -> None:
  gone, newest = RunDirectory(whole).summary["best_step"], find_checkpoints(copy)[0]
  assert int(newest.name) > gone
  shutil.rmtree(copy / "checkpoints" / f"{gone:012d}")
  assert resume(copy) == 0
  (best,) = find_checkpoints(copy / "checkpoints" / "best")
  summary = RunDirectory(copy).summary
  assert (summary["best_return"], summary["best_step"]) == (Checkpoint(best).meta["return"], int(best.name))
  assert summary["best_step"] != gone


def test_a_best_policy_whose_metrics_are_gone_is_named(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
  run = RunDirectory(copy)
  run.write_summary({"status": "finished", "final_return": 1.0, "steps": 1, "best_step": None, "best_return": None})
  (copy / "checkpoints/best").mkdir(exist_ok=True)
  say_where(run)
  assert f"best        {copy / 'checkpoints/best'}\n" in capsys.readouterr().out


# What the system denies


@pytest.mark.slow
def test_a_terminal_that_is_gone(whole: Path, cache: Path, tmp_path: Path) -> None:
  """A closed window, a lost connection: nothing can be printed any more, and the run is saved."""
  run = tmp_path / "run"
  ours, theirs = pty.openpty()
  args = [*COMMAND, *LONG, f"run_dir={run}", f"hardware.cache_dir={cache}"]
  code = "import fcntl, os, signal, sys, termios; signal.signal(signal.SIGHUP, signal.SIG_DFL); "
  code += "fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execvp(sys.argv[1], sys.argv[1:])"
  env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
  terminal: Any = {"stdin": theirs, "stdout": theirs, "stderr": theirs, "start_new_session": True}
  process = subprocess.Popen([sys.executable, "-c", code, *args], env=env, **terminal)
  os.close(theirs)
  reader = threading.Thread(target=_read_all, args=(ours,), daemon=True)
  reader.start()
  until = time.monotonic() + 240
  while last_row(run) < STEPS // 4:
    assert process.poll() is None and time.monotonic() < until
    time.sleep(0.01)
  os.close(ours)
  assert process.wait(60) == 129
  assert RunDirectory(run).status["status"] == "preempted"
  assert Checkpoint(find_checkpoints(run)[0]).step == last_row(run)
  assert resume(run) == 0
  assert_same_result(run, whole)


def _read_all(handle: int) -> None:
  with contextlib.suppress(OSError):
    while os.read(handle, 4096):
      pass


@pytest.mark.slow
def test_a_disk_that_is_full(whole: Path, cache: Path, tmp_path: Path) -> None:
  """Here every file may have 12 KB, which metrics.csv needs more of."""
  run = tmp_path / "run"
  process = start(run, cache)
  resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (12_000, resource.RLIM_INFINITY))
  assert process.wait(240) == 2
  said = run.with_suffix(".log").read_text()
  assert (
    said.splitlines()[-1] == f"error: {run} cannot be written: File too large. resume={run} goes on from what is saved."
  )
  assert "Traceback" not in said
  assert RunDirectory(run).status["status"] == "failed"
  assert resume(run) == 0
  assert_same_result(run, whole)


@pytest.mark.slow
def test_a_folder_that_is_removed_in_the_middle(whole: Path, cache: Path, tmp_path: Path) -> None:
  run = tmp_path / "run"
  process = start(run, cache)
  until = time.monotonic() + 240
  while last_row(run) < STEPS // 4:
    assert process.poll() is None and time.monotonic() < until
    time.sleep(0.01)
  process.send_signal(signal.SIGSTOP)  # most often while Orbax saves, which makes the folder again
  assert last_row(run) < STEPS - BATCH
  shutil.rmtree(run)
  process.send_signal(signal.SIGCONT)
  assert process.wait(60) == 2
  said = run.with_suffix(".log").read_text()
  assert said.splitlines()[-1].startswith(f"error: {run}")
  assert "cannot be written" in said
  assert "Traceback" not in said
  assert not (run / "checkpoints").exists()


# What is refused


def test_nothing_but_damaged_checkpoints(copy: Path, refused: Callable[..., str]) -> None:
  checkpoints = find_checkpoints(copy)
  for path in checkpoints:
    truncate(path)
  before = (copy / "metrics.csv").read_bytes()
  assert f"{checkpoints[-1]} is damaged" in refused(f"resume={copy}")
  assert (copy / "metrics.csv").read_bytes() == before


def test_a_run_directory_is_not_used_twice(whole: Path, refused: Callable[..., str]) -> None:
  sentence = refused(*TASK, f"run_dir={whole}")
  assert f"resume={whole}" in sentence
  assert f"init_from={whole}" in sentence
  assert RunDirectory(whole).status["status"] == "finished"


@pytest.mark.slow
def test_two_do_not_resume_one_run(whole: Path, copy: Path, cache: Path, refused: Callable[..., str]) -> None:
  first = start(copy, cache, resumed=True)
  lock = copy / "run.lock"
  try:
    until = time.monotonic() + 60
    while not is_locked(lock):
      assert time.monotonic() < until
      time.sleep(0.01)
    assert f"{copy} is being written by process {first.pid} on " in refused(f"resume={copy}")
  finally:
    assert first.wait(120) == 0, copy.with_suffix(".log").read_text()
  assert_same_result(copy, whole)


def test_a_run_that_another_process_finished_meanwhile_is_not_done_again(
  whole: Path, copy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
  """It was looked at before the other process gave its lock back."""

  def finish(config: Any) -> Any:
    shutil.copy(whole / "status.json", copy / "status.json")
    return setup(config)

  monkeypatch.setattr(train_module, "setup", finish)
  assert resume(copy) == 0
  assert "is finished: nothing to resume" in capsys.readouterr().out


def test_a_finished_run_is_not_resumed(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
  before = (whole / "status.json").read_bytes()
  assert resume(whole) == 0
  assert f"{whole} is finished: nothing to resume (agent.num_timesteps=<more>" in capsys.readouterr().out
  assert (whole / "status.json").read_bytes() == before


def test_a_run_that_trains_longer_ends_as_one_of_that_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  filmed: list[Path] = []
  monkeypatch.setattr("playground.runs.callbacks.render_video", lambda *_, out_path, **__: filmed.append(out_path))
  video = ["video.enable=true", "video.at_end=false", "video.every_evals=3"]
  short, long = (tmp_path / name for name in ("short", "long"))
  for run, steps, evals in ((short, 800, 2), (long, 1600, 3)):
    budget = [f"agent.num_timesteps={steps}", f"agent.num_evals={evals}", "agent.num_resets_per_eval=0"]
    assert train(compose([*TASK, *budget, *video, f"run_dir={run}"])) == 0
  with monkeypatch.context() as patch:
    patch.setattr(train_module.Training, "compile", lambda *_: sys.exit(3))
    with pytest.raises(SystemExit):
      train(compose([f"resume={short}", "agent.num_timesteps=1600"]))
  assert RunDirectory(short).status["status"] == "failed"
  assert resume(short) == 0  # the budget is known by now
  one, other = RunDirectory(short), RunDirectory(long)
  assert one.config["agent"] == other.config["agent"]
  assert {"agent.num_timesteps=1600", "agent.num_evals=3"} <= set(one.overrides)
  assert one.summary["params_sha256"] == other.summary["params_sha256"]
  steps = [pd.read_csv(run.metrics_csv)["step"].to_numpy()[-1] for run in (one, other)]
  assert steps == [1600, 1600] and one.status["status"] == one.summary["status"] == "finished"
  assert filmed == [run.videos / "step_000000001600.mp4" for run in (other, one)], "the third evaluation"


@pytest.mark.parametrize("signalled", [False, True])
def test_videos_that_take_longer_than_training_are_left_out(
  signalled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  trained, filmed = threading.Event(), []

  def render(*_: object, out_path: Path, **__: object) -> None:
    assert trained.wait(60)
    time.sleep(0.3)
    filmed.append(out_path.name)

  def end(*args: Any) -> None:
    if signalled:
      os.kill(os.getpid(), signal.SIGTERM)
    trained.set()
    finish(*args)

  finish = RunCallbacks.finish
  monkeypatch.setattr("playground.runs.callbacks.render_video", render)
  monkeypatch.setattr(RunCallbacks, "finish", end)
  budget = [f"agent.num_timesteps={9 * BATCH}", "agent.num_evals=10", "video.enable=true", "video.every_evals=1"]
  assert train(compose([*TASK, *budget, f"run_dir={tmp_path}"])) == 0
  assert RunDirectory(tmp_path).status["status"] == "finished"
  left_out = capsys.readouterr().out.count(f"{MAX_WAITING} others wait to be rendered.")
  if signalled:
    assert 1 <= len(filmed) <= 2, "the one under way, and the next if that just ended"
  else:
    assert len(filmed) == 1 + MAX_WAITING + 1 and left_out == 10 - (1 + MAX_WAITING)
    assert filmed[-1] == f"step_{9 * BATCH:012d}.mp4"


@pytest.mark.parametrize("by", ["a second signal", "an error"])
def test_whatever_ends_a_run_its_last_checkpoint_is_written(
  by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Under the run's lock: another start would remove what is half written."""
  written = []

  def write(*args: Any) -> None:
    time.sleep(0.5)
    save(*args)
    written.append(is_locked(tmp_path / "run.lock"))

  def end(*_: object) -> None:
    if by == "an error":
      raise OSError("no space left")
    os.kill(os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGTERM)

  save = checkpoints.CheckpointStore._write
  monkeypatch.setattr(checkpoints.CheckpointStore, "_write", write)
  monkeypatch.setattr(RunCallbacks, "end_training", end)
  with pytest.raises(CheckpointError, match="no space left") if by == "an error" else contextlib.nullcontext():
    assert train(compose([*TASK, f"run_dir={tmp_path}"])) == 143
  assert written[-1] and Checkpoint(find_checkpoints(tmp_path)[0]).step == last_row(tmp_path)


def test_of_two_starts_in_one_folder_the_second_changes_nothing(tmp_path: Path) -> None:
  """Both found it free."""
  config = compose([*TASK, f"run_dir={tmp_path}"])
  with RunDirectory(tmp_path).locked():
    with pytest.raises(CheckpointError, match=f"^{tmp_path} is being written by process"):
      train(config)
    assert [path.name for path in tmp_path.iterdir()] == ["run.lock"]
  with open_run(config, RestorePlan.find(config)) as run:
    assert is_locked(tmp_path / "run.lock") and run.config["seed"] == 1


def test_more_devices_than_there_are(tmp_path: Path, refused: Callable[..., str]) -> None:
  assert "hardware.devices=99, but this machine has" in refused(
    *TASK, "hardware.devices=99", f"run_dir={tmp_path / 'run'}"
  )
  assert not (tmp_path / "run").exists()


def test_too_little_memory(tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
  def allocate(*_: Any) -> None:
    raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 9 bytes.")

  monkeypatch.setattr(Loop, "init", allocate)
  sentence = refused(*TASK, f"run_dir={tmp_path / 'run'}")
  assert "agent.num_envs" in sentence and "Out of memory while trying to allocate 9 bytes)." in sentence
  assert RunDirectory(tmp_path / "run").status["status"] == "failed"


def test_a_camera_that_is_not_there(
  tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setattr(train_module, "compile_program", pytest.fail)
  sentence = refused(*TASK, "video.camera=fixd", f"run_dir={tmp_path / 'run'}")
  assert "video.camera=fixd is no camera of the model; it has fixed, lookatcart. Did you mean 'fixed'?" in sentence
  assert not (tmp_path / "run").exists()


def test_a_mistake_in_a_term_shows_before_there_is_a_folder(
  tmp_path: Path, refused: Callable[..., str], monkeypatch: pytest.MonkeyPatch
) -> None:
  (tmp_path / "my_terms.py").write_text("def mine(c):\n  return open('/missing/file').read()\n")
  monkeypatch.syspath_prepend(tmp_path)
  monkeypatch.setattr(train_module, "compile_program", pytest.fail)
  override = "env.rewards.mine={func: 'my_terms:mine', weight: 1}"
  sentence = refused(*TASK, override, "trust=my_terms", f"run_dir={tmp_path / 'run'}")
  assert "env.rewards.mine: my_terms.py:2: FileNotFoundError: [Errno 2] No such file or directory:" in sentence
  assert not (tmp_path / "run").exists()


# Starting from weights


def test_weights_of_another_task_are_refused(whole: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
  sentence = refused(
    "env=Go1JoystickFlatTerrain", *TASK[1:], "randomization=none", f"init_from={whole}", f"run_dir={tmp_path / 'run'}"
  )
  there, here = "the observation state 5", "a run with state 48 cannot start from it."
  assert f"{find_checkpoints(whole)[0]} was trained with {there}: {here}" in sentence
  assert not (tmp_path / "run").exists(), "nothing was compiled or begun"


@pytest.mark.parametrize(
  ("override", "there"), [("agent.network.activation=relu", "swish"), ("agent.normalize_observations=false", "true")]
)
def test_weights_of_another_network_are_refused(
  override: str, there: str, whole: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
  """Of the same shapes, which would compute something else."""
  key, _, here = override.partition("=")
  sentence = refused(*TASK, override, f"init_from={whole}", f"run_dir={tmp_path / 'run'}")
  assert f"was trained with {key}={there}: a run with {key}={here} cannot start from it." in sentence


def test_the_noise_of_a_new_policy_is_no_matter_of_weights(whole: Path, tmp_path: Path) -> None:
  run = ["agent.network.init_std=0.3", f"init_from={whole}", f"run_dir={tmp_path / 'run'}"]
  config = compose([*TASK, *run])
  assert RestorePlan.find(config).weights is not None
  agent = config.resolved["agent"]
  assert networks_of(agent) == networks_of({**agent, "network": {**agent["network"], "init_std": None}})


def test_weights_of_a_critic_of_other_values_are_refused(tmp_path: Path, refused: Callable[..., str]) -> None:
  """The same logits would mean other returns."""
  sizes = ["policy_hidden_layer_sizes=[64,64]", "q_hidden_layer_sizes=[128,128]"]
  task = ["env=PendulumSwingup", "agent=fast_sac", *TASK[3:], *(f"agent.network.{line}" for line in sizes)]
  task += ["agent.max_value=900", "agent.num_timesteps=50000", "init_from=pretrained:PendulumSwingup"]
  sentence = refused(*task, f"run_dir={tmp_path / 'run'}")
  assert "was trained with agent.max_value=450.0: a run with agent.max_value=900.0 cannot start from it." in sentence


def test_a_checkpoint_may_be_named_from_where_it_lies(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  newest, *_ = find_checkpoints(whole)
  monkeypatch.chdir(newest.parent)
  assert find_checkpoints(newest.name) == [newest] and find_checkpoints(".") == find_checkpoints(whole)
  assert find_checkpoints("best") == find_checkpoints(whole / "checkpoints/best")
  monkeypatch.chdir(newest)
  assert find_checkpoints(".") == [newest]


@pytest.mark.parametrize("source", ["run", "checkpoint", "best"])
def test_a_new_run_starts_from_weights(
  source: str,
  whole: Path,
  tmp_path: Path,
  watched: list[Any],
  capsys: pytest.CaptureFixture[str],
) -> None:
  path = {"run": whole, "checkpoint": find_checkpoints(whole)[1], "best": whole / "checkpoints/best"}[source]
  checkpoint = Checkpoint(find_checkpoints(path)[0])
  args = [*TASK, "agent.num_timesteps=320", f"init_from={path}", f"run_dir={tmp_path / 'run'}"]
  assert train(compose(args)) == 0
  ((update, policy, _),) = watched
  assert checksum(jax.tree.leaves(policy)) == checkpoint.meta["sha256"]["policy"]
  assert update is None
  said = capsys.readouterr().out
  assert f"{checkpoint.path} (CartpoleBalance, {checkpoint.step:,} steps)" in said
  assert "the optimiser is new" in said
  summary = RunDirectory(tmp_path / "run").summary
  assert summary["steps"] == 320, "a new budget"
  assert summary["params_sha256"] != checkpoint.meta["sha256"]["policy"], "it trained on"


@pytest.mark.parametrize("ctrl_dt", ["0.01", "0.02"])
def test_weights_of_another_meaning_are_announced(
  ctrl_dt: str, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  run = tmp_path / "run"
  args = [*TASK, "agent.num_timesteps=320", f"init_from={whole}", f"env.ctrl_dt={ctrl_dt}", f"run_dir={run}"]
  assert train(compose(args)) == 0
  announced = "These weights were trained with other values of env.ctrl_dt:" in capsys.readouterr().out
  assert announced == (ctrl_dt != "0.01")


def test_weights_that_a_link_has_lost(copy: Path, refused: Callable[..., str]) -> None:
  best = copy / "checkpoints/best"
  shutil.rmtree(best)  # the fixture copied what it points to
  assert f"init_from={best} is no run directory or checkpoint" in refused(*TASK, f"init_from={best}")
  best.symlink_to("000000000001")
  assert f"{best} points to 000000000001, which is not there." in refused(*TASK, f"init_from={best}")


def test_resumed_before_its_first_checkpoint_it_starts_from_the_weights_again(whole: Path, tmp_path: Path) -> None:
  run = make_run(tmp_path / "run", compose([*TASK, f"init_from={whole}"]).resolved)
  found = RestorePlan.find(compose([f"resume={run.path}"]))
  assert found.weights is not None
  assert found.weights.path == find_checkpoints(whole)[0]


def test_what_its_weights_are_does_not_change_until_it_is_resumed(
  copy: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  """Their run trains on, and the command is given in another folder."""
  newest, path = find_checkpoints(copy)[0], tmp_path / "run"
  monkeypatch.chdir(tmp_path)
  config = compose([*TASK, f"init_from={copy.name}", f"run_dir={path}"])
  with open_run(config, RestorePlan.find(config)):
    pass
  shutil.copytree(newest, newest.with_name("999999999999"))
  (tmp_path / "elsewhere").mkdir()
  monkeypatch.chdir("elsewhere")
  found = RestorePlan.find(compose([f"resume={path}"]))
  assert found.weights is not None and found.weights.path == newest
  shutil.rmtree(newest)
  with pytest.raises(CheckpointError, match=f"^{path} cannot start again from {newest}, which is no longer there: "):
    RestorePlan.find(compose([f"resume={path}"]))


def test_a_pretrained_policy_keeps_its_name() -> None:
  config = compose([*TASK, "init_from=pretrained:CartpoleBalance"])
  assert RestorePlan.find(config).to_write(config)["init_from"] == "pretrained:CartpoleBalance"


def test_a_run_with_the_schedule_of_its_set_says_nothing_of_it() -> None:
  task = "env=Go1JoystickFlatTerrain"  # ten resets, which leave an episode 271 of 1000 steps
  assert not sets_schedule(compose([task, "agent.learning_rate=1e-4"]))
  assert not sets_schedule(compose(["env=v020/CartpoleBalance"]))
  assert sets_schedule(compose([task, "agent.num_timesteps=20e6"]))
  chain = compose(["env=Go1Handstand", "curriculum=go1_handstand_chain"])
  assert sets_schedule(chain.stages[2])  # its budget, without an override


def test_a_run_whose_fresh_starts_end_every_episode_early_says_so() -> None:
  """Spot's commands last 201 control steps: a policy of such a run has never seen one change."""

  def said(*overrides: str) -> list[str]:
    agent = compose(["env=SpotFlatTerrainJoystick", "agent=ppo_paper", *overrides]).agent
    updates = math.ceil(agent.num_timesteps / 163_840)
    return cut_short(agent, 1000, schedule(updates, agent.num_evals, agent.num_resets_per_eval, 3), 163_840)

  (short,) = said("agent.num_timesteps=40e6", "agent.num_evals=6")
  assert "the first 100 of an episode's 1000 control steps" in short
  assert "agent.num_resets_per_eval=10" in short
  assert "the first 140 of" in said()[0]  # as many as in playground 0.2.0
  assert said("agent.num_resets_per_eval=1") == []
  assert said("agent.num_resets_per_eval=0", "agent.num_timesteps=1e6") == []  # nothing is reset
