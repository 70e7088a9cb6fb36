import io
import os
import sys

import pytest
from rich.console import Console

from playground.console import lasting_stdout
from playground.runs import progress
from playground.runs.progress import Progress


def consoles(terminal: bool) -> tuple[Console, io.StringIO]:
  out = io.StringIO()
  return Console(file=out, force_terminal=terminal, width=120), out


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
  now = [0.0]
  monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
  return now


def test_a_log_file_gets_few_plain_lines(clock: list[float]):
  console, out = consoles(terminal=False)
  with Progress(1000, console=console) as bar:
    bar.phase("compiling [ppo]")
    for step in range(0, 901, 10):  # 91 updates in 9.1 s
      clock[0] += 0.1
      bar.update(step)
    bar.update(950, last_return=12.345)
    bar.update(1000, steps_per_second=50.0)
  lines = out.getvalue().splitlines()
  assert lines[0] == "compiling [ppo]" and "\x1b" not in out.getvalue()
  assert len(lines) <= 4
  assert lines[-1] == "100.0 %  1.00k/1.00k steps  50 steps/s  ETA 0:00:00  return 12.3"


def test_the_last_state_is_printed_even_if_the_run_stops_early(clock: list[float]):
  console, out = consoles(terminal=False)
  with Progress(1000, console=console) as bar:
    bar.update(100)
    bar.update(200)
  assert [line.split()[0] for line in out.getvalue().splitlines()] == ["10.0", "20.0"]


def test_speed_is_measured_and_a_phase_does_not_count(clock: list[float]):
  console, out = consoles(terminal=False)
  with Progress(10_000_000, console=console) as bar:
    bar.update(1_000_000)  # a resumed run starts here
    clock[0] += 10
    bar.update(3_000_000)
    bar.phase("evaluating")
    clock[0] += 1000
    bar.update(3_000_000)
  assert "3.00M/10.00M steps  200.00k steps/s  ETA 0:00:35" in out.getvalue()
  assert out.getvalue().count("200.00k steps/s") == 2


def test_a_terminal_gets_a_bar_and_a_spinner():
  console, out = consoles(terminal=True)
  with Progress(100, console=console) as bar:
    bar.phase("compiling")
    bar.print("a line above")
    bar.update(50, steps_per_second=25.0, last_return=3.0)
  text = out.getvalue()
  assert "compiling" in text and "a line above" in text and "━" in text
  assert "50/100 steps  25 steps/s  ETA 0:00:02  return 3.0" in text


@pytest.mark.parametrize("terminal", [True, False])
def test_disabled_prints_only_what_is_asked(terminal: bool):
  console, out = consoles(terminal)
  with Progress(100, enabled=False, console=console) as bar:
    bar.phase("compiling")
    bar.update(100)
    bar.print("done")
  assert out.getvalue() == "done\n"


def test_a_run_goes_on_where_nobody_reads_its_output(monkeypatch: pytest.MonkeyPatch):
  reader, writer = os.pipe()
  os.close(reader)
  with os.fdopen(writer, "w") as stream:
    monkeypatch.setattr(sys, "stdout", stream)
    with lasting_stdout(), Progress(100) as bar:
      bar.print("a line")
      print("another one, without the console", flush=True)
      bar.update(100)
