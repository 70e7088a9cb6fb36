"""The wheel: what is in it, and that it trains, from an empty folder, without the checkout."""

import json
import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """The wheel of this checkout, built with the build tools at hand: nothing is downloaded."""
  out = tmp_path_factory.mktemp("dist")
  command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(REPOSITORY)]
  done = subprocess.run(command, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  (built,) = out.glob("*.whl")
  return built


def test_contents(wheel: Path):
  names = set(zipfile.ZipFile(wheel).namelist())
  configs = {
    path.relative_to(REPOSITORY).as_posix()
    for folder in ("configs", "sweeps", "benchmarks")
    for pattern in ("*.yaml", "*.csv")
    for path in (REPOSITORY / folder).rglob(pattern)
  }
  package = {
    path.relative_to(REPOSITORY).as_posix()
    for pattern in ("*.py", "*.xml", "*.yaml")
    for path in (REPOSITORY / "playground").rglob(pattern)
  }
  assert {"playground/configs/config.yaml", "playground/sweeps/dm_control_ppo.yaml"} <= names
  assert any(name.endswith(".xml") for name in package)
  assert "playground/compat020/configs/env/v020/Go1JoystickFlatTerrain.yaml" in package
  assert {f"playground/{name}" for name in configs} | package <= names
  outside = {name for name in names if not name.startswith("playground/")}
  assert all(name.split("/")[0].endswith(".dist-info") for name in outside)
  assert not any("tests" in Path(name).parts for name in names)
  assert {"LICENSE", "NOTICE"} <= {Path(name).name for name in outside}
  (points,) = (name for name in outside if name.endswith("entry_points.txt"))
  assert "[playground.tasks]\ncompat020 = playground.compat020:CONFIGS" in zipfile.ZipFile(wheel).read(points).decode()


@pytest.mark.slow
def test_trains_from_an_empty_folder(wheel: Path, tmp_path: Path):
  environment, empty = tmp_path / "venv", tmp_path / "empty"
  empty.mkdir()
  venv.create(environment, with_pip=True)
  python, run = environment / "bin/python", environment / "bin/playground-run"
  subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", wheel], check=True)
  # Dependencies are those of this environment. Its own .pth files, the editable install's among them, are not read
  # there: only the paths that stand in a .pth of the new environment are added, and after its own packages.
  site = Path(sysconfig.get_path("purelib", vars={"base": str(environment)}))
  (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
  env = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}

  code = "import playground, playground.config as c; print(playground.__file__); print(c.config_roots()[0])"
  where = subprocess.run([python, "-c", code], cwd=empty, env=env, capture_output=True, text=True, check=True).stdout
  assert where.split() == [str(site / "playground/__init__.py"), str(site / "playground/configs")]

  command = [run, "debug=fast", "hardware=cpu", f"run_dir={empty / 'run'}"]
  done = subprocess.run(command, cwd=empty, env=env, capture_output=True, text=True)
  assert done.returncode == 0, done.stdout + done.stderr
  assert json.loads((empty / "run/summary.json").read_text())["status"] == "finished"
  assert [path.name for path in empty.iterdir()] == ["run"]
