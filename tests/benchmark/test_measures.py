"""What the workers measure: the rows of a training, a chain and a peer; all as commands in the slow tests."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from playground import registry
from playground.benchmark import peer as peers
from playground.benchmark.worker import ROW, Facts
from playground.runs.files import write_json
from tests.dummy import Point

CHECKOUT = Path(__file__).parents[2]
SMALL = ["agent.num_envs=16", "agent.batch_size=16", "agent.num_minibatches=1", "agent.unroll_length=5"]
SMALL += ["agent.num_updates_per_batch=1", "agent.num_eval_envs=2"]


def rows(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
  lines = capsys.readouterr().out.splitlines()
  return [json.loads(line.removeprefix(ROW)) for line in lines if line.startswith(ROW)]


def test_a_training(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
  from playground.benchmark.measures import training

  monkeypatch.setattr(registry, "load", lambda name, config: Point())
  training.measure(Facts(), "CartpoleBalance", "ppo", SMALL, seeds=[3, 4], seconds=0.2, lock=None)
  found = rows(capsys)
  assert [(row["quantity"], row["seed"]) for row in found] == [
    ("trace_s", 3), ("compile_s", 3), ("start_to_first_update_s", 3),
    ("training_steps_per_s", 3), ("training_steps_per_s", 4),
  ]  # fmt: skip
  assert all(row["value"] > 0 and row["backend"] == "jax" and row["devices"] == 1 for row in found)
  assert found[0]["conditions"] == "hyperparameters ppo/CartpoleBalance"
  assert "s timed after the first update" in found[-1]["conditions"]


def test_rate_counts_all_of_the_time():
  from playground.benchmark.measures.subject import rate

  calls = []
  speed, taken = rate(lambda count: calls.append(count), steps=10, seconds=0.05)
  assert taken >= 0.05
  assert math.isclose(speed, 10 * sum(calls[1:]) / taken)


def test_a_finished_chain_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  from playground.benchmark.measures import chain

  run = tmp_path / "some_chain_seed_2"
  manifest = {"impl": "jax", "num_devices": 1, "matmul_precision": "highest", "network_precision": "highest"}
  one = {"name": "walk", "folder": "1_walk", "env": "A", "final_return": 3.0, "steps": 100, "wall_clock_s": 5.0}
  two = {"name": "run", "folder": "2_run", "env": "B", "final_return": 4.0, "steps": 50, "wall_clock_s": 2.0}
  whole = {"env": "B", "final_return": 4.0, "steps": 150, "wall_clock_s": 7.0, "stages": [one, two]}
  for folder in ("", "1_walk", "2_run"):
    (run / folder).mkdir(parents=True)
    write_json(run / folder / "manifest.json", manifest)
  write_json(run / "summary.json", whole)
  write_json(run / "status.json", {"status": "finished"})
  chain.measure(Facts(), "some_chain", [], str(tmp_path), seeds=[2], lock=None)
  found = {(row["setting"], row["quantity"]): row["value"] for row in rows(capsys)}
  assert found["stage=walk", "final_return"] == 3.0 and found["stage=run", "wall_clock_s"] == 2.0
  assert found["stage=all", "wall_clock_s"] == 7.0 and found["stage=all", "steps"] == 150


def test_a_peer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  from playground.benchmark.measures import peer

  result = {"start_s": 2.0, "epochs": [10.0, 4.0, 2.0, 3.0], "epoch_steps": 1000, "update_steps": 100}
  result |= {"versions": "JAX 1", "settings": "num_envs 8", "peak_memory_gib": 1.5}
  driver = tmp_path / "driver.py"
  driver.write_text(f"print('noise'); print('RESULT ' + {json.dumps(result)!r})")
  monkeypatch.setitem(peers.PEERS, "some", (driver, ("some", "1")))
  arguments = {"task": "CheetahRun", "seconds": 1.0, "python": sys.executable, "path": "", "menagerie": ""}
  peer.measure(Facts(), **arguments, peer="some", backend="jax", seeds=[1], lock=None)
  found = {row["quantity"]: row["value"] for row in rows(capsys)}
  # The best epoch; the first epoch's end less what is beyond its first update, at that speed.
  assert found == {"training_steps_per_s": 500.0, "start_to_first_update_s": 10.2, "peak_memory_gib": 1.5}

  driver.write_text("raise SystemExit('it broke')")
  with pytest.raises(peer.PeerFailedError, match="it broke"):
    peer.measure(Facts(), **arguments, peer="some", backend="jax", seeds=[1], lock=None)


FAKE = """
import sys, types
import playground
def module(name, **contents):
  made = types.ModuleType("mujoco_playground." + name); made.__dict__.update(contents)
  sys.modules[made.__name__] = made; globals()[name] = made
  return made
module("registry", load=lambda name, config_overrides: playground.load(name), get_default_config=lambda name: {},
       get_domain_randomizer=lambda name: None)
module("wrapper", wrap_for_brax_training=playground.wrap_for_brax_training)
module("dm_control_suite", _envs=["CartpoleBalance"])
module("locomotion", _envs=[])
params = types.SimpleNamespace(brax_ppo_config=lambda name, impl: dict(
  num_timesteps=1, num_evals=1, episode_length=20, num_envs=8, batch_size=8, num_minibatches=1, unroll_length=2,
  num_updates_per_batch=1, action_repeat=1, network_factory=dict(policy_hidden_layer_sizes=(8,))))
module("config", dm_control_suite_params=params, locomotion_params=params, manipulation_params=params)
"""


@pytest.mark.slow
def test_the_peers_driver_trains_with_brax(tmp_path: Path):
  (tmp_path / "mujoco_playground").mkdir()
  (tmp_path / "mujoco_playground" / "__init__.py").write_text(FAKE)
  driver, _ = peers.PEERS["playground020"]
  job = {"task": "CartpoleBalance", "backend": "jax", "seed": 1, "steps": 40, "epochs": 3}
  done = subprocess.run(
    [sys.executable, str(driver), json.dumps(job)], capture_output=True, text=True,
    env={"PYTHONPATH": f"{tmp_path}:{CHECKOUT}", "PATH": "", "JAX_PLATFORMS": "cpu"},
  )  # fmt: skip
  assert done.returncode == 0, done.stderr
  result = json.loads(done.stdout.splitlines()[-1].removeprefix("RESULT "))
  assert len(result["epochs"]) == 3 and result["epoch_steps"] == 48 and result["update_steps"] == 16


@pytest.mark.slow
def test_every_measuring_command_runs(tmp_path: Path):
  small = ["tasks=CartpoleBalance", "seconds=0.2", "cache=true", "hardware=cpu", *SMALL]
  two = "hardware.xla_flags='--xla_force_host_platform_device_count=2'"
  given = {
    "throughput": ["seeds=2"],
    "breakdown": [],
    "scaling": ["num_envs=8,32"],
    "topology": [two, "seeds=1", "devices=1,2"],
    "startup": [],
  }
  for name, extra in given.items():
    command = [sys.executable, "-m", "playground.cli.bench", name, *small, *extra, f"out={tmp_path / name}.csv"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=CHECKOUT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert min(pd.read_csv(tmp_path / f"{name}.csv")["value"]) > 0
  parts = pd.read_csv(tmp_path / "breakdown.csv")["setting"]
  assert [text.split()[-1] for text in parts] == [
    f"part={part}" for part in ("physics", "task", "episodes", "inference", "storing", "update")
  ]
  assert set(pd.read_csv(tmp_path / "topology.csv")["devices"]) == {1, 2}
  assert {"env_steps_per_s", "training_steps_per_s"} <= set(pd.read_csv(tmp_path / "scaling.csv")["quantity"])
