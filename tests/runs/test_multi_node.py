"""Whole runs of real tasks over two processes with two devices each, as over two machines.

All of them take a minute: `make test` has tests/hardware/test_topology.py.
"""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pandas as pd
import pytest

from playground.config import config_roots
from playground.learning.checkpoints import find_checkpoints
from playground.runs.run_dir import RunDirectory
from tests.processes import COMMAND, ended, two_processes

pytestmark = pytest.mark.slow

LINE = ["env=CartpoleBalance", "tuned=null", "debug=fast", "tracking=csv", "run_dir=run"]
LOST_AFTER = "hardware.distributed.lost_after=5"


def kill(processes: "list[subprocess.Popen[str]]", victim: int, run: Path, step: int) -> str:
  """Kills one process once a row of `step` is there; returns the last line of the other one, which then ends."""
  csv, until = run / "metrics.csv", time.monotonic() + 300
  while not csv.is_file() or f"\n{step}," not in csv.read_text():
    assert all(process.poll() is None for process in processes), [process.communicate()[0] for process in processes]
    assert time.monotonic() < until
    time.sleep(0.05)
  processes[victim].kill()
  began = time.monotonic()
  said = processes[1 - victim].communicate(timeout=60)[0]
  assert time.monotonic() - began < 30
  processes[victim].communicate()
  assert processes[1 - victim].returncode == 2, said[-3000:]
  assert "Traceback" not in said and "Check failure" not in said
  status = RunDirectory(run).status
  assert status["status"] == "failed" and "hardware=multi_node: process" in status["reason"]
  return said.splitlines()[-1]


def test_the_others_end_with_a_killed_process_and_the_run_goes_on(tmp_path: Path) -> None:
  line = [*LINE, LOST_AFTER, "agent.num_timesteps=8000", "agent.num_evals=11"]
  processes = two_processes(tmp_path, COMMAND, *line)
  last = kill(processes, 1, tmp_path / "run", 1600)
  assert last == (
    "error: hardware=multi_node: process 1 has given no sign of life for hardware.distributed.lost_after=5 s."
  )
  processes = two_processes(tmp_path, COMMAND, "resume=run", LOST_AFTER)
  last = kill(processes, 0, tmp_path / "run", 3200)
  assert last.startswith("error: hardware=multi_node: process 0 at localhost:") and last.endswith(" is lost.")
  table = pd.read_csv(tmp_path / "run/metrics.csv")
  assert table["step"].is_unique and table["step"].is_monotonic_increasing, "no row is there twice"


def test_processes_with_different_checkpoints_are_refused(tmp_path: Path) -> None:
  line = [*LINE, LOST_AFTER, "agent.num_timesteps=8000", "agent.num_evals=11"]
  kill(two_processes(tmp_path, COMMAND, *line), 1, tmp_path / "run", 1600)
  shutil.copytree(tmp_path / "run", tmp_path / "other/run", symlinks=True)
  shutil.rmtree(find_checkpoints(tmp_path / "other/run")[0])
  processes = two_processes(tmp_path, COMMAND, "resume=run", second=tmp_path / "other")
  said = [process.communicate(timeout=200)[0] for process in processes]
  assert [process.returncode for process in processes] == [2, 2], said
  sentence = "Process 1 has another checkpoint than process 0: give all the same command and files."
  assert all(out.strip().endswith(sentence) for out in said), said


SHORT_CALLS = """
import os, signal
from playground.hardware.distributed import is_main
from playground.learning import loop

loop.CALL_S = 0.0  # each call is of one training step
should_stop, calls = loop.Loop._should_stop, []

def asked(self):
  calls.append(0)
  if len(calls) == 3 and not is_main():
    os.kill(os.getpid(), signal.SIGTERM)
  return should_stop(self)

loop.Loop._should_stop = asked
"""


def test_a_signal_to_one_process_stops_all_between_two_rows(tmp_path: Path) -> None:
  line = [*LINE, "agent.num_timesteps=160000", "agent.num_evals=2"]  # rows are 10 training steps apart
  processes = two_processes(tmp_path, SHORT_CALLS + COMMAND, *line)
  said = [process.communicate(timeout=200)[0] for process in processes]
  assert [process.returncode for process in processes] == [143, 143], said
  run = RunDirectory(tmp_path / "run")
  assert run.status["status"] == "preempted"
  saved, table = int(find_checkpoints(run.path)[0].name), pd.read_csv(run.metrics_csv)
  assert 0 < saved < 1600 and list(table["step"]) == [0, saved]
  ended(two_processes(tmp_path, COMMAND, "resume=run"))
  assert (run.status["status"], run.summary["steps"]) == ("finished", 160_000)


SLOW_HEARTBEATS = """
import time
from playground.hardware.distributed import _Watch

exchange = _Watch._exchange

def slow(self, sign):
  time.sleep(8 * (self._index == 0))
  return exchange(self, sign)

_Watch._exchange = slow
"""


def test_a_heartbeat_under_way_does_not_end_process_0_before_the_others(tmp_path: Path) -> None:
  """The others would lose their coordinator, and end with an error after a training that is finished."""
  ended(two_processes(tmp_path, SLOW_HEARTBEATS + COMMAND, *LINE))
  assert RunDirectory(tmp_path / "run").status["status"] == "finished"


KILLED_AT_ITS_END = """
import os, time
from playground.hardware.distributed import _Watch

part = _Watch._part

def killed(self):
  part(self)
  if self._index == 0:
    time.sleep(3)  # the other one is waiting in JAX
    os._exit(9)

_Watch._part = killed
"""


def test_the_others_do_not_wait_for_a_process_0_that_is_killed_at_its_end(tmp_path: Path) -> None:
  processes = two_processes(tmp_path, KILLED_AT_ITS_END + COMMAND, *LINE, LOST_AFTER)
  said = [process.communicate(timeout=200)[0] for process in processes]
  assert [process.returncode for process in processes] == [9, 2], said
  assert said[1].splitlines()[-1].endswith(" is lost.") and "Traceback" not in said[1]


CHAIN = """
# @package curriculum
defaults:
  - none
  - _self_
stages:
  near: {num_timesteps: 320, overrides: [env.episode_length=10]}
  far: {num_timesteps: 400, overrides: [agent.learning_rate=0.002]}
"""
TRAIN = """
import os, sys
from pathlib import Path
from playground.config import compose
from playground.runs.train import train

sys.exit(train(compose(sys.argv[1:], Path(os.environ["CONFIGS"]))))
"""


def test_a_chain_of_sac_with_videos(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  configs = shutil.copytree(config_roots()[0], tmp_path / "configs")
  (configs / "curriculum/mine.yaml").write_text(CHAIN)
  monkeypatch.setenv("CONFIGS", str(configs))
  line = ["env=PendulumSwingup", "agent=sac", "agent.checkpoint_replay=false", "tuned=null", "debug=fast"]
  line += ["curriculum=mine", "curriculum.scale=1", "video.enable=true", "tracking=csv", "run_dir=chain"]
  first, second = ended(two_processes(tmp_path, TRAIN, *line))
  chain = RunDirectory(tmp_path / "chain")
  assert (chain.status["status"], chain.summary["status"], chain.summary["steps"]) == ("finished", "finished", 720)
  stages = [RunDirectory(chain.path / folder) for folder in ("1_near", "2_far")]
  assert [stage.status["status"] for stage in stages] == ["finished", "finished"]
  assert all(list(stage.videos.glob("*.mp4")) for stage in stages)
  assert "Starting from the weights and observation statistics of" in " ".join(first.split())
  assert "Stage" not in second and "finished" not in second, "only process 0 reports"
  first, _ = ended(two_processes(tmp_path, TRAIN, "resume=chain"))
  assert "chain is finished: nothing to resume" in first


def test_the_go1_with_randomised_models(tmp_path: Path) -> None:
  """Trained, evaluated and filmed; a signal to the process that writes nothing changes no bit of what comes out."""
  line = ["env=Go1JoystickFlatTerrain", "randomization=go1", "tuned=null", "debug=fast", "tracking=csv", "run_dir=run"]
  line += ["video.enable=true", "agent.num_timesteps=3200", "agent.num_evals=11"]
  processes = two_processes(tmp_path, COMMAND, *line)
  while not (tmp_path / "run/metrics.csv").is_file():
    assert all(process.poll() is None for process in processes), [process.communicate()[0] for process in processes]
    time.sleep(0.1)
  os.kill(processes[1].pid, signal.SIGTERM)
  said = [process.communicate(timeout=800)[0] for process in processes]
  assert [process.returncode for process in processes] == [143, 143], said
  run = RunDirectory(tmp_path / "run")
  assert run.status["status"] == "preempted"
  ended(two_processes(tmp_path, COMMAND, "resume=run"))
  assert (run.status["status"], run.summary["steps"]) == ("finished", 3200)
  assert list(run.videos.glob("*.mp4"))
  ended(two_processes(tmp_path, COMMAND, *line, "run_dir=whole"))
  assert run.summary["params_sha256"] == RunDirectory(tmp_path / "whole").summary["params_sha256"]
