"""What tasks of arms at a table share: a scene with a home, servo targets that actions move, a weighted reward."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import Env, State
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.lookup import lookup

Terms = dict[str, jax.Array]
Info = Mapping[str, Any]

_BOUND = 1.0  # m on each axis


class TabletopTask(Env):
  """A task whose scene has a keyframe to start from. By default an action adds to the targets of the servos."""

  def __init__(self, config: Any, spec: mujoco.MjSpec, keyframe: str = "home"):
    """Compiles the scene.

    Args:
      config: the task's ConfigDict: that of `Env`, `action_scale`, and `reward.scales` with each term's weight, where
        0 leaves it out.
      spec: the scene.
      keyframe: where episodes start, but for what is drawn at random.
    """
    self.spec = spec
    super().__init__(config, spec.compile())
    key = self.mj_model.key(keyframe)
    self._home_qpos, self._home_ctrl = jnp.array(key.qpos), jnp.array(key.ctrl)
    self._ctrl_range = jnp.array(self.mj_model.actuator_ctrlrange.T)
    self._action_scale: float = config.action_scale
    self._scales = {name: scale for name, scale in config.reward.scales.items() if scale}

  def control(self, state: State, action: jax.Array) -> jax.Array:
    return jnp.clip(state.data.ctrl + self._action_scale * action, *self._ctrl_range)

  def _placed(self, fields: Mapping[str, jax.Array], model: mjx.Model | None) -> PhysicsData:
    """The physics at the start of an episode: these fields of the simulator's state, `ctrl` at home unless given.

    Poses and sensors are those of this state; in parity mode those of none, as 0.2.0 computes none.
    """
    data = self.physics.make(**{"ctrl": self._home_ctrl, **fields})
    return data if self.parity else self.physics.forward(self.mjx_model if model is None else model, data)

  def _weigh(self, terms: Terms) -> Terms:
    """The terms that `env.reward.scales` names, each times its weight."""
    return {name: scale * lookup(terms, name, "env.reward.scales") for name, scale in self._scales.items()}

  def _body(self, data: PhysicsData, name: str) -> jax.Array:
    """World position of a body, m [3]."""
    return data.xpos[self.mj_model.body(name).id]

  def _axes(self, data: PhysicsData, name: str) -> jax.Array:
    """Rotation matrix of a body, [3, 3]."""
    return data.xmat[self.mj_model.body(name).id]

  def _site(self, data: PhysicsData, name: str) -> jax.Array:
    """World position of a site, m [3]."""
    return data.site_xpos[self.mj_model.site(name).id]


def logged(rewards: Terms) -> Terms:
  """Weighted terms under the names that metrics of rewards have."""
  return {f"reward/{name}": value for name, value in rewards.items()}


def total(rewards: Terms) -> jax.Array:
  """Their sum, shape []."""
  return sum(rewards.values(), jnp.zeros(()))


def outside(position: jax.Array) -> jax.Array:
  """Whether something is more than 1 m off on any axis, bool."""
  return (jnp.abs(position) > _BOUND).any()


def is_finite(data: PhysicsData) -> jax.Array:
  """Whether the simulation's numbers are finite, bool."""
  return jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all()
