"""What the workers measure: the rows of a training, a chain and a peer; all as commands in the slow tests."""

import dataclasses
import inspect
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pandas as pd
import pytest

from playground import registry
from playground.benchmark import commands
from playground.benchmark import peer as peers
from playground.benchmark.commands import Chain, Compare, Learning, Startup, Topology
from playground.benchmark.measures import peer as peer_measures
from playground.benchmark.measures import runs
from playground.benchmark.schema import Table
from playground.benchmark.worker import ROW, Rows
from playground.errors import ConfigError
from playground.files import read_csv, write_json
from tests.dummy import Point

PEER = {"name": "some", "python": sys.executable, "path": "", "menagerie": ""}
CHECKOUT = Path(__file__).parents[2]
SMALL = ["agent.num_envs=16", "agent.batch_size=16", "agent.num_minibatches=1", "agent.unroll_length=5"]
SMALL += ["agent.num_updates_per_batch=1", "agent.num_eval_envs=2"]
TOPOLOGIES = ("hardware.devices=1", "hardware.devices=2", "hardware.devices=2 hardware.scale_envs=true")


def rows(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
  lines = capsys.readouterr().out.splitlines()
  return [json.loads(line.removeprefix(ROW)) for line in lines if line.startswith(ROW)]


def test_a_training(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
  from playground.benchmark.measures import training

  monkeypatch.setattr(registry, "load", lambda name, config: Point())
  training.measure(Rows(), "CartpoleBalance", "ppo", SMALL, seeds=[3, 4], seconds=0.2)
  found = rows(capsys)
  assert [(row["quantity"], row["seed"]) for row in found] == [
    ("trace_s", 3), ("compile_s", 3), ("start_to_first_update_s", 3),
    ("training_steps_per_s", 3), ("training_steps_per_s", 4),
  ]  # fmt: skip
  assert all(row["value"] > 0 and row["backend"] == "jax" and row["devices"] == 1 for row in found)
  assert found[0]["conditions"] == "hyperparameters ppo/CartpoleBalance"
  assert "s timed after the first update" in found[-1]["conditions"]


def test_agents_in_one_program_have_seeds_of_their_own(monkeypatch: pytest.MonkeyPatch):
  from playground.benchmark.measures import subject

  monkeypatch.setattr(registry, "load", lambda name, config: Point())
  rows = Rows()
  two = subject.Subject.build(rows, "CartpoleBalance", "ppo", SMALL, num_agents=2)
  assert two.trainer.num_agents == 2
  assert two.key(3).tolist() == [jax.random.PRNGKey(seed).tolist() for seed in (3, 4)]
  plan = commands.Together(tasks=["CartpoleBalance"], num_agents=[1, 5])
  settings = [(job.columns["setting"], job.arguments["num_agents"]) for job in plan.jobs(1)]
  assert settings == [("num_agents=1", 1), ("num_agents=5", 5)]


def test_rate_counts_all_of_the_time():
  from playground.benchmark.measures.subject import rate

  calls = []
  speed, taken = rate(lambda count: calls.append(count), steps=10, seconds=0.05)
  assert taken >= 0.05
  assert math.isclose(speed, 10 * sum(calls[1:]) / taken)


def write_chain(run: Path, final_return: float = 4.0) -> None:
  """A finished chain of two stages."""
  manifest = {"impl": "jax", "num_devices": 1, "matmul_precision": "highest", "network_precision": "highest"}
  manifest |= {"platform": "gpu", "device": "another GPU", "versions": {"python": "3.12", "jax": "0.1", "torch": "2"}}
  manifest["git"] = {"commit": "0123456789", "dirty": True}
  one = {"name": "walk", "folder": "1_walk", "env": "A", "final_return": 3.0, "steps": 100, "wall_clock_s": 5.0}
  two = {"name": "run", "folder": "2_run", "env": "B", "final_return": 4.0, "steps": 50, "wall_clock_s": 2.0}
  whole = {"env": "B", "final_return": final_return, "steps": 150, "wall_clock_s": 7.0, "stages": [one, two]}
  for folder in ("1_walk", "2_run"):
    (run / folder).mkdir(parents=True, exist_ok=True)
    write_json(run / folder / "manifest.json", manifest)
    write_json(run / folder / "status.json", {"status": "finished"})
  write_json(run / "summary.json", whole)
  write_json(run / "status.json", {"status": "finished"})


def test_a_finished_chain_is_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  write_chain(tmp_path / "some_chain_seed_2")
  runs.chain(Rows(), "some_chain", [], str(tmp_path), again=False, devices=1, seeds=[2])
  given = rows(capsys)
  found = {(row["setting"], row["quantity"]): row["value"] for row in given}
  assert found["stage=walk", "final_return"] == 3.0 and found["stage=run", "wall_clock_s"] == 2.0
  assert found["stage=all", "wall_clock_s"] == 7.0 and found["stage=all", "steps"] == 150
  of_the_run = {"commit": "0123456+", "device": "another GPU", "devices": 1, "versions": "Python 3.12; JAX 0.1"}
  assert all(row.items() >= of_the_run.items() for row in given), "whatever reads it"


def test_rows_of_a_resumed_chain_name_the_machine_of_each_stage(
  monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
  run = tmp_path / "some_chain_seed_2"
  write_chain(run)
  for path in (run / "status.json", run / "2_run" / "status.json"):
    write_json(path, {"status": "preempted"})
  monkeypatch.setattr(runs, "run_training", lambda overrides: write_chain(run))
  runs.chain(Rows(), "some_chain", [], str(tmp_path), again=False, devices=1, seeds=[2])
  devices = {row["setting"]: row.get("device") for row in rows(capsys)}
  assert devices == {"stage=walk": "another GPU", "stage=run": None, "stage=all": None}, "None is this machine"


def test_a_chain_of_other_overrides_or_again_is_another_run(
  monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
  begun: list[str] = []

  def train(overrides: list[str]) -> None:
    begun.append(overrides[-1])
    write_chain(Path(overrides[-1].partition("=")[2]), final_return=10.0 * len(begun))

  def measured(overrides: list[str], again: bool = False, devices: int = 1) -> float:
    runs.chain(Rows(), "some_chain", overrides, str(tmp_path), again, devices, seeds=[2])
    return next(r["value"] for r in rows(capsys) if r["quantity"] == "final_return" and "stage=all" in r["setting"])

  monkeypatch.setattr(runs, "run_training", train)
  assert [measured(["a=1"]), measured(["a=2"]), measured([]), measured(["a=1"])] == [10.0, 20.0, 30.0, 10.0]
  assert [measured(["a=1"], again=True), measured([], again=True)] == [40.0, 50.0]
  assert len(set(begun)) == 5, "nothing is overwritten"
  assert [measured([], devices=4), measured([], devices=4)] == [60.0, 60.0]

  stopped = tmp_path / "some_chain_seed_2_2"
  (stopped / "status.json").write_text('{"status": "preempted"}')
  (stopped / "config.yaml").touch()
  assert measured([], again=True) == 70.0 and begun[-1] == f"resume={stopped}"


def test_a_peer(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  result = {"start_s": 2.0, "epochs": [1.0, 4.0, 2.0, 3.0], "epoch_steps": 1000, "update_steps": 100}
  result |= {"versions": "JAX 1", "settings": "num_envs 8", "peak_memory_gib": 1.5}
  driver = tmp_path / "driver.py"
  driver.write_text(f"print('noise'); print('RESULT ' + {json.dumps(result)!r})")
  monkeypatch.setitem(peers.PEERS, "some", peers.Peer(driver, "some", "1"))
  arguments = {"task": "CheetahRun", "seconds": 1.0, "peer": PEER}
  peer_measures.rates(Rows(), **arguments, backend="jax", seeds=[1])
  found = {row["quantity"]: row["value"] for row in rows(capsys)}
  # The best epoch; the first epoch's end less what is beyond its first update, at that speed.
  assert found == {"training_steps_per_s": 500.0, "start_to_first_update_s": 1.2, "peak_memory_gib": 1.5}

  driver.write_text("raise SystemExit('it broke')")
  with pytest.raises(peer_measures.PeerFailedError, match="it broke"):
    peer_measures.rates(Rows(), **arguments, backend="jax", seeds=[1])


def without_time(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
  """Checks the row of the whole command's time, and returns the others."""
  (command,) = (row for row in found if row["quantity"] == "command_s")
  assert 0 < command["value"] < 60 and command["unit"] == "s"
  return [row for row in found if row is not command]


def test_a_peer_that_evaluates(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  result = {"evaluations": [[0, 9.0, 0.0], [1000, 7.0, 30.25], [2000, 6.0, 40.5]], "steps": 2000, "wall_clock_s": 40.5}
  result |= {"training_steps_per_s": 100.0, "versions": "JAX 1", "settings": "num_evals 3"}
  driver = tmp_path / "driver.py"
  driver.write_text(f"import sys; print(sys.argv[1], file=open({str(tmp_path / 'job')!r}, 'w'))\n")
  with driver.open("a") as file:
    file.write(f"print('RESULT ' + {json.dumps(result)!r})")
  monkeypatch.setitem(peers.PEERS, "some", peers.Peer(driver, "some", "1"))
  arguments = {"task": "CheetahRun", "num_timesteps": None, "peer": PEER}
  arguments |= {"agent": "sac", "backend": "warp", "setting": ["env.impl=warp"]}
  arguments |= {"seeds": [2]}
  peer_measures.whole(Rows(), **arguments)
  found = without_time(rows(capsys))
  assert [(row["quantity"], row["value"], row.get("setting")) for row in found] == [
    ("return", 9.0, "env.impl=warp step=0"), ("return", 7.0, "env.impl=warp step=1000"),
    ("return", 6.0, "env.impl=warp step=2000"), ("steps", 2000, None), ("wall_clock_s", 40.5, None),
    ("training_steps_per_s", 100.0, None), ("best_return", 7.0, None), ("final_return", 6.0, None),
  ]  # fmt: skip
  assert all(row["seed"] == 2 and row["backend"] == "warp" and "num_evals 3" in row["conditions"] for row in found)
  assert found[1]["conditions"].endswith("; after 30.2 s") and "after" not in found[-1]["conditions"].split(";")[-1]
  job = {"task": "CheetahRun", "agent": "sac", "backend": "warp", "seed": 2, "evaluate": True, "num_timesteps": None}
  assert json.loads((tmp_path / "job").read_text()) == job

  driver.write_text("import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
  with pytest.raises(peer_measures.PeerFailedError, match="some failed: no output"):
    peer_measures.whole(Rows(), **arguments)
  assert rows(capsys) == []


def test_a_run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
  given = []

  def train(overrides: list[str]) -> None:
    given.extend(overrides)
    folder = Path(overrides[-1].removeprefix("run_dir="))
    folder.mkdir()
    manifest = {"impl": "warp", "num_devices": 1, "matmul_precision": "highest", "network_precision": "highest"}
    write_json(folder / "manifest.json", {**manifest, "timings": {"steady_steps_per_second": 50.0}})
    scores = {
      "best_return": 4.0,
      "final_return": 3.0,
      "final_mode_return": 8.0,
      "steps": 200,
      "steps_per_second": 45.0,
      "wall_clock_s": 7.5,
    }
    write_json(folder / "summary.json", {"status": "finished", **scores})
    columns = "step,time/wall_clock_s,eval/episode_reward,eval/mode/episode_reward"
    lines = [columns, "0,0.5,1.0,2.0", "50,1.5,,", "100,3.0,4.0,5.0", "200,7.0,3.0,8.0"]
    (folder / "metrics.csv").write_text("\n".join(lines))

  monkeypatch.setattr(runs, "run_training", train)
  overrides, told = ["agent.num_timesteps=200", "hardware.devices=1"], ["agent.num_timesteps=200"]
  runs.whole(Rows(), "CheetahRun", "ppo", overrides, told, seeds=[3])
  found = without_time(rows(capsys))
  setting = "agent.num_timesteps=200 step="
  assert [(row["quantity"], row["value"], row.get("setting")) for row in found] == [
    ("return", 1.0, f"{setting}0"), ("return", 4.0, f"{setting}100"), ("return", 3.0, f"{setting}200"),
    ("mode_return", 2.0, f"{setting}0"), ("mode_return", 5.0, f"{setting}100"), ("mode_return", 8.0, f"{setting}200"),
    ("steps", 200, None), ("wall_clock_s", 7.5, None), ("training_steps_per_s", 50.0, None),
    ("best_return", 4.0, None), ("final_mode_return", 8.0, None), ("final_return", 3.0, None),
  ]  # fmt: skip
  assert all(row["seed"] == 3 and row["backend"] == "warp" and row["devices"] == 1 for row in found)
  assert found[1]["conditions"].endswith("; after 3.0 s")
  chosen = ["env=CheetahRun", "agent=ppo", "agent.num_timesteps=200", "hardware.devices=1", "seed=3"]
  assert given[:-1] == [*chosen, "video.enable=false", "tracking=csv"]
  assert not Path(given[-1].removeprefix("run_dir=")).exists(), "it leaves nothing behind"


def test_learning_is_ours_and_then_the_peer_for_as_many_steps(monkeypatch: pytest.MonkeyPatch):
  own = Learning(tasks=("CheetahRun", "HopperHop"), seeds=2, backends=("jax", "warp"), peer_python="py").jobs(1)
  assert [(job.columns["task"], job.arguments["seeds"], job.measure) for job in own] == [
    (task, [seed], measure)
    for task in ("CheetahRun", "HopperHop") for seed in (1, 2) for measure in ("runs:whole", "peer:whole", "peer:whole")
  ]  # fmt: skip
  assert [job.columns["setting"] for job in own[:3]] == ["", "env.impl=jax", "env.impl=warp"]
  assert [(job.columns["agent"], job.columns["who"]) for job in own[:2]] == [
    ("ppo_v020", "ours"), ("ppo", "playground 0.2.0"),
  ]  # fmt: skip
  assert all(job.last == {"quantity": "final_return"} for job in own)

  given = Learning(tasks=("CheetahRun",), num_timesteps=5000, overrides=("env.impl=jax",))
  ours, peer = given.jobs(1)
  assert ours.columns["setting"] == "env.impl=jax agent.num_timesteps=5000"
  told = ["env.impl=jax", "agent.num_timesteps=5000"]
  overrides = [*told, "hardware.devices=1"]
  assert ours.arguments == {
    "task": "CheetahRun", "agent": "ppo_v020", "overrides": overrides, "setting": told, "seeds": [1],
  }  # fmt: skip
  setting = "env.impl=jax env.impl=warp agent.num_timesteps=5000"
  assert peer.columns["setting"] == " ".join(peer.arguments["setting"]) == setting
  assert peer.arguments["num_timesteps"] == 5000 and peer.arguments["backend"] == "warp"

  monkeypatch.setattr(commands, "check_peer", lambda *_: None)
  given.check()


@pytest.mark.parametrize("command", [Learning, Topology])
def test_the_budget_of_whole_runs_is_checked(monkeypatch: pytest.MonkeyPatch, command: type[Learning | Topology]):
  monkeypatch.setattr(commands, "check_peer", lambda *_: None)
  command(tasks=("CheetahRun",), num_timesteps=1).check()
  for overrides in (("agent.num_timesteps=5",), ("env.impl=jax", "++agent.num_timesteps=5")):
    for steps in (None, 5):
      with pytest.raises(ConfigError, match=rf"no override of {command.name}: give num_timesteps="):
        command(tasks=("CheetahRun",), num_timesteps=steps, overrides=overrides).check()
  with pytest.raises(ConfigError, match=r"^num_timesteps=0 must be a whole number from 1 to"):
    command(tasks=("CheetahRun",), num_timesteps=0).check()


def test_sac_is_compared_in_learning_alone(monkeypatch: pytest.MonkeyPatch):
  monkeypatch.setattr(commands, "check_peer", lambda *_: None)
  learning = Learning(tasks=("CheetahRun",), agent="sac")
  learning.check()
  ours, peer = learning.jobs(1)
  assert (ours.arguments["agent"], ours.columns["agent"]) == ("sac_v020", "sac_v020")
  assert (peer.arguments["agent"], peer.columns["agent"]) == ("sac", "sac")
  with pytest.raises(ConfigError, match=r"compare is of ppo"):
    Compare(tasks=("CheetahRun",), agent="sac").check()
  with pytest.raises(ConfigError, match=r"SAC on DM Control alone, not PandaPickCube"):
    Learning(tasks=("CheetahRun", "PandaPickCube"), agent="sac").check()


def test_rows_of_another_number_of_devices_are_not_those_of_all(tmp_path: Path):
  table = Table(tmp_path / "rows.csv")
  for command in (Startup(tasks=("CheetahRun",)), Chain()):
    (job,) = command.jobs(1)
    table.add({**job.columns, **job.last, "seed": 1, "device": "a GPU", "value": 1.0})
    assert job.left(table, "a GPU") is None
    (on_four,) = command.jobs(4)
    assert on_four.left(table, "a GPU") == on_four


def test_the_machine_is_asked_about_the_hardware_of_the_overrides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  probed: list[str] = []

  def probe(overrides: list[str], gpus: list[int]) -> tuple[int, dict[str, str]]:
    probed.extend(overrides)
    return 1, {"device": "a GPU", "versions": ""}

  monkeypatch.setattr(commands, "probe", probe)
  monkeypatch.setattr(commands, "run_jobs", lambda *_: 0)
  hardware = ["++hardware=cpu", "+hardware.devices=1", "hardware.kind=null"]
  command = Startup(tasks=("CheetahRun",), out=str(tmp_path / "rows.csv"), overrides=("env.impl=jax", *hardware))
  assert commands.run(command) == 0
  assert probed == ["env=CartpoleBalance", *hardware]


def test_topology_has_all_devices_and_may_have_several_workers():
  Topology(tasks=("CheetahRun",), workers=4).check()
  with pytest.raises(ConfigError, match=r"gpus=\[0, 1\]: topology uses the devices itself"):
    Topology(tasks=("CheetahRun",), gpus=(0, 1)).check()


def test_topology_trains_whole_runs_after_the_rates():
  rates = Topology(tasks=("CheetahRun",), seeds=2, overrides=("env.impl=jax",))
  both = dataclasses.replace(rates, num_timesteps=5000).jobs(2)
  assert both[:3] == rates.jobs(2) and {job.measure for job in both[3:]} == {"runs:whole"}
  settings = [f"env.impl=jax {text} agent.num_timesteps=5000" for text in TOPOLOGIES]
  assert [(job.columns["setting"], job.arguments["seeds"]) for job in both[3:]] == [
    (setting, [seed]) for setting in settings for seed in (1, 2)
  ]
  for job in both[3:]:
    assert job.last == {"quantity": "final_return"} and job.columns["benchmark"] == "topology"
    assert job.arguments["overrides"] == job.arguments["setting"] == job.columns["setting"].split()
    job_of_run = inspect.signature(runs.whole).parameters
    assert set(job.arguments) == set(job_of_run) - {"rows"}


def test_whole_runs_that_were_stopped_go_on_where_they_are_missing(tmp_path: Path):
  jobs = Topology(tasks=("CheetahRun",), seeds=2, devices=(1,), num_timesteps=5000).jobs(1)
  table, rows = Table(tmp_path / "rows.csv"), {"device": "a device"}
  left = lambda: [(job.measure, job.arguments["seeds"]) for each in jobs if (job := each.left(table, "a device"))]
  whole = {**jobs[1].columns, **rows, "seed": 1}
  table.add({**whole, "quantity": "training_steps_per_s", "value": 1.0})
  assert left() == [("training", [1, 2]), ("runs:whole", [1]), ("runs:whole", [2])], (
    "its rate is not that of the rates, nor its end"
  )
  table.add({**whole, "quantity": "final_return", "value": 1.0})
  table.add({**jobs[0].columns, **rows, "seed": 1, "quantity": "training_steps_per_s", "value": 1.0})
  assert left() == [("training", [2]), ("runs:whole", [2])]


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
  num_timesteps=1, num_evals=3, num_resets_per_eval=1, num_eval_envs=2, episode_length=20,
  num_envs=8, batch_size=8, num_minibatches=1, unroll_length=2,
  num_updates_per_batch=1, action_repeat=1, network_factory=dict(policy_hidden_layer_sizes=(8,))))
params.brax_sac_config = lambda name, impl: dict(
  num_timesteps=1, num_evals=3, num_eval_envs=2, episode_length=20, num_envs=8, batch_size=8, grad_updates_per_step=2,
  min_replay_size=16, max_replay_size=64, action_repeat=1, num_resets_per_eval=1,
  network_factory=dict(hidden_layer_sizes=(8,)))
module("config", dm_control_suite_params=params, locomotion_params=params, manipulation_params=params)
"""


@pytest.mark.slow
def test_the_peers_driver_trains_with_brax(tmp_path: Path):
  (tmp_path / "mujoco_playground").mkdir()
  (tmp_path / "mujoco_playground" / "__init__.py").write_text(FAKE)
  driver = peers.PEERS["playground020"].driver

  def drive(agent: str, **job: Any) -> dict[str, Any]:
    job |= {"task": "CartpoleBalance", "agent": agent, "backend": "jax", "seed": 1}
    done = subprocess.run(
      [sys.executable, str(driver), json.dumps(job)], capture_output=True, text=True,
      env={"PYTHONPATH": f"{tmp_path}:{CHECKOUT}", "PATH": "", "JAX_PLATFORMS": "cpu"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1].removeprefix("RESULT "))

  result = drive("ppo", steps=40, epochs=3)
  assert len(result["epochs"]) == 3 and result["epoch_steps"] == 48 and result["update_steps"] == 16
  result = drive("ppo", evaluate=True, num_timesteps=64)  # three evaluations, two updates between them
  assert [step for step, _, _ in result["evaluations"]] == [0, 32, 64] and result["steps"] == 64
  scores, moments = [score for _, score, _ in result["evaluations"]], [moment for _, _, moment in result["evaluations"]]
  assert all(0 < score <= 20 for score in scores), "sums of rewards of at most 1"
  assert moments == sorted(moments) and moments[0] == 0 and result["wall_clock_s"] == moments[-1]
  assert result["training_steps_per_s"] > 0 and "num_evals 3, num_resets_per_eval 1" in result["settings"]
  result = drive("sac", evaluate=True, num_timesteps=64)
  steps = [step for step, _, _ in result["evaluations"]]
  assert len(steps) == 3 and steps[0] == 0 and result["steps"] == steps[-1] >= 64
  assert result["training_steps_per_s"] > 0 and "grad_updates_per_step 2" in result["settings"]


@pytest.mark.slow
def test_every_measuring_command_runs(tmp_path: Path):
  small = ["tasks=CartpoleBalance", "seconds=0.2", "cache=true", "hardware=cpu", *SMALL]
  two = "hardware.xla_flags='--xla_force_host_platform_device_count=2'"
  given = {
    "throughput": ["seeds=2"],
    "breakdown": [],
    "scaling": ["num_envs=8,32"],
    "topology": [two, "seeds=1", "devices=1,2", "hyperparameters=scaled", "num_timesteps=320", "agent.num_evals=2"],
    "startup": [],
    "together": ["num_agents=1,2"],
  }
  for name, extra in given.items():
    command = [sys.executable, "-m", "playground.cli.bench", name, *small, *extra, f"out={tmp_path / name}.csv"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=CHECKOUT)
    assert done.returncode == 0, done.stdout + done.stderr
    for row in read_csv(tmp_path / f"{name}.csv"):  # nothing is traced where the program of an earlier start is read
      assert float(row["value"]) > 0 or row["quantity"] == "trace_s", row
  parts = pd.read_csv(tmp_path / "breakdown.csv")["setting"]
  assert [text.split()[-1] for text in parts] == [
    f"part={part}" for part in ("physics", "task", "episodes", "inference", "storing", "update")
  ]
  topology = pd.read_csv(tmp_path / "topology.csv")
  assert set(topology["devices"]) == {1, 2}
  runs = topology[topology["setting"].str.contains("agent.num_timesteps=320")]
  assert len(topology[topology["quantity"] == "training_steps_per_s"]) == 4 and set(runs["devices"]) == {1, 2}
  for quantity, ending in (("wall_clock_s", ""), ("final_return", ""), ("return", " step=320")):
    settings = {text.partition("agent.num_evals=2 ")[2] for text in runs[runs["quantity"] == quantity]["setting"]}
    assert {f"{text} agent.num_timesteps=320{ending}" for text in (TOPOLOGIES[0], TOPOLOGIES[2])} <= settings
  assert {"env_steps_per_s", "training_steps_per_s"} <= set(pd.read_csv(tmp_path / "scaling.csv")["quantity"])
