"""Distributed training: its processes connect, compare their configurations, and end together.

Every machine runs the same command; process 0 writes the run directory, the others only compute.

If a process is lost, all others must end: they wait for it in a collective. JAX aborts them with a stack trace, or lets
them wait, so our own watch acts first (`_Watch`).
"""

import atexit
import contextlib
import hashlib
import itertools
import json
import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any, NoReturn, TypeVar

import jax
import numpy as np

from playground.errors import ConfigError, HardwareError, PlaygroundError
from playground.hardware.options import DistributedConfig, HardwareConfig
from playground.text import first_line

T = TypeVar("T")

PREFLIGHT = "preflight"  # name of threads that nobody waits for any more: a process that has one ends at once
_STORE = "playground"  # our folder in the coordinator's key-value store
_WEEK_MS = 7 * 24 * 3600 * 1000  # longer than processes wait for each other; JAX wants a limit
_PERIOD_S = 1.0  # s between two heartbeats
_WATCH = f"{_STORE}/watch"
_FAILED = f"{_WATCH}/failed"  # why a process ends
_LEFT = "left"  # the last heartbeat of a process that ends normally
_numbers = itertools.count()  # of the barriers and shared texts: the same in all processes


def is_main() -> bool:
  """Whether this is process 0, which writes the run."""
  return jax.process_index() == 0


def is_multiprocess() -> bool:
  """Whether a training spans more than one process."""
  return jax.process_count() > 1


def any_process(flag: bool) -> bool:
  """Returns whether the flag is true in any process; all processes call it, in the same order."""
  if not is_multiprocess():
    return flag
  from jax.experimental import multihost_utils

  wait_for_all()  # Gloo waits for half a minute only, and process 0 may still be writing
  return bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def wait_for_all() -> None:
  """Blocks until every process has called it, without a time limit."""
  if _watch is not None:
    barrier, client = f"{_STORE}/{next(_numbers)}", _watch.client
    _within(lambda: client.wait_at_barrier(barrier, _WEEK_MS), None, "the other processes did not come")


def share(text: str = "") -> str:
  """Returns process 0's text in all processes; all must call it, in the same order."""
  if _watch is None:
    return text
  key, client = f"{_STORE}/shared/{next(_numbers)}", _watch.client
  if is_main():
    client.key_value_set(key, text)
    return text
  return _within(lambda: client.blocking_key_value_get(key, _WEEK_MS), None, "process 0 did not answer")


def init_distributed(config: HardwareConfig) -> None:
  """Joins the other processes of the training, if `hardware.distributed` is enabled.

  Their addresses come from Slurm (or another launcher that JAX knows), or from the keys coordinator,
  num_processes and process_id. Call it before JAX touches a device; only the first call has an effect.

  Raises:
    ConfigError: keys are missing.
    HardwareError: the other processes do not connect, or are not reachable.
  """
  keys = ("coordinator", "num_processes", "process_id")
  settings = config.distributed
  given = {key: getattr(settings, key) for key in keys}
  if not settings.enable:
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
  if explicit:
    _check(**given)
  timeout = settings.timeout
  coordinator, count, index, local_device_ids = _topology(settings, round(timeout))
  if index > 0:
    _reach(coordinator, timeout)
  # Its handler of SIGTERM would replace ours, which saves.
  jax.config.update("jax_enable_preemption_service", False)
  # CPUs only: two concurrent programs could run their collectives in a different order in each process.
  jax.config.update("jax_cpu_collectives_implementation", "gloo")
  jax.config.update("jax_cpu_enable_async_dispatch", False)
  watch = _Watch(index, count, coordinator, settings.lost_after)
  _within(
    lambda: jax.distributed.initialize(
      coordinator if index == 0 else watch.relay(),
      count,
      index,
      local_device_ids,
      initialization_timeout=round(timeout) + 60,
      heartbeat_timeout_seconds=10 * round(watch.lost_after) + 60,
    ),
    timeout,  # JAX's own timeouts are later: it aborts the process
    f"not all of {count} processes at {coordinator} came within hardware.distributed.timeout={timeout:g} s",
  )
  if count > 1:
    watch.start()


def preflight(config: HardwareConfig, fingerprint: object, what: str = "configuration") -> None:
  """Checks in a collective that all processes train the same.

  Args:
    config: `hardware`.
    fingerprint: a value that must be equal in all processes, such as the resolved configuration.
    what: name of the value.

  Raises:
    HardwareError: the collective takes longer than `hardware.distributed.timeout`.
    ConfigError: the values differ.
  """
  if not is_multiprocess():
    return
  from jax.experimental import multihost_utils

  wait_for_all()
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
    raise ConfigError(f"Process {differ[0]} has another {what} than process 0: give all the same command and files.")


@contextlib.contextmanager
def ending_together() -> Iterator[None]:
  """Ends this process only when all processes of the training have ended the block, or at once if an error ends it.

  The others wait in a collective that this process will not join, and a normal exit would wait for them.
  """
  try:
    yield
    wait_for_all()
  except BaseException as error:
    ours = isinstance(error, PlaygroundError)
    if _watch is not None:
      print(f"error: {error}" if ours else traceback.format_exc(), file=sys.stderr, flush=True)
    leave(2 if ours else 1, f"failed: {error if ours else traceback.format_exception_only(error)[-1].strip()}")
    raise


def leave(code: int, why: str) -> None:
  """Ends this process at once, and the others with the sentence `why`; does nothing without others."""
  if _watch is not None:
    _watch.tell(f"process {jax.process_index()} on {socket.gethostname()} {why}")
    sys.stdout.flush()
    os._exit(code)


@contextlib.contextmanager
def noting_loss(note: Callable[[str], None]) -> Iterator[None]:
  """While the block runs, calls `note` with a sentence before this process ends because another one is lost."""
  if _watch is None:
    yield
    return
  _watch.notes.append(note)
  try:
    yield
  except Exception as error:
    if not any(word in str(error) for word in ("Gloo", "NCCL")):
      raise
    time.sleep(_watch.lost_after + 5)  # until the watch knows the reason and ends this process
    raise HardwareError(f"hardware=multi_node: an exchange failed, {first_line(error)}.") from error
  finally:
    _watch.notes.remove(note)


class _Watch:
  """Ends this process in one sentence when another one of the training fails or is lost.

  A process that fails writes so to the coordinator's key-value store. A process that is killed, or whose machine is
  lost, stops its heartbeat there. Process 0 is the coordinator: JAX's client aborts when its connection to it closes,
  so that connection goes through our relay, which notices first.

  Attributes:
    lost_after: seconds without a heartbeat after which a process is lost.
    notes: called with the sentence before this process ends.
    client: the coordinator's, once JAX has connected.
  """

  def __init__(self, index: int, count: int, coordinator: str, lost_after: float):
    self.lost_after = lost_after
    self.notes: list[Callable[[str], None]] = []
    self.client: Any = None  # JAX has no public type for it
    self._index, self._count, self._coordinator = index, count, coordinator
    self._leaving = threading.Event()
    self._lock = threading.Lock()

  def start(self) -> None:
    """Starts the watch, which lasts until the interpreter ends."""
    global _watch
    from jax._src import distributed  # JAX has no public name for the store

    _watch, self.client = self, distributed.global_state.client
    atexit.register(self._part)  # runs before JAX's own, which was registered earlier
    self._thread = _start_thread(self._run)

  def relay(self) -> str:
    """Returns a local address that forwards to the coordinator; the coordinator's loss ends this process."""
    listener = socket.create_server(("127.0.0.1", 0))
    host, _, port = self._coordinator.rpartition(":")

    def accept() -> None:
      while True:
        near, _ = listener.accept()
        try:
          far = socket.create_connection((host, int(port)))
        except OSError:
          self._lost_coordinator()
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux: a lost machine closes no connection
          far.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * self.lost_after))
        _start_thread(lambda near=near, far=far: self._connect(near, far))

    _start_thread(accept)
    return f"127.0.0.1:{listener.getsockname()[1]}"

  def tell(self, sentence: str) -> None:
    """Ends the other processes with a sentence; this process ends by itself."""
    self._leaving.set()
    with contextlib.suppress(Exception):  # another one was first, or the store is lost with process 0
      self.client.key_value_set(_FAILED, sentence)
    if self._index == 0:
      time.sleep(2 * _PERIOD_S)  # the store ends with this process: the others must read it first

  def _part(self) -> None:
    self._leaving.set()
    self._thread.join()  # a thread that returns from JAX while Python ends aborts the process
    with contextlib.suppress(Exception):  # process 0 may have gone
      self.client.key_value_set(_sign_of(self._index), _LEFT, allow_overwrite=True)

  def _run(self) -> None:
    signs = dict.fromkeys(range(self._count), "")
    seen = dict.fromkeys(signs, time.monotonic())
    for beat in itertools.count():
      try:
        store = _within(lambda beat=beat: self._exchange(str(beat)), self.lost_after, "")
      except HardwareError:  # process 0 does not answer: its heartbeat is missing, too
        store = {}
      if _FAILED in store:
        self._lost(store[_FAILED])
      for i, before in signs.items():
        signs[i] = store.get(_sign_of(i), before)
        if signs[i] != before:
          seen[i] = time.monotonic()
        if signs[i] != _LEFT and time.monotonic() - seen[i] > self.lost_after:
          self._lost(f"process {i} has given no sign of life for hardware.distributed.lost_after={self.lost_after:g} s")
      if self._leaving.wait(_PERIOD_S):
        return

  def _exchange(self, sign: str) -> dict[str, str]:
    """Writes a heartbeat, and returns the entries of all processes."""
    self.client.key_value_set(_sign_of(self._index), sign, allow_overwrite=True)
    return dict(self.client.key_value_dir_get(_WATCH))

  def _connect(self, near: socket.socket, far: socket.socket) -> None:
    """Forwards data between JAX's client and the coordinator."""
    closed = threading.Event()

    def send() -> None:
      while data := _receive(near):
        try:
          far.sendall(data)
        except OSError:
          self._lost_coordinator()
      closed.set()
      with contextlib.suppress(OSError):  # it may be closed
        far.shutdown(socket.SHUT_WR)

    _start_thread(send)
    while data := _receive(far):
      try:
        near.sendall(data)
      except OSError:  # closed by JAX's client
        return
    if not closed.is_set():
      self._lost_coordinator()

  def _lost_coordinator(self) -> NoReturn:
    if ending := self._leaving.is_set():
      time.sleep(self.lost_after)  # a normal end closes the connection, too; without process 0, JAX would wait for it
    self._lost(f"process 0 at {self._coordinator} is lost", ending)

  def _lost(self, sentence: str, ending: bool = False) -> NoReturn:
    """Ends this process; one that ends by itself only with `ending`."""
    with self._lock:  # kept: one thread ends the process
      if self._leaving.is_set() and not ending:
        raise SystemExit  # of this thread
      sentence = f"hardware=multi_node: {sentence.removesuffix('.')}."
      try:
        for note in self.notes:
          note(sentence)
      finally:
        print(f"error: {sentence}", file=sys.stderr, flush=True)
        sys.stdout.flush()
        os._exit(2)


def _sign_of(index: int) -> str:
  return f"{_WATCH}/life/{index}"


_watch: _Watch | None = None  # this process's, once it has joined others


def _within(call: Callable[[], T], seconds: float | None, otherwise: str) -> T:
  """Returns the result of a call that a signal can interrupt; raises HardwareError if it hangs or fails."""
  outcome: Future[T] = Future()

  def run() -> None:
    try:
      outcome.set_result(call())
    except Exception as error:  # any error of the runtime
      outcome.set_exception(error)

  thread = _start_thread(run)
  try:
    thread.join(seconds)
  finally:  # a signal may have interrupted it
    if not outcome.done():
      thread.name = PREFLIGHT
  if not outcome.done():
    raise HardwareError(f"hardware=multi_node: {otherwise}.")
  try:
    return outcome.result()
  except Exception as error:
    text = first_line(error)[:200]
    late = "DEADLINE" in text.upper() or "timed out" in text.lower()
    raise HardwareError(f"hardware=multi_node: {otherwise if late else text}.") from error


def _start_thread(target: Callable[[], None]) -> threading.Thread:
  thread = threading.Thread(target=target, name="watch", daemon=True)
  thread.start()
  return thread


def _receive(end: socket.socket) -> bytes:
  """Returns the next bytes; none when the connection is closed or broken."""
  try:
    return end.recv(1 << 16)
  except OSError:
    return b""


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


def _topology(settings: DistributedConfig, timeout: int) -> tuple[str, int, int, list[int] | None]:
  """Returns the coordinator's address, number of processes, index of this one, and its devices if not all."""
  from jax._src import clusters  # as above

  given = settings.coordinator, settings.num_processes, settings.process_id
  detect = clusters.ClusterEnv.auto_detect_unset_distributed_params
  return detect(*given, _local_device_ids(), None, timeout)  # pyright: ignore[reportReturnType]


def _local_device_ids() -> list[int] | None:
  """Returns all GPUs of a node with one Slurm task; JAX would use the first one only."""
  nodes, tasks = os.environ.get("SLURM_STEP_NUM_NODES"), os.environ.get("SLURM_NTASKS")
  if nodes is None or nodes != tasks:
    return None
  from playground.hardware.gpus import visible_gpus

  return list(range(len(visible_gpus()))) or None
