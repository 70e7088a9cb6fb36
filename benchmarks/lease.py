#!/usr/bin/env python3
"""Trains sweeps/queue.yaml on GPUs that are lent for a while, and packs what has ended for the way home.

  python benchmarks/lease.py train FOLDER SECONDS [overrides]   after SECONDS the runs save and end; call again to go on
  python benchmarks/lease.py pack FOLDER OUT [MIB PARTS]        OUT/pack.000 ...: at most PARTS files of MIB MiB (15, 4)

A pack has metrics, configuration, policy and first non-finite state of each job that has ended since the last pack. It
lacks training state and replay buffer, which only a resume needs. At home: `cat pack.* | tar x`, or a pack after the
other, each its own archive.
"""

import io
import json
import signal
import subprocess
import sys
import tarfile
from pathlib import Path

_OVERHEAD = 5 * 512  # bytes of a file in an archive, at most: header, a long name's header and blocks, padding
FILES = ("config.yaml", "overrides.yaml", "manifest.json", "metrics.csv", "status.json", "summary.json", "job.log")


def train(folder: Path, seconds: float, overrides: list[str]) -> int:
  """Runs the queue for a time, or until its end; returns the sweep's exit code."""
  process = subprocess.Popen(["playground-run", "-m", "sweep=queue", f"sweep_dir={folder}", *overrides])
  try:
    return process.wait(seconds)
  except subprocess.TimeoutExpired:
    process.send_signal(signal.SIGTERM)
    return process.wait()


def pack(folder: Path, out: Path, part: int, parts: int) -> list[str]:
  """Packs jobs that have ended since they were last packed, as many as fit.

  Args:
    folder: the sweep's.
    out: where the parts go; earlier packs there are replaced.
    part: bytes of a part, at most.
    parts: at most.

  Returns:
    Names of the packed jobs; `folder/packed.json` remembers when each had ended.
  """
  record = folder / "packed.json"
  packed: dict[str, str] = json.loads(record.read_text()) if record.is_file() else {}
  names, size, archive = [], 0, io.BytesIO()
  with tarfile.open(fileobj=archive, mode="w", format=tarfile.GNU_FORMAT) as tar:
    for job in sorted((folder / "jobs").iterdir()):
      path = job / "status.json"
      status = json.loads(path.read_text()) if path.is_file() else {"status": "running"}
      if status["status"] == "running" or packed.get(job.name) == status["updated"]:
        continue
      members = _members(job)
      needed = sum(path.lstat().st_size + _OVERHEAD for path in members)
      if size + needed > part * parts - 10240:  # the archive's end
        print(f"{job.name} has {needed / 2**20:.1f} MiB and does not fit: next time, or with more MIB or PARTS")
        continue
      for path in members:
        tar.add(path, path.relative_to(folder / "jobs"), recursive=False)
      size += needed
      names.append(job.name)
      packed[job.name] = status["updated"]
  out.mkdir(parents=True, exist_ok=True)
  for old in out.glob("pack.*"):
    old.unlink()
  if names:
    data = archive.getvalue()
    for i, start in enumerate(range(0, len(data), part)):
      (out / f"pack.{i:03}").write_bytes(data[start : start + part])
    record.write_text(json.dumps(packed))
  return names


def _members(job: Path) -> list[Path]:
  """Returns a job's small files, its newest and best policy, and its first dump.

  A curriculum's stages are folders of the job, each with the same.
  """
  checkpoints, best = job / "checkpoints", job / "checkpoints" / "best"
  steps = sorted(path.name for path in checkpoints.glob("*") if path.name.isdecimal())
  found = [job / name for name in FILES if (job / name).is_file()] + [best] * best.is_symlink()
  found += sorted((job / "nan_dump").glob("*.npz"))[:1]
  for step in {*steps[-1:], *[step for step in steps if best.exists() and step == best.resolve().name]}:
    parts = [path for path in (checkpoints / step).iterdir() if path.name not in ("state", "replay")]
    found += [path for part in parts for path in (part, *part.rglob("*")) if path.is_file()]
  stages = sorted(path.parent for path in job.glob("*/status.json"))
  return found + [path for stage in stages for path in _members(stage)]


def main(arguments: list[str]) -> int:
  """Runs the command line; returns the exit code."""
  match arguments:
    case ["train", folder, seconds, *overrides]:
      return train(Path(folder), float(seconds), overrides)
    case ["pack", folder, out, *limits] if len(limits) in (0, 2) and (Path(folder) / "jobs").is_dir():
      mib, parts = map(int, limits or (15, 4))
      print("packed", *pack(Path(folder), Path(out), mib * 2**20, parts))
      return 0
  print(__doc__, file=sys.stderr)
  return 2


if __name__ == "__main__":
  sys.exit(main(sys.argv[1:]))
