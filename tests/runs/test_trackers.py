import copy
import dataclasses
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import wandb

from playground import config
from playground.runs import wandb_tracker
from playground.runs.csv_tracker import CsvTracker
from playground.runs.trackers import make_trackers
from playground.runs.wandb_tracker import WandbTracker
from tests.runs.helpers import make_run

WANDB = {
  "enable": False,
  "project": "p",
  "entity": None,
  "group": None,
  "name": None,
  "tags": ["t"],
  "mode": "auto",
  "upload": False,
}
CONFIG = {"seed": 1, "tracking": {"tensorboard": False, "wandb": WANDB}}


@pytest.fixture(autouse=True)
def no_login(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
  for name in ("WANDB_API_KEY", "WANDB_IDENTITY_TOKEN_FILE", "WANDB_MODE", "NETRC", "WANDB_BASE_URL"):
    monkeypatch.delenv(name, raising=False)
  monkeypatch.setenv("HOME", str(tmp_path))


def test_rows_are_on_disk_at_once_and_exact(tmp_path: Path):
  tracker = CsvTracker(tmp_path / "metrics.csv")
  value = np.float32(0.1)
  tracker.log(10, {"loss": value, "bad": float("nan")})  # pyright: ignore[reportArgumentType]
  row = pd.read_csv(tmp_path / "metrics.csv", float_precision="round_trip").iloc[0]
  assert row["step"] == 10 and row["loss"] == float(value) and np.isnan(row["bad"])


def test_a_new_metric_widens_the_header(tmp_path: Path):
  path = tmp_path / "metrics.csv"
  tracker = CsvTracker(path)
  tracker.log(1, {"a": 1.0})
  tracker.log(2, {"b, with comma": 2.0})
  tracker.log(3, {"a": 3.0})
  assert path.read_text() == 'step,a,"b, with comma"\n1,1.0,\n2,,2.0\n3,3.0,\n'
  assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("torn", ["30", "30,3.", '30,"', "30,3.0,4.0"])
def test_what_a_kill_left_is_dropped(tmp_path: Path, torn: str):
  path = tmp_path / "metrics.csv"
  path.write_text("step,a,b\n10,1.0,\n20,2.0,5.0\n" + torn)
  CsvTracker(path).log(30, {"a": 3.0})
  assert path.read_text() == "step,a,b\n10,1.0,\n20,2.0,5.0\n30,3.0,\n"


ROWS = "step,a,b\n10,1.0,\n20,2.0,5.0\n30,nan,-inf\n"


@pytest.mark.parametrize(
  ("content", "rebuilt"),
  [
    ("\ufeff" + ROWS, ROWS),
    (ROWS.partition("\n")[2], ROWS),
    (ROWS.replace("step", "stop"), ROWS),
    (ROWS.replace("a,b", "a,c"), ROWS),
    (ROWS.replace("20,", '"20,'), ROWS),
    (ROWS.replace("2.0,", '2.0",'), ROWS),
    (ROWS.replace("\n", "\r\n"), ROWS),
    (ROWS.replace("2.0", "2.x"), ROWS.replace("2.0", "")),
    (ROWS.replace("20,2.0", "2O,2.0"), ROWS.replace("20,2.0,5.0\n", "")),
    (ROWS.replace("20,2.0", "20;2.0"), ROWS.replace("20,2.0,5.0\n", "")),
    (ROWS.replace("20,2.0,5.0\n", "\0\0\0\n\n"), ROWS.replace("20,2.0,5.0\n", "")),
    (ROWS.replace("a,b", '"a,b'), ROWS),
    ("\udcff\udc80\n", "step,a,b\n"),
  ],
)
def test_a_damaged_file_is_kept_aside_and_rebuilt(tmp_path: Path, content: str, rebuilt: str):
  path = tmp_path / "metrics.csv"
  said: list[str] = []
  for aside in ("metrics_damaged.csv", "metrics_damaged_2.csv"):
    path.write_bytes(content.encode(errors="surrogateescape"))
    tracker = CsvTracker(path, ["step", "a", "b"], said.append)
    tracker.truncate_after(30)
    assert path.read_text() == rebuilt
    assert (tmp_path / aside).read_bytes() == content.encode(errors="surrogateescape")
    assert f"{path} is damaged" in said[-1]
    assert f"kept as {aside}, {rebuilt.count(chr(10)) - 1} rows" in said[-1]
    assert tracker.columns == ["step", "a", "b"]


def test_a_file_of_an_earlier_version_without_its_header_is_kept_aside(tmp_path: Path):
  """Nobody knows the names of its columns."""
  path = tmp_path / "metrics.csv"
  path.write_text(ROWS.partition("\n")[2])
  CsvTracker(path, notify=lambda _: None)
  assert path.read_text() == "step\n10\n20\n30\n"
  assert (tmp_path / "metrics_damaged.csv").read_text() == ROWS.partition("\n")[2]
  path.write_text(ROWS.replace("step", "stop"))
  CsvTracker(path, notify=lambda _: None)
  assert path.read_text() == ROWS


def test_rows_that_are_gone_are_said_to_be(tmp_path: Path):
  run, said = make_run(tmp_path / "run", CONFIG), []
  for content in (None, "", ROWS.partition("30")[0]):
    if content is not None:
      run.metrics_csv.write_text(content)
    make_trackers(CONFIG, run, 30, said.append)
    assert "metrics.csv has no row of step 30, where the run goes on: rows before it are lost." in said.pop()
  run.metrics_csv.write_text(ROWS)
  make_trackers(CONFIG, run, 30, said.append)
  assert said == []


def test_a_column_that_came_after_the_checkpoint_stays(tmp_path: Path):
  path = tmp_path / "metrics.csv"
  path.write_text(ROWS)
  assert CsvTracker(path, ["step", "a"]).columns == ["step", "a", "b"]
  assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("torn", ["", "20,2.0,7.0\n", "2", "10,1.0,9.0"])
def test_resume_repeats_the_rows_after_the_checkpoint(tmp_path: Path, torn: str):
  straight, killed = CsvTracker(tmp_path / "a.csv"), CsvTracker(tmp_path / "b.csv")
  for tracker in (straight, killed):
    tracker.log(10, {"a": 1.0})
    tracker.log(20, {"a": 2.0, "b": 0.5})
  with (tmp_path / "b.csv").open("a") as file:
    file.write(torn)
  straight.log(30, {"c": 3.0})
  resumed = CsvTracker(tmp_path / "b.csv")
  resumed.truncate_after(10)
  resumed.log(20, {"a": 2.0, "b": 0.5})
  resumed.log(30, {"c": 3.0})
  assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()


@pytest.mark.parametrize("content", ["", "ste", "step,a\n"])
def test_a_file_without_rows_can_be_continued(tmp_path: Path, content: str):
  path = tmp_path / "metrics.csv"
  path.write_text(content)
  tracker = CsvTracker(path)
  tracker.truncate_after(0)
  tracker.log(1, {"a": 1.0})
  assert path.read_text() == "step,a\n1,1.0\n"


def test_a_metric_called_step_is_refused(tmp_path: Path):
  with pytest.raises(ValueError, match="cannot be called 'step'"):
    CsvTracker(tmp_path / "metrics.csv").log(1, {"step": 2.0})


def test_make_trackers_writes_csv_and_tensorboard(tmp_path: Path):
  config = copy.deepcopy(CONFIG)
  config["tracking"]["tensorboard"] = True
  run = make_run(tmp_path / "run", config)
  for resume_step in (None, 10):
    trackers = make_trackers(config, run, resume_step)
    trackers.log(10 if resume_step is None else 20, {"eval/episode_reward": 5.0})
    trackers.log(20 if resume_step is None else 30, {"eval/episode_reward": float("inf")})
    trackers.close("finished")
  assert pd.read_csv(run.metrics_csv)["step"].tolist() == [10, 20, 30]
  assert list((run.path / "tensorboard").glob("events.*"))


def test_wandb_offline_writes_and_keeps_its_id(tmp_path: Path):
  config = copy.deepcopy(CONFIG)
  config["tracking"]["wandb"]["enable"] = True
  run = make_run(tmp_path / "run", config)
  ids, complaints = [], []
  for resume_step in (None, 10):
    trackers = make_trackers(config, run, resume_step, notify=complaints.append)
    inner: Any = trackers.trackers[-1]
    ids.append(inner._run.id)
    assert inner._run.config["seed"] == 1 and inner._run.offline and inner._run.name == "run"
    trackers.log(10 if resume_step is None else 20, {"loss": 1.0})
    trackers.close("finished")
  assert [text.partition(str(run.path))[0] for text in complaints] == [
    "W&B records this run offline; to upload it: wandb sync "
  ] * 2
  assert ids[0] == ids[1]
  assert (run.path / "wandb_run_id").read_text() == ids[0]
  files = list(run.path.glob(f"wandb/offline-run-*/run-{ids[0]}.wandb"))
  assert files and all(f.stat().st_size > 0 for f in files)


@pytest.mark.parametrize("broken", ["init", "log"])
def test_failing_wandb_is_one_sentence_and_the_run_goes_on(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
):
  class Run:
    def log(self, *args: Any, **kwargs: Any) -> None:
      raise ConnectionError("gone\nwith details")

  def init(**kwargs: Any) -> Run:
    if broken == "init":
      raise TimeoutError("gone")
    return Run()

  monkeypatch.setattr(wandb, "init", init)
  complaints: list[str] = []
  tracker = WandbTracker(WANDB, tmp_path, CONFIG, complaints.append)
  for step in (1, 2):
    tracker.log(step, {"a": 1.0})
  tracker.close("finished")
  assert complaints == ["W&B tracking is off for the rest of this run (gone); metrics.csv goes on."]


def test_unreachable_wandb_is_recorded_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  modes: list[str] = []

  def init(mode: str, **kwargs: Any) -> None:
    modes.append(mode)
    if mode == "online":
      raise TimeoutError("deadline exceeded")

  monkeypatch.setattr(wandb, "init", init)
  monkeypatch.setenv("WANDB_API_KEY", "k")
  complaints: list[str] = []
  WandbTracker(WANDB, tmp_path, CONFIG, complaints.append)
  assert modes == ["online", "offline"] and len(complaints) == 1 and "deadline exceeded" in complaints[0]


@pytest.mark.parametrize(("begin", "read"), [("wandb.setup()", True), ("wandb_tracker.set_up()", False)])
def test_wandb_reads_no_settings_of_the_current_folder(tmp_path: Path, begin: str, read: bool):
  (tmp_path / "wandb").mkdir()
  (tmp_path / "wandb/settings").write_text("[default]\nbase_url = http://127.0.0.1:9\nsave_code = true\n")
  code = f"import os, wandb; from playground.runs import wandb_tracker; {begin}; s = wandb.setup().settings"
  code += "; print(s.base_url == 'http://127.0.0.1:9', s.save_code is True, os.getcwd())"
  done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
  assert done.stdout.splitlines()[-1] == f"{read} {read} {tmp_path.resolve()}"


@pytest.mark.parametrize("host", ["api.wandb.ai", "api.forge.coreweave.com"])
def test_a_login_under_either_name_of_the_server_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str):
  monkeypatch.setattr(wandb, "Settings", lambda: SimpleNamespace(base_url="https://api.forge.coreweave.com"))
  (tmp_path / ".netrc").write_text(f"machine {host} login user password secret\n")
  (tmp_path / ".netrc").chmod(0o600)
  assert wandb_tracker.logged_in()
  monkeypatch.setenv("WANDB_BASE_URL", "https://wandb.example.org")
  assert not wandb_tracker.logged_in()


def test_wandb_is_online_only_with_a_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  resolve = wandb_tracker.resolve_mode
  assert (resolve("auto"), resolve("online"), resolve("disabled")) == ("offline", "offline", "disabled")
  (tmp_path / ".netrc").write_text("machine api.wandb.ai login user password secret\n")
  (tmp_path / ".netrc").chmod(0o600)
  assert (resolve("auto"), resolve("offline")) == ("online", "offline")
  monkeypatch.setenv("WANDB_MODE", "offline")
  assert resolve("auto") == "offline"
  (tmp_path / ".netrc").unlink()
  monkeypatch.setenv("WANDB_MODE", "online")
  monkeypatch.setenv("WANDB_API_KEY", "k")
  assert resolve("auto") == "online"


def test_every_tracking_config_has_the_same_keys():
  chosen = {}
  for option in config.options("tracking"):
    tracking = config.compose(["env=CartpoleBalance", f"tracking={option}"]).tracking
    assert {field.name for field in dataclasses.fields(tracking.wandb)} == set(WANDB)
    chosen[option] = (tracking.tensorboard, tracking.wandb.enable)
  assert chosen == {"csv": (False, False), "tensorboard": (True, False), "wandb": (False, True), "all": (True, True)}
