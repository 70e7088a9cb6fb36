"""Metrics of how a robot on legs walks, for evaluations of trained policies."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import Env, State
from playground.envs.symmetry import partners
from playground.envs.task import Task
from playground.envs.wrappers import Wrapper
from playground.mdp.legged import LeggedRobot
from playground.physics.backend import mjx

ACTION_RATE, SATURATION = "gait/action_rate", "gait/saturation"
FOOT_SLIP, DUTY_ASYMMETRY = "gait/foot_slip", "gait/duty_asymmetry"
_LIMIT = 0.95  # of an action's range of [-1, 1]
# Entries of `info`: steps in which each foot touched, in which each joint's action was beyond the limit, and all steps.
_TOUCHED, _SATURATED, _STEPS = "gait_touched", "gait_saturated", "gait_steps"


def with_gait_metrics(env: Env) -> Any:
  """Returns a task of a robot on legs with `GaitMetrics`, any other as it is."""
  legged = isinstance(env.unwrapped, Task) and isinstance(env.unwrapped.robot, LeggedRobot)
  return GaitMetrics(env) if legged else env


class GaitMetrics(Wrapper):
  """Adds metrics of an episode's gait.

  `gait/action_rate` is the mean over the episode of the change of an action from the step before, root mean square over
  joints. `gait/saturation` is the share of the episode, 0 to 1, in which a joint's action is beyond 0.95 of its range,
  of the joint where that is most often: with a high share the policy wants more torque than the range gives
  (`env.action_scale`). `gait/foot_slip` is the mean horizontal speed of the feet that touch the floor, m/s, for robots
  whose feet have velocity sensors. `gait/duty_asymmetry` is the mean difference between left and right feet in the
  share of the episode that they touch the floor, 0 to 1, for robots that have a mirror (`playground.envs.symmetry`).
  """

  jitted, observation_size = Env.jitted, Env.observation_size

  def __init__(self, env: Any):
    super().__init__(env)
    robot = env.unwrapped.robot
    self._measures_slip = bool(env.unwrapped.config.robot.get("foot_linvel"))
    self._other_side = partners(robot, robot.foot_names) if robot.left_to_right else None
    self._kinds = {ACTION_RATE: "mean", SATURATION: "last"}
    self._kinds |= {FOOT_SLIP: "mean"} if self._measures_slip else {}
    self._kinds |= {} if self._other_side is None else {DUTY_ASYMMETRY: "last"}

  @property
  def summaries(self) -> Mapping[str, str]:
    return {**self.env.summaries, **self._kinds}

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    state = self.env.reset(rng, model)
    feet = len(self.env.unwrapped.robot.foot_names)
    info = {_TOUCHED: jnp.zeros(feet), _SATURATED: jnp.zeros(self.env.action_size), _STEPS: jnp.zeros(())}
    return state.replace(metrics=state.metrics | dict.fromkeys(self._kinds, jnp.zeros(())), info=state.info | info)

  def step(self, state: State, action: jax.Array, model: mjx.Model | None = None) -> State:
    task = self.env.unwrapped
    own = {name: state.info[name] for name in (_TOUCHED, _SATURATED, _STEPS)}
    before = {name: value for name, value in state.info.items() if name not in own}
    after = self.env.step(state.replace(info=before), action, model)
    c = task.context(task, after.data, before, action)
    touches = c.contact.astype(jnp.float32)
    change = jnp.sqrt(jnp.square(action - c.last_act).mean())
    is_repeat = own[_STEPS] % task.action_repeat > 0  # of the same action, which had its change before
    saturated = own[_SATURATED] + (jnp.abs(action) > _LIMIT)
    own = {_TOUCHED: own[_TOUCHED] + touches, _SATURATED: saturated, _STEPS: own[_STEPS] + 1}
    metrics = {ACTION_RATE: jnp.where(is_repeat, state.metrics[ACTION_RATE], change)}
    metrics[SATURATION] = saturated.max() / own[_STEPS]
    if self._measures_slip:
      speed = jnp.linalg.norm(c.feet_velocity[:, :2], axis=1)
      metrics[FOOT_SLIP] = (touches * speed).sum() / jnp.maximum(touches.sum(), 1)
    if self._other_side is not None:
      duty = own[_TOUCHED] / own[_STEPS]
      metrics[DUTY_ASYMMETRY] = jnp.abs(duty - duty[self._other_side]).mean()
    return after.replace(metrics=after.metrics | metrics, info=after.info | own)
