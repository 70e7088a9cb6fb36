"""How a machine is divided into slots, and what jobs get of it."""

import contextlib
import os
import signal
import socket
import subprocess
from pathlib import Path

import pytest

from playground.config.sweep_options import LocalConfig
from playground.errors import ConfigError, HardwareError
from playground.sweep import local
from playground.sweep.local import LocalLauncher, make_slots, pick
from playground.sweep.mps import MultiProcessService
from tests.sweep.helpers import make_sweep, run, starts, statuses


def test_gpus_are_filled_in_turn() -> None:
  slots = make_slots(["0", "3"], 2, list(range(8)), 99)
  assert [slot.gpu for slot in slots] == ["0", "3", "0", "3"]
  assert [slot.cores for slot in slots] == [(0, 1), (2, 3), (4, 5), (6, 7)]
  assert [slot.gpu for slot in pick(slots, None) or []] == ["0"]
  assert [slot.gpu for slot in pick(slots, 2) or []] == ["0", "3"]
  assert pick([slots[0], slots[2]], 2) is None, "a job's devices are different GPUs"
  assert pick([], None) is None


def test_without_gpus_cores_decide() -> None:
  assert [slot.cores for slot in make_slots([], 4, [4, 5, 6, 7], 2)] == [(4, 5), (6, 7)]
  assert [slot.cores for slot in make_slots([], 1, [4], 2)] == [(4,)]
  assert [slot.cores for slot in make_slots(["0"] * 3, 1, [1, 2], 2)] == [(1, 2)] * 3, "fewer cores than slots: shared"


def test_each_job_sees_its_own_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(local, "visible_gpus", lambda: ["5", "6"])
  sweep = make_sweep(tmp_path / "sweep", 15, 0, needs=None)
  assert run(sweep, "launcher.slots_per_gpu=2") == 0
  places = [found[0] for found in starts(sweep).values()]
  assert [place["gpus"] for place in places] == ["5", "6"]
  assert {place["XLA_CLIENT_MEM_FRACTION"] for place in places} == {"0.450"}
  both = make_sweep(tmp_path / "both", 0, needs=2)
  assert run(both) == 0
  assert starts(both)[0][0]["gpus"] == "5,6"
  assert starts(both)[0][0]["XLA_CLIENT_MEM_FRACTION"] is None
  cpu = make_sweep(tmp_path / "cpu", 0, needs=0)
  assert run(cpu) == 0
  assert starts(cpu)[0][0]["gpus"] == ""


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
  """Stands in for NVIDIA's control program; the folder has its calls (`calls`), and `up` while it runs."""
  folder = tmp_path / "service"
  folder.mkdir()
  program = folder / "nvidia-cuda-mps-control"
  program.write_text(f"""#!/bin/sh
cd {folder}
[ "$1" = -d ] && [ -e broken ] && echo "no GPU here" && exit 1
[ "$1" = -d ] && echo "start ${{CUDA_VISIBLE_DEVICES-all}} $CUDA_MPS_PIPE_DIRECTORY" >> calls && touch up && exit
read what; echo $what >> calls; [ -e up ] || exit 1; [ $what = quit ] && rm up; exit 0
""")
  program.chmod(0o755)
  monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)
  monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
  return folder


def test_jobs_share_a_gpu_through_its_service(tmp_path: Path, service: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, 1)
  assert run(sweep, "launcher.slots_per_gpu=2", "launcher.mps=true") == 0
  (pipes,) = {found[0]["CUDA_MPS_PIPE_DIRECTORY"] for found in starts(sweep).values()}
  assert (service / "calls").read_text().splitlines() == ["get_server_list", f"start all {pipes}", "quit"]
  assert not Path(pipes).exists()


def test_a_service_that_runs_already_is_used(tmp_path: Path, service: Path) -> None:
  (service / "up").touch()
  assert run(make_sweep(tmp_path / "sweep", 0), "launcher.slots_per_gpu=2", "launcher.mps=true") == 0
  assert (service / "calls").read_text().split() == ["get_server_list", "quit"]


def test_a_service_that_cannot_be_had(tmp_path: Path, service: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  shared = ("launcher.mps=true", "launcher.slots_per_gpu=2")
  sweep = make_sweep(tmp_path / "sweep", 0)
  (service / "broken").touch()
  with pytest.raises(HardwareError, match=r"^launcher\.mps=true, but nvidia-cuda-mps-control .* start: no GPU here$"):
    run(sweep, *shared)
  with pytest.raises(ConfigError, match=r"launcher\.slots_per_gpu above 1\.$"):
    run(sweep, "launcher.mps=true")
  monkeypatch.setenv("PATH", str(tmp_path))
  with pytest.raises(HardwareError, match=r"is not on PATH: leave launcher\.mps out\.$"):
    run(sweep, *shared)
  assert statuses(sweep) == {0: "queued"}


def test_sockets_lie_in_a_folder_of_this_user_alone(tmp_path: Path, service: Path) -> None:
  pipes = Path(MultiProcessService(tmp_path).environment["CUDA_MPS_PIPE_DIRECTORY"])
  MultiProcessService(tmp_path)
  pipes.chmod(0o777)
  with pytest.raises(HardwareError, match=rf"{pipes} is not a folder of yours alone"):
    MultiProcessService(tmp_path)
  pipes.rmdir()
  (tmp_path / "elsewhere").mkdir(mode=0o700)
  pipes.symlink_to(tmp_path / "elsewhere")
  try:
    with pytest.raises(HardwareError, match=rf"{pipes} is not a folder of yours alone"):
      MultiProcessService(tmp_path)
  finally:
    pipes.unlink()


def test_more_gpus_than_there_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(local, "visible_gpus", lambda: ["0"])
  sweep = make_sweep(tmp_path / "sweep", 0, needs=2)
  with pytest.raises(HardwareError, match=r"^Job 000_seed=0 asks for hardware\.devices=2, but .* has 1 GPU"):
    run(sweep)
  assert statuses(sweep) == {0: "queued"}
  with pytest.raises(HardwareError, match=r"launcher\.gpus=2, but this machine has 1\."):
    LocalLauncher(sweep, LocalConfig(gpus=2))


def test_only_jobs_of_this_machine_are_killed(tmp_path: Path) -> None:
  sweep = make_sweep(tmp_path / "sweep", 0, 1, 2)
  launcher = LocalLauncher(sweep, LocalConfig())
  processes = [subprocess.Popen(["sleep", "60"], start_new_session=True) for _ in range(2)]
  hosts = ["node07", socket.gethostname()]
  with contextlib.ExitStack() as locks:
    for job, process, host in zip(sweep.jobs, processes, hosts, strict=False):
      locks.enter_context(sweep.folder(job).claim())
      sweep.folder(job).write(status="running", host=host, job_pid=process.pid)
    locks.enter_context(sweep.folder(sweep.jobs[2]).claim())
    sweep.folder(sweep.jobs[2]).write(status="running", host=hosts[1], job_pid=1)
    launcher.kill()
  assert processes[1].wait(10) == -signal.SIGKILL
  assert processes[0].poll() is None
  processes[0].kill()
