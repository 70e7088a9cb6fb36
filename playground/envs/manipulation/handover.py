"""Hand a box over from one hand to the other."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.manipulation.bimanual import Bimanual
from playground.envs.manipulation.episodes import begin_anew
from playground.envs.manipulation.tabletop import Terms, is_finite, outside
from playground.envs.physics import PhysicsData
from playground.mdp.progress import progress

_BOX = slice(16, 18)  # its x and y in qpos
_SPREAD = (0.05, 0.1)  # m, of the box, uniform in +-
_TARGET, _TARGET_SPREAD, _TARGET_MIN_X = (0.20, 0.0, 0.25), 0.15, 0.15  # m
_MEETING = (0.0, 0.0, 0.24)  # m, where the box changes hands
_PICK_X, _PASS_X = -0.1, 0.0  # m: the box's x up to which it is the left hand's, and from which the right one's
_LIFTED, _FALLEN = 0.15, 0.05  # m: heights at which the box counts as picked up, and then as dropped
_DROP_COST = 0.1
_HOLDING_RATE = 0.02  # of the potential, paid in every step once the right hand has the box
_HALF_SIZE = 0.015  # m, of the box where fingers hold it


class HandOver(Bimanual):
  """The left arm picks the box up and passes it to the right one, which brings it to the target. (Not in the paper.)

  The reward is what the terms' weighted mean gains over its best so far in the episode; a dropped box costs and ends
  the episode. The left gripper does not close below 1 cm, which helps exploration. Differences from Playground 0.2.0:
  those of `Bimanual`.

  Metrics of an evaluation: `success` is whether the box is within `success_distance` of the target, and the left hand
  on its own side, when the episode ends; `position_error_cm` how far the box is then.
  """

  def __init__(self, config: Any):
    """Builds the scene; `config`: see `configs/env/AlohaHandOver.yaml`."""
    super().__init__(config, "handover")
    self._episode_s = self.episode_length * self.dt

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    parts = {"qpos": self.mj_model.nq, "qvel": self.mj_model.nv, "finger_gaps": 4, "box_top": 3, "box_bottom": 3}
    grippers = {f"{side}_gripper{what}": n for side in ("left", "right") for what, n in (("", 3), ("_axes", 6))}
    return {"state": parts | grippers | {"box_axes": 6, "target_to_box": 3, "time": 1}}

  def _start(self, rng: jax.Array) -> tuple[jax.Array, dict[str, jax.Array], dict[str, Any]]:
    rng, *keys = jax.random.split(rng, 3)
    box = [jax.random.uniform(key, minval=-reach, maxval=reach) for key, reach in zip(keys, _SPREAD, strict=True)]
    rng, key = jax.random.split(rng)
    target = jnp.array(_TARGET) + jax.random.uniform(key, (3,), minval=-_TARGET_SPREAD, maxval=_TARGET_SPREAD)
    target = target.at[0].max(_TARGET_MIN_X)
    fields = {"qpos": self._home_qpos.at[_BOX].add(jnp.array(box)), "mocap_pos": target[None]}
    return rng, fields, {"best_potential": jnp.zeros(()), "picked": jnp.zeros((), bool)}

  def disturb(self, state: State) -> State:
    return begin_anew(state, best_potential=0.0, picked=False)

  def evaluate(self, data: PhysicsData, info: Mapping[str, Any], action: jax.Array) -> State:
    box, target = self._body(data, "box"), data.mocap_pos[0]
    left_x = self._site(data, "left/gripper")[0]
    potential, rewards = self._weighted(data)
    gain, best = progress(potential, info["best_potential"])
    reward = gain + _HOLDING_RATE * potential * beyond(-left_x, 0.0) * beyond(box[0], 0.1)
    reward = jnp.where(data.time < 1.5 * self.dt, 0.0, reward)  # what the start itself is worth is no progress

    picked = info["picked"] | (box[2] > _LIFTED)
    dropped = picked & (box[2] < _FALLEN)
    out_of_bounds = outside(box) | (box[2] < 0)
    done = out_of_bounds | dropped | ~is_finite(data)
    error = jnp.linalg.norm(box - target)
    metrics = {
      "out_of_bounds": out_of_bounds.astype(jnp.float32),
      "success": ((error < self._success_distance) & (left_x < 0)).astype(jnp.float32),
      "position_error_cm": 100 * error,
    }
    return State(
      data,
      self._observe(data),
      reward - _DROP_COST * dropped,
      done.astype(jnp.float32),
      rewards | metrics,
      {**info, "best_potential": best, "picked": picked},
    )

  def _terms(self, data: PhysicsData) -> Terms:
    box, top, bottom = self._body(data, "box"), self._site(data, "box_top"), self._site(data, "box_bottom")
    left, right = self._site(data, "left/gripper"), self._site(data, "right/gripper")
    meeting = jnp.array(_MEETING)
    picking, passed = box[0] < _PICK_X, box[0] >= _PASS_X
    left_holds = nearness(top, left) * ~passed
    right_holds = nearness(bottom, right) * ~picking + nearness(bottom, right) * passed  # twice as much once it is over
    return {
      "gripper_box": left_holds + right_holds,
      "box_handover": jnp.maximum(nearness(box, meeting), nearness(left, meeting) * passed),
      "handover_target": nearness(data.mocap_pos[0], box) * right_holds * beyond(-left[0], 0.0),
      "no_table_collision": self._no_table_collision(data),
    }

  def _observe(self, data: PhysicsData) -> jax.Array:
    parts = [data.qpos, data.qvel, data.qpos[self._fingers] - _HALF_SIZE]
    parts += [self._site(data, "box_top"), self._site(data, "box_bottom")]
    for name in ("left/gripper", "right/gripper"):
      parts += [self._site(data, name), data.site_xmat[self.mj_model.site(name).id][1:].ravel()]
    parts += [self._axes(data, "box")[1:].ravel(), self._body(data, "box") - data.mocap_pos[0]]
    return jnp.concatenate([*parts, (data.time / self._episode_s)[None]])


def nearness(a: jax.Array, b: jax.Array) -> jax.Array:
  """1 where two points meet, 0.37 at 10 cm."""
  return jnp.exp(-10 * jnp.linalg.norm(a - b))


def beyond(x: jax.Array, threshold: float) -> jax.Array:
  """1 where x is some cm above the threshold (m), 0 where below."""
  return jax.nn.sigmoid(100 * (x - threshold))
