"""One training over several machines: how its processes find each other, agree, and prove that they can talk.

Every machine runs the same command; process 0 writes the run directory, the others only compute.
"""

import contextlib
import hashlib
import json
import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from playground.errors import ConfigError, HardwareError, PlaygroundError

PREFLIGHT = "preflight"  # name of the thread that may hang


def is_main() -> bool:
  """Whether this process is the one that writes."""
  return jax.process_index() == 0


def several() -> bool:
  """Whether a training spans more than one process."""
  return jax.process_count() > 1


def agree(flag: bool) -> bool:
  """Whether any process says so. All of them must ask, in the same order."""
  if not several():
    return flag
  from jax.experimental import multihost_utils

  return bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def join(config: Any) -> None:
  """Joins the training's other processes, if `hardware.distributed` says that there are any.

  They come from Slurm (or whatever else JAX knows), or from the keys coordinator, num_processes and process_id. Call it
  before JAX touches a device; only the first call does anything.

  Raises:
    ConfigError: too little is known to find them.
    HardwareError: they do not come, or cannot be reached.
  """
  keys = ("coordinator", "num_processes", "process_id")
  given = {key: config.distributed[key] for key in keys}
  if not config.distributed.enable:
    if named := [key for key in keys if given[key] is not None]:
      raise ConfigError(f"hardware.distributed.{named[0]} needs hardware=multi_node.")
    return
  if jax.distributed.is_initialized():
    return
  explicit = [key for key in keys if given[key] is not None]
  if explicit and len(explicit) < len(keys):
    missing = next(key for key in keys if given[key] is None)
    raise ConfigError(f"hardware.distributed.{missing} is missing: {', '.join(keys)} go together.")
  if not explicit and not _known_cluster():
    raise ConfigError(
      "hardware=multi_node finds no cluster here (Slurm, Open MPI, Kubernetes, …): start it with srun, or set "
      "hardware.distributed.coordinator=<host:port>, num_processes and process_id."
    )
  timeout = config.distributed.timeout
  if explicit:
    _check(**given)
  if explicit and given["process_id"] > 0:
    _reach(given["coordinator"], timeout)
  # Its handler of SIGTERM would replace ours, which saves.
  jax.config.update("jax_enable_preemption_service", False)
  # CPUs only: two programs in flight would exchange in an order of their own in each process.
  jax.config.update("jax_cpu_collectives_implementation", "gloo")
  jax.config.update("jax_cpu_enable_async_dispatch", False)
  where = f"{given['num_processes']} processes at {given['coordinator']}" if explicit else "the cluster's processes"
  arguments = {"coordinator_address": given["coordinator"]} | {key: given[key] for key in keys[1:]}
  _within(
    lambda: jax.distributed.initialize(
      **arguments, local_device_ids=_local_device_ids(), initialization_timeout=round(timeout) + 60
    ),
    timeout,  # JAX's own is later: it aborts the process
    f"not all of {where} came within hardware.distributed.timeout={timeout:g} s",
  )


def preflight(config: Any, fingerprint: Any) -> None:
  """A first exchange between all processes, which also checks that they train the same.

  Args:
    config: `hardware`.
    fingerprint: what must be equal everywhere, such as the resolved configuration.

  Raises:
    HardwareError: it takes longer than `hardware.distributed.timeout`.
    ConfigError: they differ.
  """
  if not several():
    return
  from jax.experimental import multihost_utils

  digest = hashlib.sha256(json.dumps(fingerprint, sort_keys=True, default=str).encode()).digest()
  ours = np.frombuffer(digest[:8], np.uint32)
  timeout = config.distributed.timeout
  all_of_them = _within(
    lambda: np.asarray(multihost_utils.process_allgather(ours)),
    timeout,
    f"process {jax.process_index()} on {socket.gethostname()} found the other {jax.process_count() - 1}, but a first "
    f"exchange between their devices did not end within hardware.distributed.timeout={timeout:g} s: is their network "
    "open to each other (NCCL_DEBUG=INFO says more, NCCL_SOCKET_IFNAME picks an interface)?",
  )
  if differ := [i for i, theirs in enumerate(all_of_them) if not np.array_equal(theirs, all_of_them[0])]:
    raise ConfigError(f"Process {differ[0]} has another configuration than process 0: give all the same command.")


@contextlib.contextmanager
def leaving_at_once() -> Iterator[None]:
  """Ends this process where an error ends the block, if there are others.

  They wait in an exchange that this one will not come to, and a normal exit waits for them; so do they end.
  """
  try:
    yield
  except BaseException as error:
    waiting = any(thread.name == PREFLIGHT for thread in threading.enumerate())  # the command leaves at once by itself
    if waiting or not (jax.distributed.is_initialized() and several()):  # asking JAX while it connects aborts
      raise
    ours = isinstance(error, PlaygroundError)
    print(f"error: {error}" if ours else traceback.format_exc(), file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(2 if ours else 1)


def _within(call: Callable[[], Any], seconds: float, otherwise: str) -> Any:
  """Result of a call that may hang; raises HardwareError if it does, or fails."""
  outcome: list[Any] = []

  def run() -> None:
    try:
      outcome.append((True, call()))
    except Exception as error:  # whatever the runtime throws
      outcome.append((False, error))

  thread = threading.Thread(target=run, name=PREFLIGHT, daemon=True)
  thread.start()
  thread.join(seconds)
  if not outcome:
    raise HardwareError(f"hardware=multi_node: {otherwise}.")
  good, result = outcome[0]
  if good:
    return result
  said = str(result).strip().splitlines()[0][:200] if str(result).strip() else type(result).__name__
  late = "DEADLINE" in said.upper() or "timed out" in said.lower()
  raise HardwareError(f"hardware=multi_node: {otherwise if late else said}.") from result


def _check(coordinator: str, num_processes: int, process_id: int) -> None:
  host, _, port = str(coordinator).rpartition(":")
  if not host or not port.isdigit():
    raise ConfigError(f"hardware.distributed.coordinator={coordinator} must be <host>:<port>.")
  if not 0 <= process_id < num_processes:
    raise ConfigError(
      f"hardware.distributed.process_id={process_id} must be from 0 to {num_processes - 1} (num_processes - 1)."
    )


def _reach(address: str, timeout: float) -> None:
  """Waits until process 0 listens."""
  host, _, port = address.rpartition(":")
  until, why = time.monotonic() + timeout, ""
  while time.monotonic() < until:
    try:
      socket.create_connection((host, int(port)), timeout=min(5.0, timeout)).close()
      return
    except OSError as error:
      why = error.strerror or str(error)
      time.sleep(0.2)
  raise HardwareError(
    f"hardware.distributed.coordinator={address} could not be reached from {socket.gethostname()} within "
    f"{timeout:g} s ({why}): is process 0 running there, and the port open?"
  )


def _known_cluster() -> bool:
  from jax._src import clusters  # JAX has no public name for it

  return any(env.is_env_present() for env in clusters.ClusterEnv._cluster_types if not env.opt_in_only_method)


def _local_device_ids() -> list[int] | None:
  """With one Slurm task on each node that task has all of its GPUs; JAX would give it the first one only."""
  nodes, tasks = os.environ.get("SLURM_STEP_NUM_NODES"), os.environ.get("SLURM_NTASKS")
  if nodes is None or nodes != tasks:
    return None
  from playground.hardware.gpus import visible_gpus

  return list(range(len(visible_gpus()))) or None
