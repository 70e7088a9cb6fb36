"""Describes this machine: device, driver, versions, GPU memory in use."""

import contextlib
import os
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax

from playground.benchmark.worker import Rows
from playground.config import compose
from playground.hardware.gpus import query_gpus
from playground.hardware.setup import setup
from playground.runs.provenance import package_versions
from playground.settings import Section

_NAMES = {"python": "Python", "jax": "JAX", "mujoco": "MuJoCo", "mujoco-mjx": "MJX", "warp-lang": "Warp"}

INTERVAL_S = 0.5  # s between two queries of the driver


def measure(rows: Rows, overrides: list[str]) -> None:
  """Emits a row with the number of devices of the run that these overrides compose."""
  hardware = setup(compose(overrides).hardware)
  rows.emit("devices", hardware.mesh.size, "", device=device_name(), versions=versions())


def device_name() -> str:
  """Returns the kind of device; of a CPU also its model and number of cores, to distinguish machines."""
  kind = jax.devices()[0].device_kind
  if jax.devices()[0].platform != "cpu":
    return kind
  lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").is_file() else []
  models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
  return f"CPU {models[0]} x {len(models)}" if models else "CPU"


def versions() -> str:
  """Returns the versions of packages that affect speed, in one line."""
  driver = _query_gpu("driver_version")
  return "; ".join([_versions_of(package_versions()), *([f"driver {driver}"] if driver else [])])


def machine_of(manifest: Section) -> dict[str, str]:
  """Returns the columns `device` and `versions` of the machine that a run's manifest describes, without the driver."""
  device = "CPU" if manifest["platform"] == "cpu" else manifest["device"]
  return {"device": device, "versions": _versions_of(manifest["versions"])}


def _versions_of(packages: Mapping[str, str | None]) -> str:
  return "; ".join(f"{name} {packages[key]}" for key, name in _NAMES.items() if packages.get(key))


@contextlib.contextmanager
def used_memory(rows: Rows, seed: int | None = None) -> Iterator[None]:
  """Emits a row for the peak GPU memory during the block, minus the memory before it; no row without a GPU.

  A thread queries the driver twice a second, so that memory outside JAX (Warp's arrays, compiled code) counts.
  """
  ask = lambda: float(_query_gpu("memory.used") or "nan")
  before = most = ask()
  ended = threading.Event()

  def watch() -> None:
    nonlocal most
    while not ended.wait(INTERVAL_S):
      most = max(most, ask())

  watcher = threading.Thread(target=watch, daemon=True)
  if before == before:
    watcher.start()
  try:
    yield
  finally:
    ended.set()
  if before == before:
    watcher.join()
    rows.emit("used_memory_gib", (most - before) / 1024, "GiB", seed=seed)


def _query_gpu(field: str) -> str | None:
  """Returns a field of nvidia-smi for the first GPU of this process; None without one."""
  first = os.environ.get("CUDA_VISIBLE_DEVICES", "0").split(",")[0] or "0"
  return next(iter(query_gpus(field, [f"--id={first}"])), None)
