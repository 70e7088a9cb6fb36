"""Chains of runs: what they leave behind, and that nothing that ends one early changes what comes out."""

import functools
import gc
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import mujoco
import pandas as pd
import pytest
import yaml

from playground import registry
from playground.config import RunConfig, compose, config_roots
from playground.errors import CheckpointError, ConfigError
from playground.learning.checkpoints import Checkpoint, checksum, find_checkpoints
from playground.learning.loop import Loop
from playground.physics.backend import PhysicsData
from playground.runs import chain as chain_module
from playground.runs import train as train_module
from playground.runs.callbacks import RunCallbacks
from playground.runs.restore_plan import RestorePlan
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train
from tests.dummy import Point

CHAIN = """
# @package curriculum
defaults:
  - none
  - _self_
stages:
  near: {num_timesteps: 320, overrides: [env.episode_length=10]}
  far: {num_timesteps: 400, overrides: [agent.learning_rate=0.002]}
"""
FAST = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv"]
LINE = [*FAST, "curriculum=mine", "curriculum.scale=1"]
STAGES = ["1_near", "2_far"]
slow = functools.partial(pytest.param, marks=pytest.mark.slow)


class Wide(Point):
  """Another observation than the point's."""

  def _obs(self, data: PhysicsData) -> dict[str, jax.Array]:
    return {key: jax.numpy.tile(value, 2) for key, value in super()._obs(data).items()}


@pytest.fixture(scope="module", autouse=True)
def point() -> Iterator[None]:
  """The point in place of CartpoleBalance, another task in place of any other."""
  load = lambda name, config: (Point if name == "CartpoleBalance" else Wide)(config["episode_length"])
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(registry, "load", load)
    yield


@pytest.fixture(scope="module", autouse=True)
def collected() -> Iterator[None]:
  """Chains collect garbage after every stage: they need not look through what the tests before have left."""
  gc.collect()
  gc.freeze()
  yield
  gc.unfreeze()


@pytest.fixture(scope="module")
def configs(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """Our configs/ with a chain of two stages."""
  folder = Path(shutil.copytree(config_roots()[0], tmp_path_factory.mktemp("chain") / "configs"))
  (folder / "curriculum/mine.yaml").write_text(CHAIN)
  return folder


@pytest.fixture(scope="module")
def composed(configs: Path) -> Callable[..., RunConfig]:
  return lambda *overrides: compose([*LINE, *overrides], configs)


@pytest.fixture(scope="module")
def on_device() -> list[int]:
  """Bytes that JAX holds when a stage of `whole` compiles."""
  return []


@pytest.fixture(scope="module")
def whole(composed: Callable[..., RunConfig], on_device: list[int], tmp_path_factory: pytest.TempPathFactory) -> Path:
  """The chain that nothing happens to."""
  path, compiling = tmp_path_factory.mktemp("whole") / "chain", train_module.compile_program

  def compile_program(*args: Any) -> Any:
    on_device.append(sum(array.nbytes for array in jax.live_arrays()))
    return compiling(*args)

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(train_module, "compile_program", compile_program)
    assert train(composed(f"run_dir={path}")) == 0
  return path


def resume(path: Path) -> int:
  return train(compose([f"resume={path}"]))


def assert_same_result(path: Path, whole: Path) -> None:
  """Same parameters and rows as the chain that was left alone."""
  for folder in ("", *STAGES):
    ours, theirs = RunDirectory(path / folder), RunDirectory(whole / folder)
    assert ours.status["status"] == "finished"
    for key in ("params_sha256", "final_return", "best_return", "best_step", "steps", "status"):
      assert ours.summary[key] == theirs.summary[key], key
  ours, theirs = (pd.read_csv(chain / "metrics.csv").filter(regex="^(?!time/)") for chain in (path, whole))
  pd.testing.assert_frame_equal(ours, theirs, check_like=True, check_exact=True)


def test_every_stage_is_a_run_that_starts_from_the_one_before(whole: Path) -> None:
  near, far = (RunDirectory(whole / folder) for folder in STAGES)
  assert sorted(path.name for path in whole.iterdir() if path.is_dir()) == [*STAGES, "plots"]
  assert [run.config["agent"]["learning_rate"] for run in (near, far)] == [3e-4, 2e-3]
  assert [run.config["env"]["episode_length"] for run in (near, far)] == [10, 10], "what a stage sets stays"
  assert [run.config["init_from"] for run in (near, far)] == [None, str(near.path)]
  assert [run.config["name"] for run in (near, far)] == ["CartpoleBalance/near", "CartpoleBalance/far"]
  assert [run.summary["steps"] for run in (near, far)] == [320, 400]
  for run in (near, far):
    assert compose([f"resume={run.path}"]).stages == (), "a run like any other"
    timings = run.manifest["timings"]
    assert 0 < timings["start_to_compiled_s"] < timings["start_to_first_update_s"]
  assert far.manifest["timings"]["start_to_compiled_s"] < 0.9 * near.manifest["timings"]["start_to_compiled_s"]


def test_a_chain_has_one_curve_and_one_summary(whole: Path) -> None:
  table = pd.read_csv(whole / "metrics.csv")
  assert list(table["step"]) == [0, 80, 160, 240, 320, 320, 400, 480, 560, 640, 720]
  assert list(table["stage"]) == ["near"] * 5 + ["far"] * 6
  assert table["time/wall_clock_s"].is_monotonic_increasing
  assert {path.name for path in (whole / "plots").iterdir()} == {"return_over_steps.png", "return_over_wall_clock.png"}
  chain, far = RunDirectory(whole), RunDirectory(whole / "2_far")
  assert chain.status["status"] == "finished"
  assert list(chain.config["curriculum"]["stages"]) == ["near", "far"]
  summary = chain.summary
  assert [(stage["name"], stage["folder"], stage["status"]) for stage in summary["stages"]] == [
    *(("near", "1_near", "finished"), ("far", "2_far", "finished")),
  ]
  assert (summary["steps"], summary["params_sha256"]) == (720, far.summary["params_sha256"])
  assert (summary["best_return"], summary["best_step"]) == (far.summary["best_return"], far.summary["best_step"])
  assert summary["final_return"] == far.summary["final_return"] == table["eval/episode_reward"].to_numpy()[-1]
  assert summary["wall_clock_s"] == pytest.approx(sum(stage["wall_clock_s"] for stage in summary["stages"]))
  assert find_checkpoints(whole) == find_checkpoints(far.path), "what `init_from` and `playground eval` take"


def test_a_stage_leaves_nothing_on_the_device(whole: Path, on_device: list[int]) -> None:
  first, second = on_device
  assert second <= first + 1024, "the first stage's state alone is larger"
  assert sum(path.stat().st_size for path in (whole / "1_near/checkpoints").rglob("*") if path.is_file()) > 1024


# What ends a chain early


def kill() -> None:
  os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(
  ("moment", "finished", "steps"),
  [
    slow("in the first stage", [], [160, None]),
    slow("at the end of the first stage", ["1_near"], [320, None]),
    ("between the stages", ["1_near"], [320, None]),
    slow("while the second stage compiles", ["1_near"], [320, None]),
    ("in the second stage", ["1_near"], [320, 160]),
  ],
)
def test_a_signal_at_any_moment_changes_nothing(
  moment: str,
  finished: list[str],
  steps: list[int | None],
  whole: Path,
  composed: Callable[..., RunConfig],
  tmp_path: Path,
) -> None:
  path = tmp_path / "chain"
  on_metrics, compiling = RunCallbacks.on_metrics, train_module.compile_program

  def at(stage: str, step: int) -> Callable[..., None]:
    def row(job: RunCallbacks, reached: int, *args: Any) -> None:
      on_metrics(job, reached, *args)
      if (job._run_dir.path.name, reached) == (stage, step):
        assert (path / "metrics.csv").exists() == (stage == "2_far"), "the curve of the stages before"
        kill()

    return row

  def compile_second(*args: Any) -> Any:
    if (path / "2_far/status.json").exists():
      kill()
    return compiling(*args)

  with pytest.MonkeyPatch.context() as patch:
    if moment == "in the first stage":
      patch.setattr(RunCallbacks, "on_metrics", at("1_near", 80))
    elif moment == "at the end of the first stage":
      patch.setattr(RunCallbacks, "on_metrics", at("1_near", 320))
    elif moment == "between the stages":
      patch.setattr(chain_module.gc, "collect", kill)
    elif moment == "while the second stage compiles":
      patch.setattr(train_module, "compile_program", compile_second)
    else:
      patch.setattr(RunCallbacks, "on_metrics", at("2_far", 80))
    assert train(composed(f"run_dir={path}")) == 128 + signal.SIGTERM
  chain = RunDirectory(path)
  assert chain.status["status"] == chain.summary["status"] == "preempted"
  assert f"resume={path} continues" in chain.status["reason"]
  assert [folder for folder in STAGES if RunDirectory(path / folder).status.get("status") == "finished"] == finished
  assert [stage["steps"] for stage in chain.summary["stages"]] == steps
  assert resume(path) == 0
  assert_same_result(path, whole)


def test_a_chain_goes_on_where_it_was_moved_to(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  path = shutil.copytree(whole, tmp_path / "moved")
  for file in (path / "2_far").iterdir():  # as if the power had failed between the stages
    if file.name not in ("config.yaml", "overrides.yaml"):
      shutil.rmtree(file) if file.is_dir() else file.unlink()
  (path / "summary.json").unlink()
  RunDirectory(path).set_status("running", "stage 1_near")
  assert resume(path) == 0
  said = " ".join(capsys.readouterr().out.split())
  assert f"weights and observation statistics of {find_checkpoints(path / '1_near')[0]}" in said
  assert "stopped before its first checkpoint" not in said
  assert_same_result(path, whole)


def test_a_stage_is_not_resumed_before_the_one_it_starts_from(whole: Path, tmp_path: Path) -> None:
  path = shutil.copytree(whole, tmp_path / "cut")
  shutil.rmtree(path / "2_far/checkpoints")
  RunDirectory(path / "2_far").set_status("running")
  RunDirectory(path / "1_near").set_status("preempted")
  with pytest.raises(CheckpointError, match=re.escape(f"{path / '1_near'} is not finished: resume={path} trains it")):
    resume(path / "2_far")


def test_a_chain_may_start_from_a_stage_of_another_of_its_kind(whole: Path, tmp_path: Path) -> None:
  """Whose folder has the name of a later stage, or of its own first one."""
  path = shutil.copytree(whole, tmp_path / "another")
  config = yaml.safe_load((path / "1_near/config.yaml").read_text())
  for stage in ("1_near", "2_far"):
    (path / "1_near/config.yaml").write_text(yaml.safe_dump({**config, "init_from": str(whole / stage)}))
    shutil.rmtree(path / "1_near/checkpoints", ignore_errors=True)
    plan = RestorePlan.find(compose([f"resume={path / '1_near'}"]))
    assert plan.weights is not None and plan.weights.path == find_checkpoints(whole / stage)[0]


def test_the_last_stage_of_a_chain_trains_longer(whole: Path) -> None:
  with pytest.raises(ConfigError, match=f"not for a chain: resume={whole / '2_far'} agent.num_timesteps=9000 trains"):
    compose([f"resume={whole}", "agent.num_timesteps=9000"])
  assert compose([f"resume={whole / '2_far'}", "agent.num_timesteps=9000"]).agent.num_timesteps == 9000


def test_a_finished_chain_is_not_resumed(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
  before = (whole / "status.json").read_bytes()
  assert resume(whole) == 0
  assert f"{whole} is finished: nothing to resume (init_from={whole} trains on" in capsys.readouterr().out
  assert (whole / "status.json").read_bytes() == before


def test_a_damaged_result_of_a_stage_is_found_before_the_next_trains(
  whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  path = shutil.copytree(whole, tmp_path / "chain", symlinks=True)
  RunDirectory(path / STAGES[1]).set_status("preempted")
  RunDirectory(path).set_status("preempted")
  (path / STAGES[0] / "summary.json").write_text("")
  monkeypatch.setattr(train_module, "compile_program", lambda *_: pytest.fail("a stage trains"))
  with pytest.raises(CheckpointError, match=r"summary\.json is damaged"):
    resume(path)


def test_a_finished_chain_takes_in_that_its_last_stage_trains_longer(whole: Path, tmp_path: Path) -> None:
  path = shutil.copytree(whole, tmp_path / "longer", symlinks=True)
  chain, far = RunDirectory(path), RunDirectory(path / "2_far")
  on_metrics = RunCallbacks.on_metrics

  def row(job: RunCallbacks, reached: int, *args: Any) -> None:
    on_metrics(job, reached, *args)
    if reached == 480:
      kill()

  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(RunCallbacks, "on_metrics", row)
    assert train(compose([f"resume={far.path}", "agent.num_timesteps=640"])) == 128 + signal.SIGTERM
  assert (chain.status["status"], far.status["status"]) == ("finished", "preempted")
  assert resume(path) == 0
  assert chain.status["status"] == chain.summary["status"] == far.status["status"] == "finished"
  assert (far.summary["steps"], chain.summary["steps"]) == (640, 960)
  assert pd.read_csv(path / "metrics.csv")["step"].to_list()[-3:] == [800, 880, 960]

  far.write_summary({**far.summary, "final_return": 7.0})  # as if it had been finished by itself
  assert resume(path) == 0
  assert chain.summary["final_return"] == 7.0


def test_a_stage_that_fails_is_named(composed: Callable[..., RunConfig], tmp_path: Path) -> None:
  path = tmp_path / "chain"
  with pytest.MonkeyPatch.context() as patch:
    patch.setattr(train_module, "compile_program", lambda *args: (_ for _ in ()).throw(ConfigError("no.")))
    with pytest.raises(ConfigError, match=r"^Stage near of the chain: no\.$"):
      train(composed(f"run_dir={path}"))
  assert RunDirectory(path).status["status"] == RunDirectory(path / "1_near").status["status"] == "failed"
  assert RunDirectory(path).status["reason"] == "Stage near of the chain: no."
  assert RunDirectory(path).summary["status"] == "failed"


# Where a chain starts


def test_a_chain_starts_at_a_stage_from_someones_weights(
  whole: Path, composed: Callable[..., RunConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  policies, run_loop = [], Loop.run

  def watched(loop: Loop, state: Any, update: int | None = None) -> tuple[Any, bool]:
    policies.append(jax.device_get(loop.trainer.policy(state)))
    return run_loop(loop, state, update)

  monkeypatch.setattr(Loop, "run", watched)
  path, weights = tmp_path / "chain", whole / "1_near"
  assert train(composed("curriculum.start_at=far", f"init_from={weights}", f"run_dir={path}")) == 0
  assert checksum(jax.tree.leaves(policies)) == Checkpoint(find_checkpoints(weights)[0]).meta["sha256"]["policy"]
  assert sorted(folder.name for folder in path.glob("[0-9]*")) == ["2_far"]
  for folder in ("", "2_far"):
    assert RunDirectory(path / folder).config["init_from"] == str(find_checkpoints(weights)[0]), (
      "wherever it is resumed"
    )
  assert RunDirectory(path).summary["params_sha256"] == RunDirectory(whole).summary["params_sha256"]


# What is refused, before anything is written


@pytest.mark.parametrize(
  ("stage", "message"),
  {
    "env=CartpoleSwingupSparse": r"Stage far of the chain: env=CartpoleSwingupSparse cannot start from the weights of "
    r"stage near: size of observation 'privileged_state' is \(8,\), and \(4,\) there\.",
    "agent.network.policy_hidden_layer_sizes=[16,8]": r"Stage far of the chain: .* of stage near: agent\.network\."
    r"policy_hidden_layer_sizes is \[16, 8\], and \[\d+.*\] there\.",
    "agent.network.activation=relu": r"Stage far .*: agent\.network\.activation is relu, and swish there\.",
    "randomization=g1": r"Stage far of the chain: env\.events\.\w+\.params\.field 'pair_friction' is no field",
    "agent=sac": r"Stage far of the chain: .* of stage near: agent\.name is sac, and ppo there\.",
  }.items(),
)
def test_a_stage_that_does_not_fit_the_one_before(stage: str, message: str, configs: Path, tmp_path: Path) -> None:
  (configs / "curriculum/misfit.yaml").write_text(CHAIN.replace("agent.learning_rate=0.002", f"'{stage}'"))
  with pytest.raises(ConfigError, match=message):
    train(compose([*LINE, "curriculum=misfit", f"run_dir={tmp_path / 'chain'}"], configs))
  assert not (tmp_path / "chain").exists()


def test_a_stage_whose_camera_is_not_there(
  composed: Callable[..., RunConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><camera name="side"/></worldbody></mujoco>')
  monkeypatch.setattr(Point, "mj_model", model)
  with pytest.raises(ConfigError, match=r"Stage near of the chain: video\.camera=sid is no .* Did you mean 'side'\?$"):
    train(composed("video.camera=sid", f"run_dir={tmp_path / 'chain'}"))
  assert not (tmp_path / "chain").exists()


def test_weights_that_do_not_fit(whole: Path, composed: Callable[..., RunConfig], tmp_path: Path) -> None:
  where = f"run_dir={tmp_path / 'chain'}"
  with pytest.raises(ValueError, match=r"Stage near of the chain: .*2_far/checkpoints/.* was trained with agent"):
    train(composed(f"init_from={whole}", "agent.network.policy_hidden_layer_sizes=[16,8]", where))
  assert not (tmp_path / "chain").exists()


def test_a_chain_takes_no_directory_that_holds_a_run(whole: Path, composed: Callable[..., RunConfig]) -> None:
  for path in (whole, whole / "1_near"):
    with pytest.raises(ValueError, match=re.escape(f"run_dir={path} already holds a run: give resume={path}")):
      train(composed(f"run_dir={path}"))


def test_of_two_chains_that_start_in_one_folder_the_second_changes_nothing(
  composed: Callable[..., RunConfig], tmp_path: Path
) -> None:
  """Both found it free."""
  with RunDirectory(tmp_path).locked():
    with pytest.raises(CheckpointError, match=f"^{tmp_path} is being written by process"):
      train(composed(f"run_dir={tmp_path}"))
    assert [path.name for path in tmp_path.iterdir()] == ["run.lock"]
