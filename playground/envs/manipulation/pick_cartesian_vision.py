"""A Panda that picks up a cube by what a camera sees."""

from typing import Any

import jax.numpy as jnp

from playground.envs.manipulation.pick_cartesian import PickCubeCartesian
from playground.envs.manipulation.tabletop import Info, Terms
from playground.envs.physics import PhysicsData, mjx


class PickCubeCartesianVision(PickCubeCartesian):
  """Lifts a cube to the target's height (paper, section IV-C and appendix C.6); what is seen says `env.vision`.

  The default differs from Playground 0.2.0 in the scene, beside what `PickCubeCartesian` and `Vision` list: the target
  is out of sight, the floor dark, so that the white strip where the cube may lie is seen, and the light a fixed sun,
  whose direction can be randomised. With `env.parity=true` a red target stands opaque in the robot's base, the floor is
  as white as the strip, and the light hangs above the robot whatever is drawn for it.
  """

  def __init__(self, config: Any):
    """Builds the scene. `config`: see `configs/env/PandaPickCubeCartesianVision.yaml`."""
    super().__init__(config, "panda_single_cube_camera" if config.parity else "panda_single_cube_pixels")

  def _placed(self, fields: Any, model: mjx.Model | None) -> PhysicsData:
    if not self.parity:
      return super()._placed(fields, model)
    data = self.physics.make(**{"ctrl": self._home_ctrl, **fields, "mocap_pos": jnp.zeros((1, 3))})
    return self.physics.forward(self.mjx_model if model is None else model, data)

  def _measures(self, data: PhysicsData, info: Info) -> Terms:
    off = jnp.abs(data.xpos[self._moved][2] - info["target_pos"][2])
    return super()._measures(data, info) | {"success": (off < self.config.success_distance).astype(jnp.float32)}
