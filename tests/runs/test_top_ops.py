"""The table of a trace's operations: self times, on a GPU's streams and on a CPU's threads."""

import gzip
import json
from pathlib import Path

import pytest

from playground import registry
from playground.config import compose
from playground.runs.top_ops import format_ops, top_ops, write_top_ops
from playground.runs.train import train
from tests.dummy import Point


def trace(folder: Path, process: str, threads: dict[int, str], events: list[tuple[int, str, float, float]]) -> Path:
  """A Chrome trace with events (thread, name, begin, length), in microseconds."""
  meta = [{"ph": "M", "pid": 1, "name": "process_name", "args": {"name": process}}]
  meta += [{"ph": "M", "pid": 1, "tid": tid, "name": "thread_name", "args": {"name": n}} for tid, n in threads.items()]
  spans = [{"ph": "X", "pid": 1, "tid": t, "name": name, "ts": ts, "dur": dur} for t, name, ts, dur in events]
  path = folder / "plugins" / "profile" / "now" / "host.trace.json.gz"
  path.parent.mkdir(parents=True)
  with gzip.open(path, "wt") as file:
    json.dump({"traceEvents": [*meta, *spans]}, file)
  return path


def test_kernels_of_a_gpus_streams(tmp_path: Path):
  threads = {1: "Stream #13(Compute)", 2: "Stream #14(MemcpyD2D)", 3: "XLA Ops"}
  events = [
    (1, "gemm", 0, 3e6),
    (1, "fusion", 3e6, 1e6),
    (1, "fusion", 4e6, 1e6),
    (2, "copy", 0, 5e6),
    (3, "gemm", 0, 9e6),
  ]
  ops = top_ops(trace(tmp_path, "/device:GPU:0 stuff", threads, events))
  assert [(op.name, op.calls, op.self_s) for op in ops] == [("copy", 1, 5.0), ("gemm", 1, 3.0), ("fusion", 2, 2.0)]
  assert [op.share for op in ops] == [0.5, 0.3, 0.2]


def test_what_runs_inside_an_operation_is_not_its_own(tmp_path: Path):
  events = [
    (1, "while.5", 0.0, 10.0),
    (1, "dot.1", 1.0, 6.0),
    (1, "inner", 2.0, 1.0),
    (1, "dot.1", 7.0, 2.0),
    (1, "end: while.5", 10.0, 0.0),
    (1, "ThreadpoolListener::Record", 3.0, 1.0),
    (2, "not_xla", 0.0, 50.0),
  ]
  ops = top_ops(trace(tmp_path, "/host:CPU", {1: "tf_XLAEigen/1", 2: "python"}, events))
  found = {op.name: (op.calls, round(op.self_s * 1e6, 6)) for op in ops}
  assert found == {"dot.1": (2, 7.0), "while.5": (1, 2.0), "inner": (1, 1.0)}


def test_the_table_is_written_and_printed(tmp_path: Path):
  trace(tmp_path, "/host:CPU", {1: "tf_XLAEigen/1"}, [(1, "dot", 0.0, 4e6)])
  ops = write_top_ops(tmp_path)
  assert (tmp_path / "top_ops.csv").read_text() == "op,calls,self_s,share\ndot,1,4.000000,1.0000\n"
  assert format_ops(ops)[1].split() == ["100.0%", "4000.00", "ms", "1", "x", "dot"]


def test_without_a_trace_the_table_is_empty(tmp_path: Path):
  assert write_top_ops(tmp_path) == []
  assert (tmp_path / "top_ops.csv").read_text() == "op,calls,self_s,share\n"


def test_a_run_with_debug_profile_leaves_the_table(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
  monkeypatch.setattr(registry, "load", lambda name, config=None: Point())
  short = ["agent.num_timesteps=1600", "agent.num_evals=2", "hardware=cpu", "tracking=csv"]
  config = compose(["env=CartpoleBalance", "tuned=null", "debug=[fast,profile]", *short, f"run_dir={tmp_path / 'run'}"])
  assert train(config) == 0
  lines = (tmp_path / "run/profile/top_ops.csv").read_text().splitlines()
  assert lines[0] == "op,calls,self_s,share" and len(lines) > 5
  assert lines[1].split(",")[0] in capsys.readouterr().out


@pytest.mark.slow
def test_what_jax_writes_has_operations(tmp_path: Path):
  import jax
  import jax.numpy as jnp

  function = jax.jit(lambda x: jax.lax.fori_loop(0, 50, lambda _, x: jnp.tanh(x @ x), x))
  x = jnp.eye(200)
  function(x).block_until_ready()
  with jax.profiler.trace(str(tmp_path)):
    function(x).block_until_ready()
  assert max(op.calls for op in write_top_ops(tmp_path)) >= 50
