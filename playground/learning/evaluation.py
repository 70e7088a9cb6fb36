"""Evaluation: whole episodes of a batch of environments, each environment's first episode counted."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P

from playground.envs.base import Env, State, newest_picture
from playground.envs.wrappers import ModelFields, wrap_for_evaluation
from playground.hardware.mesh import AXIS, jit_on_mesh

Act = Callable[[Any, Any, jax.Array], jax.Array]  # (policy, obs [N, ...], key) -> actions [N, action_size]


Evaluate = Callable[..., tuple[dict[str, jax.Array], dict[str, jax.Array]]]


def make_evaluator(env: Env, act: Act, num_envs: int, mesh: Mesh, num_recorded: int = 0) -> Evaluate:
  """Builds a jitted evaluation of a policy over `num_envs` episodes, spread over the mesh.

  Args:
    env: the task.
    act: the policy.
    num_envs: episodes, a multiple of the number of devices.
    mesh: devices, one axis named "data".
    num_recorded: episodes on each device to record for a video.

  Returns:
    A function (policy, key, model fields [num_envs, ...]) -> (scalars, recording). The scalars: `episode_reward` and
    `episode_length` with their deviation over episodes (`_std`), the mean over episodes of every metric
    (`episode_<metric>`, see `wrappers.Episode`), and `nonfinite`, the number of episodes
    that ended in NaN. The recording: `qpos`, `mocap_pos`, `mocap_quat`, `seen` (the newest picture, where there are
    any) and `active` (1 until the episode ended) before each decision, [decisions, episodes, ...].
  """
  wrapped = wrap_for_evaluation(env)
  decisions = -(-env.episode_length // env.action_repeat)
  per_device = num_envs // mesh.size

  def evaluate(policy: Any, key: jax.Array, model: ModelFields) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))
    reset_key, act_key = jax.random.split(key)
    state = wrapped.reset(jax.random.split(reset_key, per_device), model)
    # Constants become of the type that may differ between devices, as in training: the task is traced once for both.
    always = jax.lax.axis_index(AXIS) >= 0
    state = jax.tree.map(lambda x: jax.lax.select(jax.lax.broadcast(always, x.shape), x, x), state)
    zeros = jnp.zeros(per_device)
    totals = {name: zeros for name in ("nonfinite", *state.info["episode_metrics"])}

    def view(state: State, active: jax.Array) -> dict[str, jax.Array]:
      shown = {name: getattr(state.data, name) for name in ("qpos", "mocap_pos", "mocap_quat")}
      picture = newest_picture(env, state.obs)
      shown |= {} if picture is None else {"seen": picture}
      return jax.tree.map(lambda x: x[:num_recorded], shown | {"active": active})

    active = jnp.ones(per_device)
    recording = jax.tree.map(lambda x: jnp.zeros((decisions, *x.shape), x.dtype), view(state, active))

    def running(carry: tuple[Any, ...]) -> jax.Array:
      step, _, active, _, _ = carry
      # Devices must leave the loop together: a policy may communicate between them.
      return (step < decisions) & (jax.lax.pmax(active.max(), AXIS) > 0)

    def step(carry: tuple[Any, ...]) -> tuple[Any, ...]:
      step, state, active, totals, recording = carry
      recording = jax.tree.map(lambda tape, x: tape.at[step].set(x), recording, view(state, active))
      state = wrapped.step(state, act(policy, state.obs, jax.random.fold_in(act_key, step)), model)
      now = state.info["episode_metrics"] | {"nonfinite": totals["nonfinite"] + state.info["nonfinite"]}
      totals = {k: jnp.where(active > 0, now[k], total) for k, total in totals.items()}
      return step + 1, state, active * (1 - state.done), totals, recording

    totals, recording = jax.lax.while_loop(running, step, (0, state, active, totals, recording))[3:]
    totals["reward"] = totals.pop("sum_reward")
    everywhere = {k: jax.lax.all_gather(v, AXIS, tiled=True) for k, v in totals.items()}
    report = {f"episode_{k}": v.mean() for k, v in everywhere.items() if k != "nonfinite"}
    for name in ("reward", "length"):
      report[f"episode_{name}_std"] = everywhere[name].std()
    return report | {"nonfinite": everywhere["nonfinite"].sum()}, recording

  return jit_on_mesh(evaluate, mesh, (P(), P(), P(AXIS)), (P(), P(None, AXIS)))
