"""From the `hardware` config to devices: platform, precision, memory and compilation caches."""

import dataclasses
import math
import os
import warnings
from pathlib import Path

import jax
from jax.sharding import Mesh

from playground.errors import HardwareError
from playground.hardware.distributed import init_distributed
from playground.hardware.gpus import MEMORY_VARIABLES
from playground.hardware.mesh import make_mesh
from playground.hardware.options import HardwareConfig, Platform
from playground.text import first_line

CACHE = Path("~/.cache/playground")
# Flags by the first version of JAX without them: XLA ends the process over a flag that it does not know.
_REMOVED_FLAGS = {"--xla_cpu_use_fusion_emitters": (0, 11)}


@dataclasses.dataclass(frozen=True)
class Hardware:
  """The devices that a run trains on."""

  mesh: Mesh
  network_precision: str | None
  machine: dict[str, object]  # its device, number of devices, precision and cache, for the manifest


def setup(config: HardwareConfig) -> Hardware:
  """Applies the `hardware` config to this process and returns its devices.

  Call it before JAX touches a device: platform, memory and flags cannot change afterwards.

  Raises:
    HardwareError: this machine lacks the devices, or other processes of the training do not connect.
  """
  _environment(config)
  if config.platform == "cpu":
    jax.config.update("jax_platforms", "cpu")
  init_distributed(config)
  jax.config.update("jax_default_matmul_precision", config.matmul_precision)
  cache = _caches(config)
  try:
    devices = jax.local_devices()
  except (RuntimeError, AssertionError) as error:
    named, why = os.environ.get("JAX_PLATFORMS"), str(error) and f" ({first_line(error)})"
    raise HardwareError(
      f"JAX finds no device {f'of JAX_PLATFORMS={named}' if named else 'here'}{why}: `playground doctor` says what is "
      "missing, hardware=cpu runs without a GPU."
    ) from error
  if config.platform == "gpu" and devices[0].platform != "gpu":
    raise HardwareError(
      "hardware.platform=gpu, but JAX sees no GPU: `playground doctor` says what is missing, hardware=cpu runs without."
    )
  count = len(devices) if config.devices is None else config.devices
  if not 1 <= count <= len(devices):
    divide = f": JAX_NUM_CPU_DEVICES={count} divides the CPU" if devices[0].platform == "cpu" and count > 0 else ""
    found = f"{len(devices)} ({devices[0].device_kind})"
    raise HardwareError(f"hardware.devices={count}, but this machine has {found}{divide}.")
  if config.kind is not None and config.kind.lower() not in devices[0].device_kind.lower():
    raise HardwareError(
      f"hardware.kind={config.kind}, but this machine has {devices[0].device_kind}: hardware=gpu takes any GPU."
    )
  mesh = make_mesh(count)
  machine = {
    "platform": devices[0].platform,
    "device": devices[0].device_kind,
    "num_devices": mesh.size,
    "num_processes": jax.process_count(),
    "matmul_precision": config.matmul_precision,
    "network_precision": config.network_precision,
    "compilation_cache": cache,
  }
  return Hardware(mesh, config.network_precision, machine)


def this_machine(hardware: HardwareConfig, platform: Platform | None = None) -> HardwareConfig:
  """Returns a run's `hardware` config for one device of this machine, of any type or of a platform."""
  platform = platform or ("cpu" if hardware.platform == "cpu" else "auto")
  alone = dataclasses.replace(hardware.distributed, enable=False)
  return dataclasses.replace(hardware, devices=1, kind=None, xla_flags="", distributed=alone, platform=platform)


def cache_dir(config: HardwareConfig) -> Path:
  """Returns the folder of compiled programs that runs share."""
  return Path(config.cache_dir or CACHE).expanduser()


def _environment(config: HardwareConfig) -> None:
  """Sets variables that the GPU runtime reads at its start; exported ones win."""
  os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", str(bool(config.preallocate)).lower())
  if config.memory_fraction is not None and not any(name in os.environ for name in MEMORY_VARIABLES):
    os.environ[MEMORY_VARIABLES[0]] = str(config.memory_fraction)
  known = lambda flag: jax.__version_info__ < _REMOVED_FLAGS.get(flag.partition("=")[0], (math.inf,))
  exported = os.environ.get("XLA_FLAGS", "").split()
  names = {flag.partition("=")[0] for flag in exported}
  added = [flag for flag in config.xla_flags.split() if known(flag) and flag.partition("=")[0] not in names]
  if added:  # a chain calls this often
    from jax._src.xla_bridge import backends_are_initialized  # JAX has no public name for it

    if not backends_are_initialized():
      os.environ["XLA_FLAGS"] = " ".join([*exported, *added])
    else:  # the variable stays: processes started from here, and keys of JAX's cache, read it
      what = "does not act: JAX has started in this process already. Train in a new process, or export XLA_FLAGS first."
      warnings.warn(f"hardware.xla_flags={' '.join(added)} {what}", stacklevel=3)


def _caches(config: HardwareConfig) -> str | None:
  """Turns on JAX's and Warp's persistent caches; a cache the user set up already is left as it is."""
  if not config.compilation_cache:
    return None
  folder = cache_dir(config)
  os.environ.setdefault("WARP_CACHE_PATH", str(folder / "warp"))
  if not jax.config.jax_compilation_cache_dir:
    jax.config.update("jax_compilation_cache_dir", str(folder / "xla"))
  least = min(0.5, jax.config.jax_persistent_cache_min_compile_time_secs)  # the environment may limit it further
  jax.config.update("jax_persistent_cache_min_compile_time_secs", least)
  jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
  return jax.config.jax_compilation_cache_dir
