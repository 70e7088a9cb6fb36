"""A Panda that picks up a cube and takes it to a target in the air."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from mujoco.mjx._src.math import axis_angle_to_quat, normalize

from playground.envs.base import State
from playground.envs.manipulation.arm import ArmTask
from playground.envs.manipulation.tabletop import Info, Terms
from playground.envs.physics import PhysicsData, mjx
from playground.mdp.rotations import angle_between

_BOX = slice(9, 12)  # its position in qpos


class Pick(ArmTask):
  """What tasks share that pick up the cube: how far it is from its target, turns included.

  Metrics beside those of `ArmTask`: `rotation_error_deg`, how far the cube is from the target's turn when the episode
  ends, which success takes to be less than `success_angle` where that is given.
  """

  summaries: ClassVar[Mapping[str, str]] = {**ArmTask.summaries, "rotation_error_deg": "last"}

  def _gap(self, data: PhysicsData, info: Info) -> jax.Array:
    return 0.9 * super()._gap(data, info) + 0.1 * jnp.linalg.norm(self._axes_error(data))

  def _measures(self, data: PhysicsData, info: Info) -> Terms:
    angle = angle_between(data.xquat[self._moved], data.mocap_quat[0])
    measures = super()._measures(data, info)
    if self.config.success_angle is not None:
      measures["success"] *= angle < self.config.success_angle
    return measures | {"rotation_error_deg": jnp.rad2deg(angle)}


class PickCube(Pick):
  """Brings a cube from the floor to a target in the air, turned as the target (paper, appendix "Manipulation").

  Both places are drawn anew in every reset, the target's turn up to `env.reset.target_angle` (0 for PandaPickCube).
  Differences from Playground 0.2.0: those of `ArmTask`.
  """

  def __init__(self, config: Any):
    """Builds the scene. `config`: see `configs/env/PandaPickCube.yaml`."""
    super().__init__(config, "panda_single_cube", keyframe="home", body="box", obstacle="floor")

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    start = self.config.reset
    rng, box_key, target_key = jax.random.split(rng, 3)
    home = self._home_qpos[_BOX]
    reach = jnp.array([start.box_xy, start.box_xy, 0.0])
    box = home + jax.random.uniform(box_key, (3,), minval=-reach, maxval=reach)
    low, high = start.target_height
    corners = [jnp.array([side * start.target_xy, side * start.target_xy, z]) for side, z in ((-1, low), (1, high))]
    target = home + jax.random.uniform(target_key, (3,), minval=corners[0], maxval=corners[1])
    quat = jnp.array([1.0, 0.0, 0.0, 0.0])
    if start.target_angle > 0:
      rng, axis_key, angle_key = jax.random.split(rng, 3)
      axis = normalize(jax.random.uniform(axis_key, (3,), minval=-1.0, maxval=1.0))
      quat = axis_angle_to_quat(axis, jax.random.uniform(angle_key, maxval=start.target_angle))
    fields = {"qpos": self._home_qpos.at[_BOX].set(box), "mocap_pos": target[None], "mocap_quat": quat[None]}
    return self._start(fields, {"rng": rng, "target_pos": target}, model)
