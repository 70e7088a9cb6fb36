"""Policies on W&B, which stand-ins for its API and its run take the place of."""

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import wandb

from playground.cli.main import main
from playground.config import compose
from playground.errors import CheckpointError, ConfigError
from playground.pretrained import POLICIES, copy_policy
from playground.runs import wandb_artifacts
from playground.runs.restore_plan import weights_of
from playground.runs.wandb_artifacts import local_path
from playground.runs.wandb_tracker import WandbTracker
from tests.command import caller
from tests.runs.test_trackers import CONFIG, WANDB, no_login  # noqa: F401

RUN = POLICIES / "G1JoystickFlatTerrain"


class Stored:
  """An artifact of which W&B holds the files in a folder."""

  type = "policy"

  def __init__(self, folder: Path, name: str = "policy-abc:v1"):
    self.folder, self.name, self.downloads = folder, name, 0

  def download(self, root: str) -> None:
    self.downloads += 1
    shutil.copytree(self.folder, root, symlinks=True)


@pytest.fixture
def stored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Stored:
  """An artifact of the run `abc`, called `walk`, for a user who is logged in."""
  copy_policy(RUN, tmp_path / "uploaded")
  artifact = Stored(tmp_path / "uploaded")

  def run(path: str) -> SimpleNamespace:
    if path != "me/robots/abc":
      raise ValueError("Could not find run")
    return SimpleNamespace(logged_artifacts=lambda: [SimpleNamespace(type="run-history"), artifact])

  api = SimpleNamespace(
    run=run,
    runs=lambda project, filters: [run(f"{project}/abc")] if filters == {"display_name": "walk"} else [],
    artifact=lambda name, type: artifact,
  )
  monkeypatch.setattr(wandb, "Api", lambda: api)
  monkeypatch.setenv("WANDB_API_KEY", "key")
  monkeypatch.chdir(tmp_path)
  return artifact


@pytest.mark.parametrize("name", ["abc", "walk", "policy-abc:v1", "policy-abc:latest"])
def test_a_policy_is_downloaded_once(stored: Stored, name: str):
  path = local_path(f"wandb:me/robots/{name}")
  assert path == "results/wandb/me/robots/policy-abc-v1" and local_path(f"wandb:me/robots/{name}") == path
  assert stored.downloads == 1
  assert weights_of(path).meta["config"]["choices"]["env"] == "G1JoystickFlatTerrain"


def test_a_run_starts_from_it(stored: Stored, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
  from playground.cli.run import main as run_main

  args = ("env=G1JoystickRoughTerrain", "init_from=wandb:me/robots/walk", "--cfg", "job")
  assert caller(monkeypatch, "playground-run", run_main)(*args) == 0
  assert "init_from: results/wandb/me/robots/policy-abc-v1" in capsys.readouterr().out


@pytest.mark.parametrize(
  ("name", "sentence"),
  [
    ("me/abc", "is not of the form wandb:<entity>/<project>/<run>"),
    ("me/robots/../../x", "is not of the form"),
    ("me/robots/other", "me/robots has no run of that id or name"),
  ],
)
def test_a_wrong_name_is_one_sentence(stored: Stored, name: str, sentence: str):
  with pytest.raises(ConfigError, match=sentence):
    local_path(f"wandb:{name}")


def test_without_a_login_nothing_is_asked(
  stored: Stored, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
  monkeypatch.delenv("WANDB_API_KEY")
  for command in ("eval", "play", "export"):
    assert caller(monkeypatch, "playground", main)(command, "wandb:me/robots/walk") == 2
    said = capsys.readouterr().err
    assert said == "error: wandb:me/robots/walk needs a W&B login: run `wandb login`, or set WANDB_API_KEY.\n"
  assert stored.downloads == 0


def link(folder: Path) -> None:
  (folder / "checkpoints" / "best").symlink_to("/etc")


@pytest.mark.parametrize("change", [link, lambda folder: (folder / "config.yaml").unlink()])
def test_other_files_are_refused_and_not_kept(stored: Stored, change: Callable[[Path], None]):
  change(stored.folder)
  with pytest.raises(CheckpointError, match="is not a policy that"):
    local_path("wandb:me/robots/abc")
  assert list(Path("results/wandb/me/robots").iterdir()) == []


def test_a_configuration_cannot_name_one(stored: Stored):
  with pytest.raises(ConfigError, match="is no run directory or checkpoint"):
    compose(["env=G1JoystickRoughTerrain", "init_from=wandb:me/robots/abc"])
  assert stored.downloads == 0


@pytest.mark.parametrize(
  ("upload", "status", "count"), [(True, "finished", 1), (True, "failed", 0), (False, "finished", 0)]
)
def test_a_finished_run_uploads_its_policy_if_it_is_asked_to(
  monkeypatch: pytest.MonkeyPatch, tmp_path: Path, upload: bool, status: str, count: int
):
  logged: list[Any] = []
  run = SimpleNamespace(id="abc", log=logged.append, log_artifact=logged.append, finish=lambda exit_code: None)
  monkeypatch.setattr(wandb, "init", lambda **_: run)
  folder = shutil.copytree(RUN, tmp_path / "run")
  step = next(folder.glob("checkpoints/*"))
  (step / "state").mkdir()
  (step / "state" / "adam").touch()
  WandbTracker(WANDB | {"upload": upload}, folder, CONFIG).close(status)
  assert len(logged) == count
  for artifact in logged:
    assert artifact.name == "policy-abc" and artifact.type == wandb_artifacts.TYPE
    names = set(artifact.manifest.entries)
    assert {"config.yaml", "metrics.csv"} <= names and any(name.startswith("checkpoints/") for name in names)
    assert not any("state/" in name for name in names)
