"""Tables of rows: complete on disk, continued, never mistaken for other files; means and their intervals."""

from pathlib import Path

import numpy as np
import pytest

from playground.benchmark.schema import COLUMNS, Table, mean_and_ci95
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


def test_other_files_are_left_alone(tmp_path: Path):
  path = tmp_path / "other.csv"
  path.write_text("step,reward\n1,2\n")
  with pytest.raises(ConfigError, match="not a table of playground-bench"):
    Table(path)
  assert path.read_text() == "step,reward\n1,2\n"
  with pytest.raises(ConfigError, match="cannot be used"):
    Table(path / "below")


def test_what_the_schema_does_not_have_is_refused(tmp_path: Path):
  table = Table(tmp_path / "rows.csv")
  with pytest.raises(KeyError, match="speed"):
    table.add(ROW | {"quantity": "speed"})
  with pytest.raises(KeyError, match="colour"):
    table.add(ROW | {"colour": "red"})


def test_interval_is_students():
  mean, half = mean_and_ci95([1.0, 2.0, 3.0, 4.0, 5.0])
  assert mean == 3.0 and half is not None
  np.testing.assert_allclose(half, 2.776445 * np.sqrt(2.5 / 5), rtol=1e-6)  # t(0.975, 4 degrees of freedom)
  assert mean_and_ci95([7.0]) == (7.0, None)
