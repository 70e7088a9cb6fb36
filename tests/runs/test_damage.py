"""Whatever becomes of a file of a run, what reads it says so in one sentence, or does without it."""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from playground.cli import eval as eval_command
from playground.cli.main import main as playground
from playground.cli.run import main as playground_run
from playground.config import compose
from playground.errors import PlaygroundError
from playground.runs import train as train_module
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train
from tests.aliases import MERGED
from tests.runs.helpers import TASK

MUTATIONS: dict[str, Callable[[bytes], bytes]] = {
  "empty": lambda _: b"",
  "half": lambda content: content[: len(content) // 2],
  "garbage": lambda content: bytes(i * 37 % 256 for i in range(max(len(content), 64))),
  "changed": lambda content: content[: len(content) // 3] + b"\x07" + content[len(content) // 3 + 1 :],
  "marked": lambda content: b"\xef\xbb\xbf" + content,
  "list": lambda _: b"[]",
  "number": lambda _: b"7",
  "deep": lambda _: b"[" * 100_000,
}
FILES = (
  *("config.yaml", "overrides.yaml", "manifest.json", "status.json", "summary.json", "metrics.csv", "run.lock"),
  *("meta/metadata", "_CHECKPOINT_METADATA", "policy/_METADATA", "policy/manifest.ocdbt", "state/manifest.ocdbt"),
  *("policy/d/*", "state/d/*"),
)
Read = Callable[[Path], list[str]]
slow = pytest.mark.slow


class Reached(PlaygroundError):
  """Everything has been read, and compiling would begin."""


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """A run that was killed after its last checkpoint."""
  run = tmp_path_factory.mktemp("original") / "run"
  assert train(compose([*TASK, "agent.num_timesteps=320", "agent.num_evals=3", f"run_dir={run}"])) == 0
  RunDirectory(run).set_status("running")
  return run


@pytest.fixture
def run(original: Path, tmp_path: Path) -> Path:
  return shutil.copytree(original, tmp_path / "run", symlinks=True)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Read:
  """Lets `resume` and `eval` read a run up to where they would compile; what each says, which is one sentence."""

  def reached(*_: Any, **__: Any) -> Any:
    raise Reached("all is read.")

  def call(run: Path) -> list[str]:
    said = []
    commands = (playground_run, ["playground-run", f"resume={run}"]), (playground, ["playground", "eval", str(run)])
    for main, argv in commands:
      monkeypatch.setattr(sys, "argv", argv)
      capsys.readouterr()
      with pytest.raises(SystemExit) as end:
        main()
      lines = capsys.readouterr().err.splitlines()
      assert (end.value.code, len(lines)) == (2, 1), (argv, lines)
      assert lines[0].startswith("error: "), lines
      said.append(lines[0])
    return said

  monkeypatch.setattr(train_module, "compile_program", reached)
  monkeypatch.setattr(eval_command, "make_evaluator", reached)
  return call


def test_a_whole_run_is_read(run: Path, read: Read) -> None:
  assert read(run) == ["error: all is read."] * 2


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
  "how", ["garbage", *(pytest.param(how, marks=slow) for how in (*MUTATIONS, "missing") if how != "garbage")]
)
def test_a_damaged_file(name: str, how: str, run: Path, read: Read) -> None:
  file = run / name if (run / name).exists() else next((run / "checkpoints" / f"{320:012d}").glob(name))
  if how == "missing":
    file.unlink()
  else:
    file.write_bytes(MUTATIONS[how](file.read_bytes()))
  resumed, _ = read(run)
  if file.is_relative_to(run / "checkpoints"):
    aside = any((run / "checkpoints").glob("damaged_*"))
    assert not aside, "nothing is moved before the run begins to write"
  if name in ("manifest.json", "status.json") and how in ("empty", "garbage", "list"):
    assert f"{file} is damaged" in resumed
  if name == "metrics.csv":
    assert resumed == "error: all is read."


NO_OVERRIDES = (MERGED.encode(), b"", b"{a: b", b"[1, 2]", b"\xff\0", b"{a: b}", b"text", b"[" * 100_000)


@pytest.mark.parametrize("content", NO_OVERRIDES, ids=lambda content: repr(content[:9]))
def test_damaged_overrides_do_not_change_a_run_that_is_to_train_longer(
  content: bytes, run: Path, refused: Callable[..., str]
) -> None:
  RunDirectory(run).set_status("finished")
  (run / "overrides.yaml").write_bytes(content)
  before = {path: path.read_bytes() for path in run.glob("*.*") if path.name != "run.lock"}
  damaged = (
    f"error: {run / 'overrides.yaml'} is damaged (it is no list of overrides): move it away to go on without it."
  )
  assert refused(f"resume={run}", "agent.num_timesteps=640") == damaged
  assert {path: path.read_bytes() for path in before} == before
  assert RunDirectory(run).status["status"] == "finished"


def test_a_damaged_manifest_does_not_change_a_run_that_is_to_train_longer(
  run: Path, refused: Callable[..., str]
) -> None:
  RunDirectory(run).set_status("finished")
  (run / "manifest.json").write_text("{")
  before = {path: path.read_bytes() for path in run.glob("*.*") if path.name != "run.lock"}
  assert f"{run / 'manifest.json'} is damaged" in refused(f"resume={run}", "agent.num_timesteps=640")
  assert {path: path.read_bytes() for path in before} == before


VALUES: tuple[Any, ...] = (None, [], {}, "text", -1, True, {"a": [None]}, "missing")


@pytest.mark.parametrize("name", ["manifest.json", "status.json", "summary.json"])
def test_a_record_with_another_value(name: str, run: Path) -> None:
  """It is read, or refused by name."""
  file, directory = run / name, RunDirectory(run)
  content = json.loads(file.read_text())
  for key in content:
    for value in VALUES:
      changed = {k: v for k, v in content.items() if k != key} | ({} if value == "missing" else {key: value})
      file.write_text(json.dumps(changed))
      try:
        assert isinstance({"manifest": directory.manifest, "status": directory.status}, dict)
        assert isinstance(directory.summary, dict)
        directory.set_status("running")
      except PlaygroundError as error:
        assert f"{file} is damaged (its {key!r} has the wrong type)" in str(error)


def config_changes() -> list[tuple[str, Any]]:
  """Keys of config.yaml, and values that they cannot have."""
  config = compose(TASK).resolved
  inner = [
    f"{section}.{key}" for section in config for key in (config[section] if isinstance(config[section], dict) else {})
  ]
  return [(key, value) for key in [*config, *inner] for value in (None, [], "text", -1, {"a": [None]}, "missing")]


QUICK = ("name", "choices", "agent", "choices.env", "agent.num_envs", "video.camera")


@pytest.mark.parametrize(
  ("key", "value"),
  [pytest.param(key, value, marks=() if key in QUICK and value == [] else slow) for key, value in config_changes()],
)
def test_a_configuration_with_another_value(key: str, value: Any, run: Path, read: Read) -> None:
  config = yaml.safe_load((run / "config.yaml").read_text())
  *sections, last = key.split(".")
  section = config[sections[0]] if sections else config
  if value == "missing":
    section.pop(last, None)
  else:
    section[last] = value
  (run / "config.yaml").write_text(yaml.safe_dump(config))
  read(run)
