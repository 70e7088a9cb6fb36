"""What the functions of reward, observation and termination terms read: one environment after one control step."""

import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax

from playground.envs.physics import PhysicsData
from playground.errors import ConfigError

if TYPE_CHECKING:
  from playground.envs.task import Task


class StepContext:
  """One environment after one control step, before the bookkeeping for the next. Arrays have no batch axis.

  Attributes:
    env: the task: its model, control step `dt` and `robot`, whose facts do not change.
    data: the physics after the step.
    info: what the task carries, as it stood during the step.
    action: the action just applied, shape [action_size].
    dt: time since the step before, s; 0 at the start of an episode.
  """

  def __init__(
    self, env: "Task", data: PhysicsData, info: Mapping[str, Any], action: jax.Array, dt: float | None = None
  ):
    self.env = env
    self.data = data
    self.info = info
    self.action = action
    self.dt = env.dt if dt is None else dt

  @property
  def robot(self) -> Any:
    """The robot's constant facts."""
    return self.env.robot

  @functools.cached_property
  def terminated(self) -> jax.Array:
    """Whether any termination term ends the episode in this step, bool."""
    return self.env.terminations.any(self)

  @property
  def last_action(self) -> jax.Array:
    """The action of the step before, shape [action_size]; 0 at the start of an episode."""
    return self.info["last_act"]

  @property
  def action_before_last(self) -> jax.Array:
    """The action two steps before, shape [action_size]."""
    return self.info["last_last_act"]

  @property
  def joint_pos(self) -> jax.Array:
    """Positions of the robot's joints, rad, shape [joints]."""
    return self.data.qpos[self.robot.qpos]

  @property
  def joint_vel(self) -> jax.Array:
    """Velocities of the robot's joints, rad/s, shape [joints]."""
    return self.data.qvel[self.robot.qvel]

  @property
  def joint_pos_rel(self) -> jax.Array:
    """Positions of the robot's joints relative to the default pose, rad, shape [joints]."""
    return self.joint_pos - self.robot.default_pose

  @property
  def command(self) -> jax.Array:
    """The command, shape [3]: forward m/s, left m/s, turn rad/s."""
    return self.carried("command")

  def carried(self, name: str) -> jax.Array:
    """Returns an entry of `info`.

    Raises:
      ConfigError: the task does not have that entry.
    """
    if name not in self.info:
      raise ConfigError(
        f"A term of env.rewards or env.observations reads info[{name!r}], which this task does not have: it needs a "
        "command or an event that writes it."
      )
    return self.info[name]

  def sensor(self, name: str) -> jax.Array:
    """Returns the reading of a sensor, by its name in the robot's YAML or in the model."""
    return self.robot.sensor(self.data, name)
