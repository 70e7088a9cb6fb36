"""Packages of somebody else that tests install: a robot alone, terms alone, an algorithm. docs/ shows their files."""

import os
import shutil
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

from tests.processes import WITHOUT_WARP

PACKAGES = Path(__file__).parent


def install(package: Path, site: Path) -> Path:
  """Copies a package to a folder of packages, with the entry points of its pyproject.toml, as pip would."""
  project = tomllib.loads((package / "pyproject.toml").read_text(encoding="utf-8"))["project"]
  shutil.copytree(package, site, dirs_exist_ok=True, ignore=shutil.ignore_patterns("pyproject.toml", "__pycache__"))
  info = site / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
  info.mkdir()
  (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
  points = (
    f"[{group}]\n" + "\n".join(f"{k} = {v}" for k, v in named.items())
    for group, named in project["entry-points"].items()
  )
  (info / "entry_points.txt").write_text("\n".join(points))
  return site


def run(site: Path, *command: str, cwd: Path | None = None) -> str:
  """Runs Python with the folder's packages installed, `-c code` or `-m module ...`; returns what it prints."""
  path = os.pathsep.join([str(site), WITHOUT_WARP["PYTHONPATH"]])
  command = tuple(textwrap.dedent(word) for word in command)
  env = {**os.environ, "PYTHONPATH": path}
  done = subprocess.run([sys.executable, *command], env=env, cwd=cwd, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  return done.stdout
