"""One training on several devices and processes: what is the same everywhere, and what goes on where."""

import json
import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from playground.config import compose
from playground.errors import ConfigError, HardwareError
from playground.hardware import distributed
from playground.runs.scaling import describe_division, scale_envs
from tests.processes import COMMAND, ended, start, two_processes

LINE = ["env=CartpoleBalance", "tuned=null", "debug=fast", "tracking=csv"]

# Trains through `train`; each process knows the checksum of the parameters that it ends with.
TRAIN = """
import sys
import jax, numpy as np
from playground.config import compose
from playground.learning.checkpoints import checksum
from playground.learning.loop import Loop
from playground.runs.callbacks import RunCallbacks
from playground.runs.train import train

run, ended = Loop.run, []

def remember(loop, *args):
  state, completed = run(loop, *args)
  ended.append(checksum([np.asarray(x) for x in jax.device_get(jax.tree.leaves(loop.trainer.policy(state)))]))
  return state, completed

Loop.run = remember

def trained(*overrides, until=None):
  RunCallbacks.should_stop = lambda job: until is not None and job._step >= until
  code = train(compose([*sys.argv[1:], *overrides]))
  assert code == 0, code
  return ended[-1]
"""
POINT = """
from playground import registry
from tests.dummy import Point

registry.load = lambda *_, **__: Point()
"""
THERE_AND_BACK = """
import json
results = [trained("hardware.devices=2", "run_dir=run", until=400)]
sys.argv[1:] = []
results.append(trained("resume=run", "hardware.devices=1", until=960))
results.append(trained("resume=run", "hardware.devices=2"))
print(json.dumps(results))
"""


def test_checkpoints_go_on_on_another_topology(tmp_path: Path) -> None:
  """From two devices to one, and back."""
  line = [*LINE, "agent.num_timesteps=1600", "agent.num_evals=5", "hardware=cpu"]
  process = start(TRAIN + POINT + THERE_AND_BACK, tmp_path, *line, devices=2)
  out, _ = process.communicate(timeout=800)
  assert process.returncode == 0, out[-3000:]
  *_, ours = json.loads(out.strip().splitlines()[-1])
  summary = json.loads((tmp_path / "run/summary.json").read_text())
  assert (summary["status"], summary["steps"], summary["params_sha256"]) == ("finished", 1600, ours)
  table = pd.read_csv(tmp_path / "run/metrics.csv")
  assert table["step"].is_unique and table["step"].is_monotonic_increasing, "nothing is trained twice"
  assert table["eval/episode_reward"].dropna().is_unique, "every part changes the policy"
  assert "On each of 2 devices: 4 of agent.num_envs=8, 4 of agent.batch_size=8, 2 of agent.num_eval_envs=4." in out
  assert "It was written on 2 devices: on 1, all of it goes on, but random numbers and rounding differ" in out
  assert "It was written on 1 device: on 2," in out


@pytest.mark.parametrize("task", ["point", pytest.param("cart and pole", marks=pytest.mark.slow)])
def test_two_processes_are_one_training(task: str, tmp_path: Path) -> None:
  """Two devices each: the same parameters everywhere, one run directory; of the cart one process's return curve."""
  params = "{field:dof_damping,target:all,operation:scale,range:[0.5,2.0]}"
  damping = f"env.events.damping={{mode:startup,func:model_field,params:{params}}}"
  line = [*LINE, "agent.num_timesteps=640", "agent.num_evals=3", "run_dir=run"]
  line += [] if task == "point" else [damping]
  script = TRAIN + (POINT if task == "point" else "") + "print(trained(), jax.process_index(), jax.device_count())"
  first, second = ended(two_processes(tmp_path, script, *line))
  ours, *place = first.strip().splitlines()[-1].split()
  assert place == ["0", "4"]
  assert second.strip().splitlines()[-1].split() == [ours, "1", "4"], "the same parameters"
  summary = json.loads((tmp_path / "run/summary.json").read_text())
  assert (summary["status"], summary["steps"], summary["params_sha256"]) == ("finished", 640, ours)
  assert [path.name for path in tmp_path.iterdir()] == ["run"]
  assert "finished" not in second and "metrics" not in second, "only process 0 reports"
  curve = pd.read_csv(tmp_path / "run/metrics.csv")["eval/episode_reward"].dropna().to_numpy()
  assert len(set(curve)) == 3, "the policy changes"
  if task == "point":
    return

  alone = start(script, tmp_path, *line, "hardware=cpu", "hardware.devices=4", "run_dir=alone", devices=4)
  out, _ = alone.communicate(timeout=800)
  assert alone.returncode == 0, out[-3000:]
  its = pd.read_csv(tmp_path / "alone/metrics.csv")["eval/episode_reward"].dropna().to_numpy()
  np.testing.assert_allclose(curve, its, atol=0.01)


# What cannot be


def hardware(*overrides: str) -> Any:
  return compose(["env=CartpoleBalance", *overrides]).hardware


THREE_KEYS = ("hardware=multi_node", "hardware.distributed.coordinator=localhost:1")
THREE_KEYS += ("hardware.distributed.num_processes=2", "hardware.distributed.process_id=0")


@pytest.mark.parametrize(
  ("overrides", "words"),
  {
    ("hardware=multi_node",): ["finds no cluster here", "hardware.distributed.coordinator=<host:port>"],
    ("hardware=multi_node", "hardware.distributed.process_id=1"): ["hardware.distributed.coordinator is missing"],
    ("hardware.distributed.process_id=1",): ["hardware.distributed.process_id needs hardware=multi_node."],
    (*THREE_KEYS, "hardware.distributed.coordinator=here"): ["coordinator=here must be <host>:<port>."],
    (*THREE_KEYS, "hardware.distributed.process_id=2"): ["process_id=2 must be from 0 to 1"],
  }.items(),
)
def test_too_little_is_said_of_the_others(
  overrides: tuple[str, ...], words: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
  for name in [name for name in os.environ if name.startswith(("SLURM", "OMPI"))]:
    monkeypatch.delenv(name)
  with pytest.raises(ConfigError) as caught:
    distributed.init_distributed(hardware(*overrides))
  assert all(word in str(caught.value) for word in words)


def test_a_coordinator_that_is_not_there() -> None:
  with socket.socket() as taken:  # bound, but nobody listens
    taken.bind(("localhost", 0))
    address = f"localhost:{taken.getsockname()[1]}"
    keys = {"coordinator": address, "num_processes": 2, "process_id": 1, "timeout": 0.3}
    with pytest.raises(HardwareError) as caught:
      distributed.init_distributed(
        hardware("hardware=multi_node", *(f"hardware.distributed.{k}={v}" for k, v in keys.items()))
      )
  assert f"coordinator={address} could not be reached" in str(caught.value)
  assert "Connection refused" in str(caught.value)


def test_others_that_do_not_come(tmp_path: Path) -> None:
  """To process 0, which alone waits for them in JAX: that would abort it."""
  with socket.socket() as free:
    free.bind(("localhost", 0))
    keys = {"coordinator": f"localhost:{free.getsockname()[1]}", "num_processes": 2, "process_id": 0, "timeout": 2}
  line = [
    *LINE,
    "hardware=multi_node",
    "hardware.platform=cpu",
    *(f"hardware.distributed.{k}={v}" for k, v in keys.items()),
  ]
  process = start(COMMAND, tmp_path, *line)
  out, _ = process.communicate(timeout=200)
  assert process.returncode == 2, out[-2000:]
  said = out.strip().splitlines()[-1]
  assert said.startswith("error: hardware=multi_node: not all of 2 processes at localhost:")
  assert said.endswith("came within hardware.distributed.timeout=2 s.")


def test_an_exchange_that_does_not_end(monkeypatch: pytest.MonkeyPatch) -> None:
  from jax.experimental import multihost_utils

  monkeypatch.setattr(distributed, "is_multiprocess", lambda: True)
  monkeypatch.setattr(multihost_utils, "process_allgather", lambda x: time.sleep(1))
  config = hardware("hardware.distributed.timeout=0.2")
  with pytest.raises(HardwareError, match=r"a first exchange between their devices did not end within .*=0\.2 s"):
    distributed.preflight(config, {})
  monkeypatch.setattr(multihost_utils, "process_allgather", lambda x: [x, x + 1])
  with pytest.raises(ConfigError, match="Process 1 has another configuration than process 0"):
    distributed.preflight(config, {})


FAIL = """
import os, signal, sys, time
import jax
from playground.config import compose
from playground.errors import ConfigError
from playground.hardware.distributed import ending_together, wait_for_all
from playground.hardware.setup import setup

config = compose(sys.argv[1:])
with ending_together():
  setup(config.hardware)
  if jax.process_index() == int(os.environ["FAILS"]):
    raise ConfigError("This does not work.")
  wait_for_all()
"""


@pytest.mark.parametrize("fails", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_process_that_fails_says_so_to_the_others(
  fails: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  monkeypatch.setenv("FAILS", str(fails))
  processes = two_processes(tmp_path, FAIL, "env=CartpoleBalance", devices=1)
  said = [process.communicate(timeout=200)[0] for process in processes]
  assert [process.returncode for process in processes] == [2, 2], said
  assert said[fails].splitlines()[-1] == "error: This does not work."
  sentence = f"process {fails} on {socket.gethostname()} failed: This does not work."
  assert said[1 - fails].splitlines()[-1] == f"error: hardware=multi_node: {sentence}"


# hardware.scale_envs


def test_environments_and_batch_are_multiplied() -> None:
  config = compose(["env=CartpoleBalance", "tuned=null", "hardware.scale_envs=true"])
  scaled, notice = scale_envs(config, 4)
  assert notice == "hardware.scale_envs: 4 devices, so agent.num_envs 2048 -> 8192, agent.batch_size 1024 -> 4096."
  assert (scaled.agent.num_envs, scaled.resolved["agent"]["batch_size"]) == (8192, 4096)
  assert scaled.agent.num_minibatches == config.agent.num_minibatches
  assert not scaled.hardware.scale_envs and not scaled.resolved["hardware"]["scale_envs"], "a resumed run keeps them"
  assert describe_division(scaled.agent, 4) == (
    "On each of 4 devices: 2048 of agent.num_envs=8192, 1024 of agent.batch_size=4096, 32 of agent.num_eval_envs=128."
  )


def test_all_stages_of_a_chain_are_scaled() -> None:
  config = compose(["experiment=go1_joystick_chain", "hardware.scale_envs=true"])
  scaled, _ = scale_envs(config, 2)
  assert [s.agent.num_envs for s in scaled.stages] == [2 * s.agent.num_envs for s in config.stages]
