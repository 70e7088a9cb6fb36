"""Measures the sizes that Warp's buffers need for a task and a policy."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from playground.errors import ConfigError
from playground.physics.backend import BufferUse

ROOM = 1.25  # factor of the advised sizes on the measured ones
_TRIES = 12
_REPORTS = 50  # of the progress of a rollout, which takes minutes on a CPU
_CCD = 1 << 4  # mujoco_warp's OverflowType.CCD

Act = Callable[[Any, jax.Array], jax.Array]  # (observation [N, ...], key) -> actions [N, action_size]
Batch = Any  # a task that `playground.envs.wrappers.wrap_for_training` wraps; its state is an `envs.base.State`
State = Any


@dataclasses.dataclass(frozen=True)
class BufferSizes:
  """The use of Warp's buffers by a task.

  Attributes:
    constraints: constraint rows of one environment.
    contacts: contacts or candidate pairs of each environment, the mean of all.
    convex: of those the ones that convex collision routines compute: the least of 1, 2, 4, ... that was enough, as
      Warp does not say how many they were.
  """

  constraints: int
  contacts: float
  convex: int

  def advised(self) -> dict[str, int]:
    """`njmax`, `naconmax_per_env` and `naccdmax_per_env`, with some room."""
    pairs = math.ceil(self.contacts * ROOM)
    convex = min(math.ceil(self.convex * ROOM), pairs)  # Warp takes no more of them
    return {"njmax": _rows(self.constraints), "naconmax_per_env": pairs, "naccdmax_per_env": convex}


def measure_buffers(
  build: Callable[[dict[str, int | str]], Batch],
  njmax: int | None,
  act: Act | None,
  num_envs: int,
  num_steps: int,
  on_try: Callable[[str], None] = lambda sizes: None,
  on_steps: Callable[[int], None] = lambda steps: None,
) -> BufferSizes:
  """Rolls a task out on Warp and returns the most that any step needed.

  Args:
    build: builds and wraps the task, with these values in its configuration.
    njmax: its own size of that buffer, where the search for a sufficient one begins.
    act: the policy; uniformly random actions if None.
    num_envs: environments.
    num_steps: policy steps; episodes that end are reset.
    on_try: is called with the sizes of the buffers before each rollout compiles.
    on_steps: is called with the number of policy steps that the rollout has done.

  Raises:
    ConfigError: Warp is not installed, or a buffer of fixed size overflowed.
  """
  rows, pairs, convex = max(njmax or 0, 32), 32, 1
  for _ in range(_TRIES):
    sizes: dict[str, int | str] = {"njmax": rows, "naconmax_per_env": pairs, "naccdmax_per_env": convex}
    env = build({"impl": "warp", **sizes})
    on_try(" ".join(f"{key}={size}" for key, size in sizes.items()))
    use = _roll(env, act, num_envs, num_steps, on_steps)
    if not use.overflow:
      return BufferSizes(int(use.constraints), int(use.contacts) / num_envs, convex)
    rows = _rows(int(use.constraints)) if use.constraints > rows else rows
    pairs *= 2 if use.contacts > pairs * num_envs else 1
    convex *= 2 if use.overflow & _CCD and convex < pairs else 1
    if sizes == sizes | {"njmax": rows, "naconmax_per_env": pairs, "naccdmax_per_env": convex}:
      break
  from mujoco.mjx.third_party.mujoco_warp import OverflowType

  full = OverflowType(int(use.overflow)).name  # pyright: ignore[reportPossiblyUnboundVariable]
  raise ConfigError(
    f"env.impl=warp: buffers ({full}) still overflow with njmax={rows}, naconmax_per_env={pairs} and "
    f"naccdmax_per_env={convex}."
  )


def _roll(env: Batch, act: Act | None, num_envs: int, num_steps: int, on_steps: Callable[[int], None]) -> BufferUse:
  reset_key, act_key = jax.random.split(jax.random.PRNGKey(0))
  uniform = lambda obs, key: jax.random.uniform(key, (num_envs, env.action_size), minval=-1.0, maxval=1.0)
  keys = jax.random.split(act_key, num_steps)

  @jax.jit
  def start() -> tuple[State, BufferUse]:
    state = env.reset(jax.random.split(reset_key, num_envs), {})
    return state, jax.tree.map(jnp.zeros_like, state.data.buffers)

  @jax.jit
  def advance(carry: tuple[State, BufferUse], first: int, end: int) -> tuple[State, BufferUse]:
    def step(index: jax.Array, carry: tuple[State, BufferUse]) -> tuple[State, BufferUse]:
      state, most = carry
      state = env.step(state, (act or uniform)(state.obs, keys[index]), {})
      assert state.data.buffers is not None, "the task is on Warp"
      return state, most.join(state.data.buffers)

    return jax.lax.fori_loop(first, end, step, carry)

  carry = start()
  stride = max(1, num_steps // _REPORTS)
  for first in range(0, num_steps, stride):
    end = min(first + stride, num_steps)
    carry = jax.block_until_ready(advance(carry, first, end))
    on_steps(end)
  most = carry[1]
  return jax.device_get(BufferUse(most.constraints.max(), most.contacts.max(), jax.lax.reduce_or(most.overflow, (0,))))


def _rows(constraints: int) -> int:
  """Returns a number of constraint rows with some room, a multiple of 4."""
  return 4 * math.ceil(constraints * ROOM / 4)
