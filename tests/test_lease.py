"""benchmarks/lease.py packs runs for the way home."""

import importlib.util
import json
import subprocess
import tarfile
from pathlib import Path

import pytest

PATH = Path(__file__).parents[1] / "benchmarks" / "lease.py"
spec = importlib.util.spec_from_file_location("lease", PATH)
assert spec and spec.loader
lease = importlib.util.module_from_spec(spec)
spec.loader.exec_module(lease)


def make_job(sweep: Path, name: str, status: str = "finished", size: int = 1000) -> None:
  job = sweep / "jobs" / name
  for step in ("000", "100", "200"):
    for part in ("policy/d/x", "state/d/x", "replay/d/x", "meta/m"):
      path = job / "checkpoints" / step / part
      path.parent.mkdir(parents=True)
      path.write_bytes(b"x" * size)
  (job / "checkpoints" / "best").symlink_to("100")
  (job / "nan_dump").mkdir()
  for step in (150, 120):
    (job / "nan_dump" / f"step_{step:012d}.npz").write_bytes(b"x")
  (job / "metrics.csv").write_text("step")
  (job / "status.json").write_text(json.dumps({"status": status, "updated": "8:00"}))


def packed(out: Path, to: Path) -> set[str]:
  """Unpacks and returns the names of the files."""
  data = b"".join(path.read_bytes() for path in sorted(out.glob("pack.*")))
  (to / "all.tar").write_bytes(data)
  with tarfile.open(to / "all.tar") as tar:
    return set(tar.getnames())


def test_a_pack_has_the_policies_of_jobs_that_ended_once(tmp_path: Path) -> None:
  for name, status in (("0_a", "finished"), ("1_b", "running"), ("2_c", "preempted")):
    make_job(tmp_path, name, status)
  assert lease.main(["pack", str(tmp_path), str(tmp_path / "out")]) == 0
  inside = {"metrics.csv", "status.json", "checkpoints/best", "nan_dump/step_000000000120.npz"}
  inside |= {f"checkpoints/{step}/{part}" for step in ("100", "200") for part in ("policy/d/x", "meta/m")}
  assert packed(tmp_path / "out", tmp_path) == {f"{job}/{name}" for job in ("0_a", "2_c") for name in inside}
  (tmp_path / "jobs" / "1_b" / "status.json").write_text('{"status": "finished", "updated": "9:00"}')
  assert lease.pack(tmp_path, tmp_path / "out", 2**20, 1) == ["1_b"]
  (tmp_path / "jobs" / "2_c" / "status.json").write_text('{"status": "finished", "updated": "9:00"}')  # it went on
  assert lease.pack(tmp_path, tmp_path / "out", 2**20, 1) == ["2_c"]
  assert lease.pack(tmp_path, tmp_path / "out", 2**20, 1) == []
  assert not list((tmp_path / "out").glob("pack.*"))


def test_a_pack_has_the_policies_of_a_chains_stages(tmp_path: Path) -> None:
  make_job(tmp_path, "0_chain/1_dense")
  chain = tmp_path / "jobs" / "0_chain"
  (chain / "metrics.csv").write_text("step,stage")
  (chain / "status.json").write_text('{"status": "finished", "updated": "8:00"}')
  assert lease.pack(tmp_path, tmp_path / "out", 2**20, 1) == ["0_chain"]
  names = packed(tmp_path / "out", tmp_path)
  assert {"0_chain/metrics.csv", "0_chain/1_dense/metrics.csv", "0_chain/1_dense/checkpoints/200/policy/d/x"} <= names
  assert not any("/state/" in name or "/replay/" in name for name in names)


def test_no_part_is_larger_than_allowed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  for name in ("0_a", "1_b"):
    make_job(tmp_path, name, size=30_000)
  assert lease.pack(tmp_path, tmp_path / "out", 50_000, 4) == ["0_a"]
  assert "1_b has 0.1 MiB and does not fit" in capsys.readouterr().out
  sizes = [path.stat().st_size for path in (tmp_path / "out").iterdir()]
  assert len(sizes) <= 4 and max(sizes) <= 50_000
  assert lease.pack(tmp_path, tmp_path / "out", 50_000, 4) == ["1_b"]


def test_small_files_with_long_names_fit_too(tmp_path: Path) -> None:
  for i in range(5):
    make_job(tmp_path, f"{i}_{'long' * 30}", size=10)
  while lease.pack(tmp_path, tmp_path / "out", 50_000, 1):
    assert [path.stat().st_size <= 50_000 for path in (tmp_path / "out").iterdir()] == [True]


def test_the_queue_is_stopped_after_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  calls = []
  real = subprocess.Popen

  def popen(command: list[str]) -> subprocess.Popen:
    calls.append(command)
    return real(["sleep", "60"])

  monkeypatch.setattr(lease.subprocess, "Popen", popen)
  assert lease.main(["train", str(tmp_path), "0.1", "launcher.mps=true"]) == -15
  assert calls == [["playground-run", "-m", "sweep=queue", f"sweep_dir={tmp_path}", "launcher.mps=true"]]


@pytest.mark.parametrize("arguments", [[], ["train", "x"], ["pack", "nothing", "out"], ["pack", ".", "out", "3"]])
def test_what_is_not_understood_is_answered_with_the_usage(arguments: list[str]) -> None:
  assert lease.main(arguments) == 2
