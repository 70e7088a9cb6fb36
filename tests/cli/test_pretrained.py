"""`playground pretrained`: a run's policy becomes one that comes with the package."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from playground import pretrained
from playground.cli.pretrained import _status, add_policy, show_policies  # pyright: ignore[reportPrivateUsage]
from playground.config import compose
from playground.errors import ConfigError
from playground.learning.checkpoints import Checkpoint
from playground.runs.restore_plan import weights_of
from playground.runs.train import train
from tests.runs.helpers import TASK, make_run

ROUNDED = {".params.value": 3, "kernel": 11}  # significant bits


def test_a_run_becomes_a_pretrained_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  pytest.importorskip("onnxruntime")
  monkeypatch.setattr(pretrained, "POLICIES", tmp_path / "policies")
  monkeypatch.chdir(tmp_path)
  run = tmp_path / "run"
  assert train(compose([*TASK, "agent.num_timesteps=320", "agent.num_evals=2", f"run_dir={run}"])) == 0
  assert add_policy(str(run), "cut short") == 0
  (folder,) = (tmp_path / "policies").iterdir()
  card = yaml.safe_load((folder / "card.yaml").read_text())
  checkpoint = weights_of(f"pretrained:{folder.name}")
  assert (card["task"], card["steps"], card["c_mujoco"]["episodes"]) == (folder.name, checkpoint.step, 20)
  assert (card["status"], card["note"]) == ("open", "cut short")
  assert card["training"]["sampled"] > 0 and card["training"]["mode"] > 0 and card["training"]["steps"] == card["steps"]
  assert not checkpoint.has("state")
  exact, shipped = Checkpoint(run / "checkpoints" / checkpoint.path.name).arrays("policy"), checkpoint.arrays("policy")
  for (name, *_), before, after in zip(checkpoint.meta["leaves"]["policy"], exact, shipped, strict=True):
    bits = next((bits for part, bits in ROUNDED.items() if part in name), None)
    np.testing.assert_allclose(after, before, rtol=2.0**-bits if bits else 0, err_msg=name)
  texts = [path.read_text() for name in ("*.yaml", "*.json", "*.txt", "metadata") for path in folder.rglob(name)]
  assert len(texts) >= 6 and str(tmp_path) not in "".join(texts), "paths of this machine"
  console = Console(record=True, width=120)
  assert show_policies(console) == 0
  assert f"{card['c_mujoco']['return']:.1f} ±" in console.export_text()

  header, *rows = (metrics := run / "metrics.csv").read_text().splitlines(keepends=True)
  metrics.write_text("".join([header, *(row for row in rows if row.startswith("0,"))]))  # stopped before the next one
  with pytest.raises(ConfigError, match=rf"There is a policy of {folder.name} already: ppo, .* --replace replaces it"):
    add_policy(str(run))
  assert add_policy(str(run), "solved: as far as it goes", replace=True) == 0
  card = yaml.safe_load((folder / "card.yaml").read_text())
  assert (card["status"], card["training"]["steps"]) == ("solved", 0)
  chain = make_run(tmp_path / "chain", {}, ["experiment=my_chain", "run_dir=chain"]).path
  run = run.rename(chain / "1_stage")
  for given in (chain, run, run / "checkpoints" / checkpoint.path.name):
    assert add_policy(str(given), replace=True) == 0
    assert yaml.safe_load((folder / "card.yaml").read_text())["command"] == "playground-run experiment=my_chain"
  (run / "metrics.csv").write_text(header)
  with pytest.raises(ConfigError, match="was not evaluated before its newest checkpoint"):
    add_policy(str(run), replace=True)


@pytest.fixture
def untrained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
  """Makes a run of a task that `add_policy` can read up to its policy."""
  monkeypatch.setattr("playground.cli.pretrained.play", pytest.fail)
  monkeypatch.setattr(pretrained, "POLICIES", tmp_path / "policies")

  def make(task: str, *overrides: str) -> Path:
    run = make_run(tmp_path / "run", compose([f"env={task}", *overrides]).resolved).path
    (run / "checkpoints" / f"{100:012d}").mkdir(parents=True)
    (run / "manifest.json").write_text("{}")
    (run / "metrics.csv").write_text("step,eval/episode_reward\n100,1.0\n")
    return run

  return make


@pytest.mark.parametrize("overrides", [["v020/CartpoleBalance"], ["joystick", "robot=go1"]])
def test_a_run_of_a_task_that_is_not_listed_is_refused(untrained: Callable[..., Path], overrides: list[str]) -> None:
  run, task = untrained(*overrides), overrides[0]
  with pytest.raises(ConfigError, match=rf"run trained env={task}: only policies of tasks that `playground list`"):
    add_policy(str(run))


def test_only_the_newest_policy_is_added(untrained: Callable[..., Path]) -> None:
  run = untrained("CartpoleBalance")
  (run / "checkpoints" / f"{50:012d}").mkdir()
  (run / "checkpoints" / "best").symlink_to(f"{50:012d}")
  for name in ("best", f"{50:012d}"):
    with pytest.raises(ConfigError, match=rf"{50:012d} is not the run's newest policy, .*: .*/{100:012d}\."):
      add_policy(str(run / "checkpoints" / name))


@pytest.mark.parametrize(
  ("turns", "drops", "status"), [(3.1, 0.0, "solved"), (3.1, 0.3, "learning"), (0.0, 0.0, "learning")]
)
def test_a_rotation_counts_by_turns(turns: float, drops: float, status: str) -> None:
  assert _status({"episode_reward": 1.0, "episode_fall": drops, "episode_turns": turns}, "") == status


def test_folders_that_cannot_be_written_are_said_first(untrained: Callable[..., Path], tmp_path: Path) -> None:
  run = untrained("CartpoleBalance")
  (tmp_path / "policies").touch()
  with pytest.raises(ConfigError, match=r"/policies cannot be written: .* is not a folder that you may write to"):
    add_policy(str(run))
  (run / "export").touch()
  with pytest.raises(ConfigError, match=r"/run/export cannot be written: .* is not a folder that you may write to"):
    add_policy(str(run))


def test_a_result_without_scores_is_refused(
  untrained: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
  run = untrained("CartpoleBalance")
  result = run / "export" / f"play_step_{100:012d}_seed_0_episodes_20.json"
  result.parent.mkdir()
  result.write_text("{}")
  with pytest.raises(ConfigError, match=r"episodes_20.json holds no scores: move it away"):
    add_policy(str(run))
  result.unlink()
  monkeypatch.setattr("playground.cli.pretrained.play", lambda *_, **__: 0)  # says why it writes no result, ends well
  with pytest.raises(ConfigError, match=r"episodes_20.json holds no scores: .* why `playground play` did not write it"):
    add_policy(str(run))
  assert not (tmp_path / "policies").exists()
