"""Devices as a mesh of one axis, over which environments are divided (data parallel).

A mesh for several agents has a second axis before it. Arrays on such a mesh have an axis of agents before all others;
functions are written for one agent.
"""

import math
import os
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jax.stages import Wrapped

from playground.pytree import PyTree

AXIS = "data"  # the mesh's axis, which collectives name
AGENTS = "agents"  # the axis over which agents are divided
GROUP = "group"  # the axis of the agents that share a device, inside a mapped function
_SCHEDULING = "xla_gpu_command_buffer_scheduling_mode"


def make_mesh(num_devices: int) -> Mesh:
  """Returns a mesh over the first `num_devices` visible devices of every process (mostly one process)."""
  devices = sorted(jax.devices(), key=lambda device: (device.process_index, device.id))
  mine = lambda index: [device for device in devices if device.process_index == index][:num_devices]
  return Mesh(np.array([device for i in range(jax.process_count()) for device in mine(i)]), (AXIS,))


def for_agents(mesh: Mesh, count: int) -> Mesh:
  """Returns a mesh of the same devices for several agents: divides agents first, then each one's environments."""
  return Mesh(mesh.devices.reshape(math.gcd(count, mesh.size), -1), (AGENTS, AXIS))


def gather_on_mesh(function: Callable[..., PyTree], mesh: Mesh, spec: PyTree) -> Wrapped:
  """Jits a function of one tree, divided by `spec`, whose results are then whole on every device."""
  return jax.jit(function, in_shardings=(_shardings(mesh, spec),), out_shardings=NamedSharding(mesh, P()))


def shard(tree: PyTree, mesh: Mesh) -> PyTree:
  """Divides arrays that every process has over the devices, by their leading axis."""
  if jax.process_count() == 1:  # functions jitted over the mesh take them unchanged
    return tree
  return put(tree, mesh, P(AXIS))


def put(tree: PyTree, mesh: Mesh, spec: PyTree) -> PyTree:
  """Puts host arrays, the same in every process, on the devices by `spec` (a tree prefix); shares no buffer."""
  shardings = _shardings(mesh, spec)
  if jax.process_count() == 1:
    return jax.device_put(tree, shardings, may_alias=False)

  def place(sharding: NamedSharding, part: PyTree) -> PyTree:
    hosts = jax.tree.map(np.asarray, part)  # device_put would compare them between the processes, one by one
    return jax.tree.map(lambda x: jax.make_array_from_callback(x.shape, sharding, lambda index: x[index]), hosts)

  return jax.tree.map(place, shardings, tree)


def local_shard(array: jax.Array | np.ndarray, axis: int) -> np.ndarray:
  """Returns this process's part of an array that is divided by `axis`, on the host."""
  if isinstance(array, np.ndarray) or array.is_fully_addressable or array.is_fully_replicated:
    return np.asarray(array)
  parts = sorted(array.addressable_shards, key=lambda part: part.index[axis].start or 0)
  return np.concatenate([np.asarray(part.data) for part in parts], axis)


def _shardings(mesh: Mesh, specs: PyTree) -> PyTree:
  """Returns the shardings of specs for one agent."""
  agents = (AGENTS,) if AGENTS in mesh.axis_names else ()
  return jax.tree.map(lambda spec: NamedSharding(mesh, P(*agents, *spec)), specs)


def take_agents(tree: PyTree, indices: np.ndarray, mesh: Mesh, spec: PyTree) -> PyTree:
  """Returns the shards of these agents of a tree, in their order; `spec` is that of one agent."""
  return jax.jit(_take, out_shardings=_shardings(mesh, spec))(tree, indices)


def _take(tree: PyTree, indices: jax.Array) -> PyTree:
  return jax.tree.map(lambda x: x[indices], tree)


def device_memory(mesh: Mesh) -> int | None:
  """Returns the bytes available on the smallest device (on a CPU its share of host memory); None if unknown."""
  if mesh.devices.flat[0].platform == "cpu":
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // len(mesh.local_devices)
  limits = [(device.memory_stats() or {}).get("bytes_limit") for device in mesh.devices.flat]
  known = [limit for limit in limits if limit]  # CUDA's own pool, XLA_PYTHON_CLIENT_ALLOCATOR=cuda_async, says 0
  return min(known) if len(known) == len(limits) else None


def compiler_options(mesh: Mesh, impl: str) -> dict[str, str]:
  """Returns XLA's options for programs on a mesh, with this physics backend (measured: docs/results-profile.md).

  On one GPU, kernels that do not depend on each other run at the same time. Warp's run at half the rate with it. An
  exported XLA_FLAGS wins.
  """
  on_gpu = mesh.size == 1 and mesh.devices.flat[0].platform == "gpu"
  if not on_gpu or impl == "warp" or _SCHEDULING in os.environ.get("XLA_FLAGS", ""):
    return {}
  return {_SCHEDULING: "CONCURRENT"}


def jit_on_mesh(
  function: Callable[..., PyTree], mesh: Mesh, in_specs: PyTree, out_specs: PyTree, donate_argnums: int | None = None
) -> Wrapped:
  """Jits `function` to run once on every device of the mesh, each on its share of the arguments.

  Args:
    function: gets its device's share; collectives over "data" reach the other devices.
    mesh: the devices. If it is one for several agents, arguments and results have an axis of agents in front.
    in_specs: a PartitionSpec for each argument (or a tree prefix of them): P("data") divides the leading axis. None is
      an argument that is the same for all devices and all agents.
    out_specs: the same for the results; P() promises that all devices return the same.
    donate_argnums: the argument whose buffers the result takes over.
  """
  if AGENTS in mesh.axis_names:
    function = jax.vmap(function, tuple(None if spec is None else 0 for spec in in_specs), axis_name=GROUP)
  ins = tuple(NamedSharding(mesh, P()) if spec is None else _shardings(mesh, spec) for spec in in_specs)
  outs = _shardings(mesh, out_specs)
  in_specs, out_specs = jax.tree.map(lambda sharding: sharding.spec, (ins, outs))
  over_mesh = lambda function: jax.shard_map(
    function, mesh=mesh, in_specs=in_specs, out_specs=out_specs, check_vma=False
  )
  mapped = over_mesh(function) if mesh.size == 1 else _without_empty_arrays(function, over_mesh)
  # An argument that is not used, such as an empty array, would lose its sharding in a stored program.
  keep = mesh.size > 1
  return jax.jit(mapped, in_shardings=ins, out_shardings=outs, donate_argnums=donate_argnums, keep_unused=keep)


def _without_empty_arrays(function: Callable[..., PyTree], over_mesh: Callable[..., PyTree]) -> Callable[..., PyTree]:
  """`over_mesh(function)`, with empty arrays padded at its inputs and outputs.

  A mocap body's pose in a model without one is such an array. JAX 0.11.2 dies of a segmentation fault compiling
  a shard_map over several devices that takes and returns one (Shardy's ManualComputationUnusedInputsPattern).
  """

  def mapped(*args: PyTree) -> PyTree:
    out_axes: PyTree = None

    def body(*filled: PyTree) -> PyTree:
      nonlocal out_axes
      out = function(*_cut(filled, in_axes))
      out_axes = _empty_axes(out)
      return _fill(out)

    in_axes = _empty_axes(args)
    return _cut(over_mesh(body)(*_fill(args)), out_axes)

  return mapped


def _empty_axes(tree: PyTree) -> list[list[int]]:
  """Returns the axes of length 0 of each leaf."""
  return [[axis for axis, size in enumerate(jnp.shape(x)) if size == 0] for x in jax.tree.leaves(tree)]


def _fill(tree: PyTree) -> PyTree:
  """Returns the tree with axes of length 0 padded to 1."""
  some = lambda x: jnp.zeros([size or 1 for size in x.shape], x.dtype) if 0 in jnp.shape(x) else x
  return jax.tree.map(some, tree)


def _cut(tree: PyTree, axes: list[list[int]]) -> PyTree:
  """Returns the tree with these axes of its leaves cut to length 0."""
  leaves, structure = jax.tree.flatten(tree)
  for i, empty in enumerate(axes):
    for axis in empty:
      leaves[i] = jax.lax.slice_in_dim(leaves[i], 0, 0, axis=axis)
  return jax.tree.unflatten(structure, leaves)
