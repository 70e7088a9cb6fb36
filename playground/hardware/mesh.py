"""Devices as a mesh of one axis, over which environments are divided (data parallel)."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding

AXIS = "data"  # the mesh's axis; inside a mapped function collectives name it


def make_mesh(num_devices: int) -> Mesh:
  """A mesh over the first `num_devices` visible devices."""
  return Mesh(np.array(jax.devices()[:num_devices]), (AXIS,))


def device_memory(mesh: Mesh) -> int | None:
  """Bytes that a program may use on the smallest device, None where the runtime does not say (CPU)."""
  limits = [(device.memory_stats() or {}).get("bytes_limit") for device in mesh.devices.flat]
  known = [limit for limit in limits if limit is not None]
  return min(known) if len(known) == len(limits) else None


def jit_on_mesh(function: Callable[..., Any], mesh: Mesh, in_specs: Any, out_specs: Any, **kwargs: Any) -> Any:
  """Jits `function` to run once on every device of the mesh, each on its share of the arguments.

  Args:
    function: sees its device's share; collectives over "data" reach the other devices.
    mesh: the devices.
    in_specs: a PartitionSpec for each argument (or a tree prefix of them): P("data") divides the leading axis.
    out_specs: the same for the results; P() promises that all devices return the same.
    **kwargs: for `jax.jit` (`donate_argnums`).
  """
  sharding = lambda specs: jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs)
  mapped = jax.shard_map(function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False)
  return jax.jit(mapped, in_shardings=sharding(in_specs), out_shardings=sharding(out_specs), **kwargs)
