"""What the DM Control Suite's tasks share: the model beside the module, motors driven directly, endless episodes."""

import abc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.base import Env, State
from playground.envs.physics import PhysicsData, mjx
from playground.errors import ConfigError
from playground.mdp.tolerance import tolerance

Terms = dict[str, jax.Array]


def load_spec(domain: str) -> mujoco.MjSpec:
  """The domain's MJCF, for a task to edit and compile."""
  return mujoco.MjSpec.from_file(str(Path(__file__).with_name(f"{domain}.xml")))


def move_speed(config: Any) -> float:
  """`env.move_speed` in m/s, of tasks where 0 means to stand.

  Raises:
    ConfigError: it is negative.
  """
  if config.move_speed < 0:
    raise ConfigError(f"env.move_speed={config.move_speed} must be at least 0 m/s (0: stand).")
  return config.move_speed


def small_control(action: jax.Array) -> jax.Array:
  """1 for no action, 0.8 where all are at (or beyond) full scale."""
  return (4 + tolerance(action, margin=1, sigmoid="quadratic", value_at_margin=0).mean()) / 5


class SuiteTask(Env):
  """A task of the suite (paper, Appendix A): the action is `ctrl`, and only numbers that are not finite end it early.

  A domain says how an episode starts, what is observed and what is rewarded.
  """

  @abc.abstractmethod
  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    """State fields at the start of an episode, by name ("qpos", "qvel", "mocap_pos"), from one random key."""

  @abc.abstractmethod
  def observe(self, data: PhysicsData) -> jax.Array:
    """The observation, one vector."""

  @abc.abstractmethod
  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    """The reward in [0, 1] and the terms it is made of, which are logged as `reward/<name>`."""

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    fields = self.initial(rng)
    # 0.2.0 moves a target only after the forward pass: its first observation shows the model's default target.
    late = {"mocap_pos": fields.pop("mocap_pos")} if self.parity and "mocap_pos" in fields else {}
    data = self.physics.forward(self.mjx_model if model is None else model, self.physics.make(**fields))
    state = self.evaluate(self.settle(data, model).replace(**late), {}, jnp.zeros(self.action_size))
    zero = jnp.zeros(())
    return state.replace(reward=zero, done=zero, metrics={name: zero for name in state.metrics})

  def sensor(self, data: PhysicsData, name: str) -> jax.Array:
    """The reading of the model's sensor `name`, shape [dim]."""
    sensor = self.mj_model.sensor(name)
    return data.sensordata[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]]

  def planar_pose(self, angle_key: jax.Array, joints_key: jax.Array) -> jax.Array:
    """`qpos` of a planar model (two slides, a hinge, then joints) at the origin, turned and bent at random."""
    low, high = self.mj_model.jnt_range[3:].T
    angle = jax.random.uniform(angle_key, (1,), minval=-jnp.pi, maxval=jnp.pi)
    joints = jax.random.uniform(joints_key, low.shape, minval=low, maxval=high)
    return jnp.concatenate([jnp.zeros(2), angle, joints])

  def settle(self, data: PhysicsData, model: mjx.Model | None) -> PhysicsData:
    """Lets the initial state come to rest, where a task needs that."""
    return data

  def control(self, state: State, action: jax.Array) -> jax.Array:
    return action

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    reward, terms = self.reward(data, action)
    done = ~(jnp.isfinite(data.qpos).all() & jnp.isfinite(data.qvel).all())
    metrics = {f"reward/{name}": value for name, value in terms.items()}
    return State(data, self.observe(data), reward, done.astype(jnp.float32), metrics, dict(info))
