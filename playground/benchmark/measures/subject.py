"""Holds the parts that all measurements share: a task with its trainer, clocks, and columns of this process."""

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import numpy as np
from jax.sharding import PartitionSpec as P

from playground import registry
from playground.benchmark.measures.machine import device_name, versions
from playground.benchmark.worker import Rows
from playground.config import RunConfig, compose
from playground.envs.base import Env
from playground.envs.wrappers import ModelFields
from playground.files import locking
from playground.hardware.mesh import put
from playground.hardware.setup import Hardware, setup
from playground.learning.trainer import Trainer, trainer_settings
from playground.pytree import PyTree
from playground.runs.scaling import scale_envs
from playground.runs.train import model_sampler

ONE_DEVICE = "hardware.devices=1"


@dataclasses.dataclass
class Subject:
  """A task with its trainer, as `playground-run env=<task> agent=<agent> <overrides>` builds them.

  Attributes:
    config: the run's configuration.
    hardware: devices of this process.
    env: the task.
    trainer: trainer of the task and the algorithm.
    draw: (seed) -> randomised models of training and evaluation; agent i of several uses seed + i.
  """

  config: RunConfig
  hardware: Hardware
  env: Env
  trainer: Trainer
  draw: Callable[[int], tuple[ModelFields, ModelFields]]

  @classmethod
  def build(cls, rows: Rows, task: str, agent: str, overrides: Sequence[str], num_agents: int = 1) -> "Subject":
    """Builds task and trainer, of one agent or several in one program, and fills in the columns that rows share."""
    config = compose([f"env={task}", f"agent={agent}", *overrides])
    hardware = setup(config.hardware)
    if config.hardware.scale_envs:
      config, _ = scale_envs(config, hardware.mesh.size)
    settings = config.agent
    env = registry.load(task, config=config.env)
    sample = model_sampler(env, config, settings.num_envs, settings.num_eval_envs)
    each = trainer_settings(settings, env.settings_of(env.config))
    several = [each] * num_agents if num_agents > 1 else ()
    trainer = Trainer(env, settings, hardware.mesh, hardware.network_precision, several)

    def draw(seed: int) -> tuple[ModelFields, ModelFields]:
      return trainer.join([sample(seed + i) for i in range(num_agents)])

    rows.update(
      backend=env.impl,
      devices=hardware.mesh.size,
      device=device_name(),
      precision=_precision(hardware, trainer),
      versions=versions(),
      conditions=f"hyperparameters {config.choices.get('tuned') or 'not tuned for this task'}",
    )
    return cls(config, hardware, env, trainer, draw)

  @functools.cached_property
  def model(self) -> ModelFields:
    """Returns the randomised models of the training environments."""
    return self.draw(self.config.seed)[0]

  def key(self, seed: int) -> jax.Array:
    """Returns a random key on all devices, or a key for each of several agents."""
    keys = [np.asarray(jax.random.PRNGKey(seed + i)) for i in range(max(self.trainer.num_agents, 1))]
    return put(self.trainer.join(keys), self.trainer.mesh, P())


def setting_of(overrides: Sequence[str]) -> list[str]:
  """Returns the overrides in a row's setting: all but the default of one device."""
  return [text for text in overrides if text != ONE_DEVICE]


def _precision(hardware: Hardware, trainer: Trainer) -> str:
  manifest, value_dtype = hardware.machine, getattr(trainer.networks, "value_dtype", None)
  critic = f", critic activations {value_dtype}" if value_dtype else ""
  return f"physics {manifest['matmul_precision']}, networks {manifest['network_precision']}{critic}"


@contextlib.contextmanager
def alone(lock: str | None) -> Iterator[None]:
  """Locks the device during the block: other measurements may compile, but wait with their timing."""
  with contextlib.nullcontext() if lock is None else locking(Path(lock), math.inf):
    yield


def rate(call: Callable[[int], PyTree], steps: int, seconds: float) -> tuple[float, float]:
  """Measures steps a second.

  Args:
    call: makes a number of repetitions and returns their result; already compiled.
    steps: steps of one repetition.
    seconds: duration of the measurement, at least one repetition.

  Returns:
    Steps a second over the whole time, and that time (s).
  """
  begin = time.perf_counter()
  jax.block_until_ready(call(1))
  taken = time.perf_counter() - begin
  if taken >= seconds:
    return steps / taken, taken
  each = max(1, math.ceil(min(1.0, seconds) / taken))  # calls of about a second: the host's overhead is negligible
  done, begin = 0, time.perf_counter()
  while (taken := time.perf_counter() - begin) < seconds:
    jax.block_until_ready(call(each))
    done += each
  return done * steps / taken, taken


def peak_memory_gib() -> float | None:
  """Returns the peak of JAX's allocator on any device, GiB; None if unknown (CPU)."""
  peaks = [(device.memory_stats() or {}).get("peak_bytes_in_use") for device in jax.local_devices()]
  known = [peak for peak in peaks if peak is not None]
  return max(known) / 2**30 if known else None


def emit_peak(rows: Rows, **columns: object) -> None:
  """Emits a row for the peak memory, if known."""
  peak = peak_memory_gib()
  if peak is not None:
    rows.emit("peak_memory_gib", peak, "GiB", **columns)
