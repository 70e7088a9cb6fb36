"""Tables of rows: complete on disk, continued, never mistaken for other files; means and their intervals."""

import errno
import threading
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark import schema
from playground.benchmark.schema import COLUMNS, Table
from playground.errors import ConfigError

ROW = {"benchmark": "throughput", "task": "A", "seed": 1, "quantity": "training_steps_per_s", "value": 12.5}


def test_rows_are_on_disk_at_once_and_found_again(tmp_path: Path):
  path = tmp_path / "sub" / "rows.csv"
  Table(path).add(ROW)
  text = path.read_text()
  assert text.splitlines()[0] == ",".join(COLUMNS)
  table = Table(path)
  assert table.has({"task": "A", "seed": 1}) and not table.has({"task": "A", "seed": 2})
  table.add(ROW | {"seed": 2, "conditions": "a, b"})
  assert path.read_text().startswith(text) and Table(path).has({"seed": 2, "conditions": "a, b"})


def test_a_row_that_a_kill_cut_short_is_dropped(tmp_path: Path):
  path = tmp_path / "rows.csv"
  Table(path).add(ROW)
  whole = path.read_text()
  path.write_text(whole + "throughput,B,ppo")
  assert not Table(path).has({"task": "B"})
  assert path.read_text() == whole


def test_a_row_that_is_cut_in_a_character_is_dropped_while_others_add(tmp_path: Path):
  path = tmp_path / "rows.csv"
  table = Table(path)
  with path.open("ab") as file:
    file.write("throughput,B,ppo,ü".encode()[:-1])
  table.add(ROW)
  assert [line.split(",")[1] for line in path.read_text().splitlines()] == ["task", "A"]
  with path.open("ab") as file:
    file.write("throughput,B,ppo,ü".encode()[:-1])
  assert Table(path).has({"task": "A"}) and not Table(path).has({"task": "B"})


def test_a_whole_row_without_its_lines_end_stays(tmp_path: Path):
  path = tmp_path / "rows.csv"
  Table(path).add(ROW)
  path.write_text(path.read_text().removesuffix("\n"))
  Table(path).add(ROW | {"seed": 2})
  assert Table(path).has({"seed": 1}) and Table(path).has({"seed": 2})


def test_two_that_add_at_the_same_time_lose_nothing(tmp_path: Path):
  path = tmp_path / "rows.csv"
  one, other = Table(path), Table(path)
  started, ended = threading.Event(), threading.Event()

  def add() -> None:
    started.set()
    other.add(ROW | {"seed": 2})
    ended.set()

  with one._to_itself() as file:
    threading.Thread(target=add).start()
    started.wait()
    assert not ended.wait(0.2), "it waits"
    file.write(b"throughput,cut")
  assert ended.wait(10)
  assert Table(path).has({"seed": 2}) and "cut" not in path.read_text()


@pytest.mark.parametrize("end", ["", "\n"])
def test_other_files_are_left_alone(tmp_path: Path, end: str):
  path = tmp_path / "other.csv"
  path.write_text(f"step,reward\n1,2{end}")
  with pytest.raises(ConfigError, match="not a table of playground-bench"):
    Table(path)
  assert path.read_text() == f"step,reward\n1,2{end}"
  with pytest.raises(ConfigError, match=r"cannot be written: .*other\.csv is not a folder that you may write to"):
    Table(path / "below")


def test_a_damaged_table_is_named_and_kept(tmp_path: Path):
  path = tmp_path / "rows.csv"
  Table(path).add(ROW)
  damaged = path.read_bytes() + b"\xff\xfe\n"
  path.write_bytes(damaged)
  with pytest.raises(ConfigError, match=r"is damaged \(.*\): mend it or name another file\.$"):
    Table(path)
  assert path.read_bytes() == damaged


def test_a_full_disk_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  def full(file: Any) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")

  table = Table(tmp_path / "rows.csv")
  monkeypatch.setattr(schema, "_end_last_row", full)
  with pytest.raises(ConfigError, match=r"^out=.*rows\.csv cannot be used: No space left on device\.$"):
    table.add(ROW)


def test_what_the_schema_does_not_have_is_refused(tmp_path: Path):
  table = Table(tmp_path / "rows.csv")
  with pytest.raises(KeyError, match="speed"):
    table.add(ROW | {"quantity": "speed"})
  with pytest.raises(KeyError, match="colour"):
    table.add(ROW | {"colour": "red"})
