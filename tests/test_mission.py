"""What the project is for, each part once as a user calls it: real tasks, processes, simulators, servers and windows.

Nothing here stands in for anything else. Other parts have such a test beside their own: several devices and resuming on
another number of them (`hardware/test_topology.py`), several processes (`runs/test_multi_node.py`), pixels
(`runs/test_pixels.py`), sweeps on this machine (`sweep/test_real.py`) and on Slurm (`sweep/test_slurm_cluster.py`), and
the page in a browser (`deploy/test_web.py`).
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import pandas as pd
import pytest

from playground.rendering.gl import NO_GL_REMEDY, find_gl
from playground.runs.run_dir import RunDirectory
from tests.deploy.untrained import free_port
from tests.processes import ROOT

pytestmark = pytest.mark.slow  # each compiles a real task, half a minute

FAST = ["env=CartpoleBalance", "tuned=null", "debug=fast", "hardware=cpu", "tracking=csv"]
ENV = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
STEPS = 400_000  # seconds of training, so that a signal finds it at work
CHAIN = f"""
# @package curriculum
defaults:
  - none
  - _self_
stages:
  balance: {{num_timesteps: 400, overrides: [env.episode_length=10]}}
  swing_up: {{num_timesteps: {STEPS}, overrides: [env=CartpoleSwingup, agent=ppo]}}
"""


def command(module: str, *args: str) -> list[str]:
  return [sys.executable, "-m", f"playground.cli.{module}", *args]


def call(module: str, *args: str, folder: Path) -> str:
  """What a command prints; it ends well."""
  done = subprocess.run(command(module, *args), cwd=folder, env=ENV, capture_output=True, text=True, timeout=600)
  assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
  return done.stdout


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """A run with a video."""
  folder = tmp_path_factory.mktemp("mission")
  call("run", *FAST, "run_dir=run", "video.enable=true", folder=folder)
  return folder / "run"


def test_training_leaves_a_video(run: Path) -> None:
  if find_gl() is None:
    pytest.skip(NO_GL_REMEDY)
  (video,) = (run / "videos").glob("*.mp4")
  frames, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
  assert frames == 20 // 2, "an episode, at 50 of the 100 states a second"


def test_a_policy_is_evaluated_exported_and_played_in_c_mujoco(run: Path) -> None:
  call("main", "eval", str(run), "--episodes", "4", "--deterministic", folder=run)
  (report,) = (run / "eval").glob("*_deterministic.json")
  trained = json.loads(report.read_text())["scores"]["episode_reward"]
  assert "same actions on 1000 observations" in " ".join(call("main", "export", str(run), folder=run).split())
  call("main", "play", str(run / "export/policy.onnx"), "--episodes", "4", folder=run)
  (report,) = (run / "export").glob("play_*.json")
  played = json.loads(report.read_text())["scores"]
  assert played["episode_length"] == 20
  assert played["episode_reward"] == pytest.approx(trained, rel=0.05), "of the same policy, in the other simulator"


def test_the_browsers_viewer_serves_until_it_is_interrupted(run: Path) -> None:
  port = free_port()
  args = command("main", "play", str(run), "--web", "--port", str(port))
  with working(args, ENV) as viewer:
    page = lambda: urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5).read()
    assert b"<html" in eventually(page, viewer).lower()
    viewer.send_signal(signal.SIGINT)
    assert viewer.wait(60) == 0


def test_mujocos_viewer_opens_its_window(run: Path) -> None:
  if not (shutil.which("Xvfb") and shutil.which("xwininfo")):
    pytest.skip("needs a display: install xvfb and x11-utils")
  numbers, told = os.pipe()
  display = subprocess.Popen(["Xvfb", "-displayfd", str(told)], pass_fds=(told,), stderr=subprocess.DEVNULL)
  try:
    screen = f":{os.read(numbers, 16).decode().strip()}"
    with working(command("main", "play", str(run), "--viewer"), ENV | {"DISPLAY": screen}) as viewer:
      windows = ["xwininfo", "-root", "-tree", "-display", screen]
      eventually(lambda: "MuJoCo" in subprocess.check_output(windows, text=True), viewer)
      viewer.send_signal(signal.SIGINT)
      assert viewer.wait(60) == 0
  finally:
    display.kill()
    display.wait()


def test_a_chain_hands_its_policy_on_and_is_resumed(tmp_path: Path) -> None:
  """A package of the user's brings the curriculum, whose second stage is another task."""
  files = {
    "mine/__init__.py": "import pathlib\nCONFIGS = pathlib.Path(__file__).parent / 'configs'\n",
    "mine/configs/env/MyCartpole.yaml": "defaults: [CartpoleBalance, _self_]\n",
    "mine/configs/curriculum/cartpoles.yaml": CHAIN.lstrip(),
    "mine-1.0.dist-info/entry_points.txt": "[playground.tasks]\nmine = mine:CONFIGS\n",
    "mine-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n",
  }
  for name, text in files.items():
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text(text)
  env = ENV | {"PYTHONPATH": f"{ROOT}{os.pathsep}{tmp_path}"}
  chain = tmp_path / "chain"
  first, second = (RunDirectory(chain / name) for name in ("1_balance", "2_swing_up"))
  line = [*FAST, "curriculum=cartpoles", "curriculum.scale=1", f"run_dir={chain}"]
  with working(command("run", *line), env) as training:
    eventually(lambda: second.metrics_csv.is_file() and "\n8" in second.metrics_csv.read_text(), training)
    training.send_signal(signal.SIGTERM)
    assert training.wait(60) == 128 + signal.SIGTERM
  assert [stage.status["status"] for stage in (first, second)] == ["finished", "preempted"]
  assert second.config["init_from"] == str(first.path)

  call("run", f"resume={chain}", folder=tmp_path)
  assert [stage.summary["steps"] for stage in (first, second)] == [400, STEPS]
  curve = pd.read_csv(chain / "metrics.csv")
  assert list(curve["stage"].unique()) == ["balance", "swing_up"]
  steps = curve["step"].to_list()
  assert steps == sorted(steps) and steps[-1] == 400 + STEPS
  assert len(curve["eval/episode_reward"].dropna()) == 2 * 2, "before and after each stage"


def test_a_sweep_on_a_ray_cluster(tmp_path: Path) -> None:
  pytest.importorskip("ray")
  call("run", "-m", *FAST, "seed=1,2", "launcher=ray", "sweep_dir=sweep", folder=tmp_path)
  table = pd.read_csv(tmp_path / "sweep/sweep.csv")
  assert list(table["status"]) == ["finished"] * 2
  assert len(table["final_return"].dropna()) == 2


@contextlib.contextmanager
def working(args: list[str], env: dict[str, str]) -> Iterator["subprocess.Popen[str]"]:
  """A process, which does not outlive the block."""
  process = subprocess.Popen(args, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
  try:
    yield process
  finally:
    process.kill()
    process.communicate()


def eventually(ask: Callable[[], Any], process: "subprocess.Popen[str]", timeout_s: float = 240.0) -> Any:
  """The first answer, while the process runs, that is something; nobody may be there to ask yet."""
  end = time.monotonic() + timeout_s
  while True:
    assert process.poll() is None, process.communicate()[0]
    assert time.monotonic() < end
    with contextlib.suppress(OSError):
      if answer := ask():
        return answer
    time.sleep(0.2)
