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

Terms = dict[str, jax.Array]


def load_spec(domain: str) -> mujoco.MjSpec:
  """The domain's MJCF, for a task to edit and compile."""
  return mujoco.MjSpec.from_file(str(Path(__file__).with_name(f"{domain}.xml")))


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
