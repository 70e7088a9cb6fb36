"""Records the commit of this checkout and the versions of the packages that affect results."""

import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import TypedDict


class GitState(TypedDict):
  """The commit of a checkout, and whether files differ from it."""

  commit: str
  dirty: bool


PACKAGES = (
  "playground-run",
  "jax",
  "jaxlib",
  "mujoco",
  "mujoco-mjx",
  "warp-lang",
  "brax",
  "flax",
  "optax",
  "orbax-checkpoint",
  "hydra-core",
  "torch",
  "rsl-rl-lib",
)


def package_version(name: str) -> str | None:
  """Returns the installed version of a distribution without importing it, or None."""
  try:
    return metadata.version(name)
  except metadata.PackageNotFoundError:
    return None


def package_versions() -> dict[str, str | None]:
  """Returns Python's version and that of every package in `PACKAGES`; None for one that is not installed."""
  return {"python": platform.python_version()} | {name: package_version(name) for name in PACKAGES}


def git_state(root: Path = Path(__file__).parents[2]) -> GitState | None:
  """Returns {"commit", "dirty"} of the checkout that this package runs from, or None outside one."""
  # A wheel in a venv inside another repository must not report that repository's commit as ours.
  toplevel = _git(root, "rev-parse", "--show-toplevel")
  commit = _git(root, "rev-parse", "HEAD")
  if not toplevel or not commit or Path(toplevel).resolve() != root.resolve():
    return None
  return {"commit": commit, "dirty": bool(_git(root, "status", "--porcelain"))}


def process_age_s() -> float:
  """Returns seconds since this process started, interpreter and imports included; 0 without /proc."""
  try:
    started_ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    uptime = float(Path("/proc/uptime").read_text().split()[0])
  except (OSError, ValueError, IndexError):
    return 0.0
  return uptime - started_ticks / os.sysconf("SC_CLK_TCK")


def _git(root: Path, *args: str) -> str | None:
  try:
    done = subprocess.run(["git", "-C", str(root), *args], capture_output=True, text=True, timeout=20)
  except (OSError, subprocess.TimeoutExpired):
    return None
  return done.stdout.strip() if done.returncode == 0 else None
