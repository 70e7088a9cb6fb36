"""Policies that come with the package: they are what was trained, and a changed file or task is refused."""

import contextlib
import copy
import json
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import yaml

from playground import pretrained, registry
from playground.cli.main import main
from playground.cli.play import play
from playground.config import compose
from playground.errors import CheckpointError, ConfigError, UnknownNameError
from playground.pretrained import POLICIES, cards, check_task, locate, working_copy
from playground.runs.restore_plan import weights_of
from tests.command import caller

TASK = "G1JoystickFlatTerrain"


@pytest.fixture
def policies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
  """A copy of one policy, which a test may damage."""
  shutil.copytree(POLICIES / TASK, tmp_path / "policies" / TASK)
  monkeypatch.setattr(pretrained, "POLICIES", tmp_path / "policies")
  monkeypatch.chdir(tmp_path)
  return tmp_path / "policies"


def test_all_are_whole_and_small() -> None:
  assert TASK in cards()
  for task, card in cards().items():
    folder = Path(locate(f"pretrained:{task}"))
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert files == {*card["sha256"], "card.yaml"}
    assert weights_of(f"pretrained:{task}").step == card["steps"], "its task is today's"
  assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 40e6


def test_other_names_are_paths() -> None:
  assert locate("results/run") == "results/run"
  assert working_copy("results/run", [TASK]) == "results/run"


def test_a_task_without_one_is_refused() -> None:
  with pytest.raises(UnknownNameError, match=r"pretrained:G1Joystick: .*Did you mean 'G1JoystickFlatTerrain'"):
    locate("pretrained:G1Joystick")
  with pytest.raises(UnknownNameError, match="there are pretrained policies of"):
    compose(["env=G1JoystickFlatTerrain", "init_from=pretrained:Nothing"])


@pytest.mark.parametrize("change", [lambda file: file.unlink(), lambda file: file.write_bytes(b"other")])
def test_another_file_is_refused(change: Any, policies: Path) -> None:
  change(next((policies / TASK).glob("checkpoints/*/policy/manifest.ocdbt")))
  with pytest.raises(CheckpointError, match=r"manifest\.ocdbt is not the file that was trained"):
    locate(f"pretrained:{TASK}")


def test_a_copy_is_made_once_and_again_for_another_policy(policies: Path) -> None:
  copied = Path(working_copy(TASK, [TASK]))
  assert copied == Path("results/pretrained") / TASK
  (copied / "eval").mkdir()
  assert working_copy(f"pretrained:{TASK}", [TASK]) == str(copied)
  assert (copied / "eval").is_dir(), "what was written there stays"
  card = policies / TASK / "card.yaml"
  card.write_text(card.read_text() + "note: trained anew\n")
  working_copy(TASK, [TASK])
  assert not (copied / "eval").exists() and (copied.parent / f"{TASK}_old" / "eval").is_dir(), "nor is it lost"
  assert (copied / "card.yaml").read_text() == card.read_text()
  assert sorted(path.name for path in copied.parent.iterdir()) == [".lock", TASK, f"{TASK}_old"]


def test_a_changed_copy_is_replaced(policies: Path, capsys: pytest.CaptureFixture[str]) -> None:
  copied = Path(working_copy(TASK, [TASK]))
  config = copied / "config.yaml"
  config.write_text(config.read_text().replace("seed: ", "seed: 1"))
  assert working_copy(TASK, [TASK]) == str(copied)
  assert config.read_bytes() == (policies / TASK / "config.yaml").read_bytes()
  assert "or your copy, has changed" in capsys.readouterr().out


def test_a_copy_that_is_there_is_only_read(policies: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  """Its folder may be one that cannot be written to."""
  copied = working_copy(TASK, [TASK])
  monkeypatch.setattr(pretrained, "locking", None)
  assert working_copy(TASK, [TASK]) == copied


def test_processes_that_start_together_share_a_copy(policies: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  begun, copytree = threading.Barrier(2), shutil.copytree

  def slowly(*args: Any) -> Any:
    with contextlib.suppress(threading.BrokenBarrierError):
      begun.wait(0.3)  # for the other one, if it copies, too
    return copytree(*args)

  monkeypatch.setattr(shutil, "copytree", slowly)
  with ThreadPoolExecutor(2) as pool:
    copies = set(pool.map(lambda _: working_copy(TASK, [TASK]), range(2)))
  assert copies == {str(Path("results/pretrained") / TASK)}
  assert [path.name for path in Path("results/pretrained").glob("[!.]*")] == [TASK]


def test_a_path_of_that_name_comes_first(policies: Path) -> None:
  Path(TASK).mkdir()
  assert working_copy(TASK, [TASK]) == TASK


def test_a_task_that_has_changed_is_refused(policies: Path) -> None:
  saved = yaml.safe_load((POLICIES / TASK / "config.yaml").read_text())["env"]
  today = json.loads(json.dumps(registry.config(TASK).to_dict()))
  check_task(TASK, saved, today)
  term = next(iter(today["observations"]["state"]))
  noisier = copy.deepcopy(today)
  noisier["observations"]["state"][term] = {**(today["observations"]["state"][term] or {}), "noise": {"uniform": 9.0}}
  check_task(TASK, saved, noisier)
  del today["observations"]["state"][term]
  with pytest.raises(CheckpointError, match=r"env.observations has changed since .*playground-run env=G1Joystick"):
    check_task(TASK, saved, today)
  with pytest.raises(CheckpointError, match=r"env.action_scale has changed"):
    check_task(TASK, saved, {**noisier, "action_scale": 9.0})
  order = list(reversed(saved["observations"]["state"]))
  changes = {"action_base": "joint_pos", "clip_targets": True, "ema_alpha": 0.5, "observation_order": {"state": order}}
  for key, value in changes.items():
    with pytest.raises(CheckpointError, match=rf"env.{key} has changed"):
      check_task(TASK, saved, {**noisier, key: value})


@pytest.mark.parametrize("option", ["--note=early", "--replace"])
def test_options_of_add_need_it(
  option: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  assert caller(monkeypatch, "playground", main)("pretrained", option) == 2
  assert capsys.readouterr().err == f"error: {option.partition('=')[0]} needs --add=<run>.\n"


def test_a_run_starts_from_one() -> None:
  config = compose(["env=G1JoystickRoughTerrain", f"init_from=pretrained:{TASK}"])
  assert config.init_from == f"pretrained:{TASK}"
  with pytest.raises(ConfigError):
    compose(["resume=pretrained:" + TASK])


@pytest.mark.slow
@pytest.mark.parametrize("task", [task for task, card in cards().items() if card["status"] == "solved"])
def test_what_the_card_says_is_met(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.chdir(tmp_path)
  card = cards()[task]["c_mujoco"]
  path = working_copy(task, [task])
  assert play(path, episodes=card["episodes"], seed=1) == 0
  scores = json.loads(next(Path(path).glob("export/play_step_*_seed_1_*.json")).read_text())["scores"]
  # A task that begins alike every time has hardly a deviation: another machine may differ by a thousandth.
  standard_error = max(card["return_std"] / card["episodes"] ** 0.5, 1e-3 * abs(card["return"]))
  assert scores["episode_reward"] >= card["return"] - 4 * standard_error
