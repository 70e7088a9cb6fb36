"""What tasks share in which the Panda's hand takes a body to a target: picking up, opening."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import quat_to_mat

from playground.envs.base import State
from playground.envs.manipulation.episodes import begin_anew, first_state
from playground.envs.manipulation.tabletop import Info, TabletopTask, Terms, is_finite, logged, outside, total
from playground.envs.physics import PhysicsData, mjx
from playground.robots.tabletop import build_tabletop, contact_addresses

_REACH = 0.012  # m from the hand's tip to the body's centre: the hand has reached it
_ARM = slice(0, 7)


def nearness(gap: jax.Array) -> jax.Array:
  """1 where a gap (m) is closed, 0.24 at 0.2 m, towards 0 far away."""
  return 1 - jnp.tanh(5 * gap)


class ArmTask(TabletopTask):
  """The hand reaches a body, then takes it to a target. Only from then on does the body's way to the target count.

  An action adds to the targets of the servos: the arm's seven joints and the fingers. The reward is the weighted sum of
  the terms that `env.reward.scales` names, all of them within [0, 1] (paper, appendix "Manipulation").

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - The first observation shows the scene (0.2.0 computes no kinematics at reset: poses and sensors are 0).
  - Whether the hand has reached the body begins anew with every episode (0.2.0 keeps it over an auto-reset: after the
    first touch in an environment's life, the body's way to the target counts from the start).

  Metrics of an evaluation: `success` is whether the body is within `success_distance` of the target when the episode
  ends, `position_error_cm` how far it is then.
  """

  derived = ("sensordata", "xpos", "xquat", "xmat", "site_xpos", "site_xmat")
  summaries: ClassVar[Mapping[str, str]] = {"success": "last", "position_error_cm": "last"}

  def __init__(self, config: Any, scene: str, *, keyframe: str, body: str, obstacle: str):
    """Builds the scene.

    Args:
      config: the task's ConfigDict, see `configs/env/_panda.yaml`.
      scene: its name in `playground.robots.tabletop`.
      keyframe: where episodes start, but for what is drawn at random.
      body: to be moved.
      obstacle: geom that the hand should not touch; the term for it is `no_<obstacle>_collision`.
    """
    super().__init__(config, build_tabletop(scene), keyframe)
    self._moved, self._gripper = self.mj_model.body(body).id, self.mj_model.site("gripper").id
    self._contacts, self._obstacle = contact_addresses(self.mj_model, obstacle), obstacle
    # What the servos move: the joints of the arm and one finger, which the other follows.
    self._servoed = self.mj_model.jnt_qposadr[self.mj_model.actuator_trnid[:, 0]]

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    hand = {"qpos": self.mj_model.nq, "qvel": self.mj_model.nv, "gripper_pos": 3, "gripper_axes": 6}
    body = {"body_axes": 6, "gripper_to_body": 3, "body_to_target": 3, "axes_error": 6}
    return {"state": hand | body | {"servo_error": len(self._servoed)}}

  def disturb(self, state: State) -> State:
    return state if self.parity else begin_anew(state, reached_box=0.0)

  def evaluate(self, data: PhysicsData, info: Info, action: jax.Array) -> State:
    info = self._reach(data, info)
    rewards = self._weigh(self._terms(data, info))
    place = data.xpos[self._moved]
    out_of_bounds = outside(place) | (place[2] < 0)
    done = out_of_bounds | ~is_finite(data)
    metrics = logged(rewards) | {"out_of_bounds": out_of_bounds.astype(jnp.float32)} | self._measures(data, info)
    return State(data, self._observe(data, info), total(rewards), done.astype(jnp.float32), metrics, info)

  def _start(self, fields: dict[str, jax.Array], info: dict[str, Any], model: mjx.Model | None) -> State:
    """The state after reset, from these fields of the simulator's state; `info` lacks what all tasks here have."""
    data, info = self._placed(fields, model), {**info, "reached_box": jnp.zeros(())}
    return first_state(self, data, self._observe(data, info), info)

  def _reach(self, data: PhysicsData, info: Info) -> dict[str, Any]:
    """`info` after taking account of whether the hand has reached the body by now."""
    near = jnp.linalg.norm(data.xpos[self._moved] - data.site_xpos[self._gripper]) < _REACH
    return {**info, "reached_box": jnp.maximum(info["reached_box"], near.astype(jnp.float32))}

  def _terms(self, data: PhysicsData, info: Info) -> Terms:
    """The reward's terms."""
    return {
      "gripper_box": nearness(jnp.linalg.norm(data.xpos[self._moved] - data.site_xpos[self._gripper])),
      "box_target": nearness(self._gap(data, info)) * info["reached_box"],
      f"no_{self._obstacle}_collision": 1 - (data.sensordata[self._contacts] > 0).any().astype(jnp.float32),
      "robot_target_qpos": 1 - jnp.tanh(jnp.linalg.norm(data.qpos[_ARM] - self._home_qpos[_ARM])),
    }

  def _distance(self, data: PhysicsData, info: Info) -> jax.Array:
    return jnp.linalg.norm(info["target_pos"] - data.xpos[self._moved])

  def _gap(self, data: PhysicsData, info: Info) -> jax.Array:
    """The body's way to the target as the reward counts it, m."""
    return self._distance(data, info)

  def _measures(self, data: PhysicsData, info: Info) -> Terms:
    """Metrics by which users judge the present state."""
    error = self._distance(data, info)
    success = error < self.config.success_distance
    return {"success": success.astype(jnp.float32), "position_error_cm": 100 * error}

  def _axes_error(self, data: PhysicsData) -> jax.Array:
    """The target's minus the body's rotation matrix, but for the last row: shape [6]."""
    return (quat_to_mat(data.mocap_quat[0]) - data.xmat[self._moved])[:2].ravel()

  def _observe(self, data: PhysicsData, info: Info) -> jax.Array:
    body, axes = data.xpos[self._moved], data.xmat[self._moved]
    gripper, gripper_axes = data.site_xpos[self._gripper], data.site_xmat[self._gripper]
    parts = [data.qpos, data.qvel, gripper, gripper_axes[1:].ravel(), axes[1:].ravel(), body - gripper]
    parts += [info["target_pos"] - body, self._axes_error(data), data.ctrl - data.qpos[self._servoed]]
    return jnp.concatenate(parts)
