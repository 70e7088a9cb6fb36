"""Clocks, locks and memory of the measurements: what is waited for, what is in the time, in which unit."""

import threading
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark.measures import machine, subject
from playground.benchmark.measures.subject import alone, rate
from playground.benchmark.worker import Rows


def test_everything_that_is_timed_is_waited_for(monkeypatch: pytest.MonkeyPatch):
  begun, waited = [], []

  def call(count: int) -> int:
    begun.append(count)
    return len(begun)

  monkeypatch.setattr(subject.jax, "block_until_ready", waited.append)
  rate(call, steps=1, seconds=0.02)
  assert len(begun) > 1 and waited == list(range(1, len(begun) + 1))


def test_one_at_a_time_is_alone(tmp_path: Path):
  lock, inside = str(tmp_path / "lock"), threading.Event()

  def enter() -> None:
    with alone(lock):
      inside.set()

  with alone(lock):
    threading.Thread(target=enter).start()
    assert not inside.wait(0.2)
  assert inside.wait(10)


def test_memory_is_in_gib(monkeypatch: pytest.MonkeyPatch):
  class Device:
    def memory_stats(self) -> dict[str, int]:
      return {"peak_bytes_in_use": 3 * 2**29}

  monkeypatch.setattr(subject.jax, "local_devices", lambda: [Device()])
  assert subject.peak_memory_gib() == 1.5


def test_used_memory_is_the_most_beyond_what_was_there(monkeypatch: pytest.MonkeyPatch):
  enough = threading.Event()
  answers = iter([1024.0, 2048.0, 4096.0, 3072.0])

  def query(field: str) -> str:
    answer = next(answers, None)
    if answer is None:
      enough.set()
    return str(answer or 1024.0)

  found: dict[str, Any] = {}
  monkeypatch.setattr(machine, "_query_gpu", query)
  monkeypatch.setattr(machine, "INTERVAL_S", 0.001)
  monkeypatch.setattr(Rows, "emit", lambda _, quantity, value, unit, **columns: found.update({quantity: value}))
  with machine.used_memory(Rows()):
    assert enough.wait(10)
  assert found == {"used_memory_gib": 3.0}
  monkeypatch.setattr(machine, "_query_gpu", lambda field: "1024")
  monkeypatch.setattr(machine, "INTERVAL_S", 60)
  with machine.used_memory(Rows()):
    pass
  assert found == {"used_memory_gib": 0.0}, "a block that ends before the first query"
