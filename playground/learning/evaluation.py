"""Evaluates policies: runs one whole episode in each environment of a batch."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as P
from jax.stages import Wrapped

from playground.envs.base import Env, Observation, State, newest_image
from playground.envs.wrappers import ModelFields, wrap_for_evaluation
from playground.hardware.mesh import AXIS, jit_on_mesh
from playground.learning.algorithm import Policy
from playground.pytree import PyTree
from playground.settings import below

Act = Callable[[Policy, Observation, jax.Array], jax.Array]  # (policy, obs [N, ...], key) -> actions [N, action_size]
Recording = dict[str, jax.Array]
Evaluate = Callable[..., tuple[dict[str, jax.Array], Recording]]


def make_evaluator(
  env: Env,
  act: Act,
  num_envs: int,
  mesh: Mesh,
  num_recorded: int = 0,
  others: Mapping[str, Act] = MappingProxyType({}),
) -> Wrapped:
  """Builds a jitted evaluation of a policy over `num_envs` episodes, spread over the mesh.

  Args:
    env: the task.
    act: acts with the policy.
    num_envs: episodes, a multiple of the number of devices.
    mesh: devices, an axis named "data"; where it is one for several agents, all have an axis of agents in front.
    num_recorded: episodes on each device to record for a video.
    others: other act functions for the same parameters, by name. Each gets `num_envs` episodes of its own, which start
      from the same states on the same models and run in parallel with those of `act`.

  Returns:
    A function (policy, key, model fields [num_envs, ...], settings) -> (scalars, recording). The settings are those of
    `Trainer.settings`, {} for those that `env` was built with. The scalars: `episode_reward` and
    `episode_length` with their standard deviation over episodes (`_std`), the mean over episodes of every metric
    (`episode_<metric>`, see `wrappers.Episode`), and `nonfinite`, the number of episodes
    that ended in NaN. Those of `others` are `<name>/<scalar>`, without reward terms.
    The recording: `qpos`, `mocap_pos`, `mocap_quat`, `seen` (the newest image, if there are any) and `active`
    (1 until the episode ended) before each policy step, [steps, episodes, ...].
  """
  wrapped = wrap_for_evaluation(env)
  num_steps = -(-env.episode_length // env.action_repeat)
  per_device = num_envs // mesh.shape[AXIS]
  acts = (act, *others.values())
  repeat = lambda tree: jax.tree.map(lambda x: jnp.concatenate([x] * len(acts)) if others else x, tree)

  def act_all(policy: Policy, obs: Observation, key: jax.Array) -> jax.Array:
    """Applies each act function to its own environments, which are concatenated."""
    share = lambda i: jax.tree.map(lambda x: x[i * per_device : (i + 1) * per_device], obs)
    return jnp.concatenate([each(policy, share(i), key) for i, each in enumerate(acts)])

  def evaluate(
    policy: Policy, key: jax.Array, model: ModelFields, settings: Mapping[str, jax.Array]
  ) -> tuple[dict[str, jax.Array], Recording]:
    episodes = wrapped.with_settings(below("env", settings))
    key = jax.random.fold_in(key, jax.lax.axis_index(AXIS))
    reset_key, act_key = jax.random.split(key)
    model = repeat(model)
    state = episodes.reset(repeat(jax.random.split(reset_key, per_device)), model)
    # Constants get the device-varying type, as in training, so that the task is traced once for both.
    always = jax.lax.axis_index(AXIS) >= 0
    state = jax.tree.map(lambda x: jax.lax.select(jax.lax.broadcast(always, x.shape), x, x), state)
    zeros = jnp.zeros_like(state.done)
    totals = {name: zeros for name in ("nonfinite", *state.info["episode_metrics"])}

    def view(state: State, active: jax.Array) -> dict[str, jax.Array]:
      shown = {name: getattr(state.data, name) for name in ("qpos", "mocap_pos", "mocap_quat")}
      image = newest_image(env, state.obs)
      shown |= {} if image is None else {"seen": image}
      return jax.tree.map(lambda x: x[:num_recorded], shown | {"active": active})

    active = jnp.ones_like(state.done)
    recording = jax.tree.map(lambda x: jnp.zeros((num_steps, *x.shape), x.dtype), view(state, active))

    def running(carry: tuple[PyTree, ...]) -> jax.Array:
      step, _, active, _, _ = carry
      # Devices must leave the loop together: a policy may use collectives.
      return (step < num_steps) & (jax.lax.pmax(active.max(), AXIS) > 0)

    def step(carry: tuple[PyTree, ...]) -> tuple[PyTree, ...]:
      step, state, active, totals, recording = carry
      recording = jax.tree.map(lambda frames, x: frames.at[step].set(x), recording, view(state, active))
      state = episodes.step(state, act_all(policy, state.obs, jax.random.fold_in(act_key, step)), model)
      now = state.info["episode_metrics"] | {"nonfinite": totals["nonfinite"] + state.info["nonfinite"]}
      totals = {k: jnp.where(active > 0, now[k], total) for k, total in totals.items()}
      return step + 1, state, active * (1 - state.done), totals, recording

    totals, recording = jax.lax.while_loop(running, step, (0, state, active, totals, recording))[3:]
    totals["reward"] = totals.pop("sum_reward")
    by_act = {k: v.reshape(len(acts), per_device) for k, v in totals.items()}
    everywhere = {k: jax.lax.all_gather(v, AXIS, axis=1, tiled=True) for k, v in by_act.items()}
    report = _scores({k: v[0] for k, v in everywhere.items()})
    for i, name in enumerate(others, start=1):
      whole = {k: v[i] for k, v in everywhere.items() if not k.startswith("reward/")}
      report |= {f"{name}/{k}": v for k, v in _scores(whole).items()}
    return report, recording

  return jit_on_mesh(evaluate, mesh, (P(), P(), P(AXIS), P()), (P(), P(None, AXIS)))


def _scores(totals: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
  """Returns the scalars over episodes, from values of each, [episodes]."""
  report = {f"episode_{k}": v.mean() for k, v in totals.items() if k != "nonfinite"}
  for name in ("reward", "length"):
    report[f"episode_{name}_std"] = totals[name].std()
  return report | {"nonfinite": totals["nonfinite"].sum()}
