"""Reads a profiler trace: a table of operations by self time."""

import gzip
import json
import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from playground.files import csv_text, write_text
from playground.settings import Plain

Event = dict[str, Plain]


class Op(NamedTuple):
  """An operation: a kernel on a GPU, a compiled operation on a CPU."""

  name: str
  calls: int
  self_s: float
  share: float  # of all operations' self time


def write_top_ops(folder: Path) -> list[Op]:
  """Reads the newest trace below a folder and writes `top_ops.csv` there.

  Args:
    folder: the argument of `jax.profiler.start_trace`.

  Returns:
    All operations, the longest first.
  """
  traces = sorted(folder.rglob("*.trace.json.gz"), key=lambda path: path.stat().st_mtime)
  ops = top_ops(traces[-1]) if traces else []
  rows = ({"op": op.name, "calls": op.calls, "self_s": f"{op.self_s:.6f}", "share": f"{op.share:.4f}"} for op in ops)
  write_text(folder / "top_ops.csv", csv_text(("op", "calls", "self_s", "share"), rows, header=True))
  return ops


def top_ops(trace: Path) -> list[Op]:
  """Returns the operations of a Chrome trace (gzipped JSON), sorted by self time: duration without nested operations.

  On a GPU an operation is a kernel on one of the streams; on a CPU an operation that XLA's threads report. The profiler
  keeps at most a million events of a trace; the table lacks the others.
  """
  with gzip.open(trace, "rt", encoding="utf-8") as file:
    events: list[Event] = json.load(file)["traceEvents"]
  calls: dict[str, int] = defaultdict(int)
  times: dict[str, float] = defaultdict(float)
  for lane in _lanes(events):
    for name, self_s in _self_times(lane):
      calls[name] += 1
      times[name] += self_s
  total = sum(times.values()) or 1.0
  ops = [Op(name, calls[name], seconds, seconds / total) for name, seconds in times.items()]
  return sorted(ops, key=lambda op: -op.self_s)


def format_ops(ops: Sequence[Op], count: int = 15) -> list[str]:
  """Formats the first operations as lines."""
  lines = [f"{op.share:6.1%} {op.self_s * 1e3:10.2f} ms {op.calls:8,} x  {op.name[:80]}" for op in ops[:count]]
  return ["  self         time      calls  operation", *lines]


def _lanes(events: Iterable[Event]) -> list[list[Event]]:
  """Returns the events of each thread that runs operations: GPU streams, else XLA's threads on the host."""
  processes, threads = {}, {}
  lanes: dict[tuple[int, int], list[Event]] = defaultdict(list)
  for event in events:
    if event.get("ph") == "M" and event["name"] == "process_name":
      processes[event["pid"]] = event["args"]["name"]
    elif event.get("ph") == "M" and event["name"] == "thread_name":
      threads[event["pid"], event["tid"]] = event["args"]["name"]
    elif event.get("ph") == "X":
      lanes[event["pid"], event["tid"]].append(event)
  on_device = {pid for pid, name in processes.items() if name.startswith("/device:")}
  streams = [key for key, name in threads.items() if key[0] in on_device and name.startswith("Stream")]
  if streams:
    return [lanes[key] for key in streams]
  hosts = [key for key, name in threads.items() if name.startswith("tf_XLA")]
  return [[event for event in lanes[key] if _is_operation(event["name"])] for key in hosts]


def _is_operation(name: str) -> bool:
  """Returns whether a host event is an operation, not a runtime event (`ThreadpoolListener::Record`) or an end mark."""
  return "::" not in name and not name.startswith("end: ") and re.match(r"[a-z]", name) is not None and " " not in name


def _self_times(lane: Sequence[Event]) -> Iterable[tuple[str, float]]:
  """Returns name and self time (s) of each event of a thread; its events are nested or disjoint."""
  open_: list[tuple[str, float, float]] = []  # name, end, self time
  for event in sorted(lane, key=lambda event: (event["ts"], -event.get("dur", 0.0))):
    begin, length = event["ts"], event.get("dur", 0.0)
    while open_ and begin >= open_[-1][1]:
      name, _, time = open_.pop()
      yield name, max(time, 0.0) * 1e-6
    if open_:
      name, end, time = open_.pop()
      open_.append((name, end, time - length))
    open_.append((event["name"], begin + length, length))
  for name, _, time in open_:
    yield name, max(time, 0.0) * 1e-6
