"""A fish that swims to a target (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance

_ROOT = 7  # entries of qpos before the joints: position and quaternion of the torso


class FishSwim(SuiteTask):
  """Brings the fish's mouth to a target (five servos: tail, its twist, flap of both fins, pitch of each, in [-1, 1]).

  Observation [24]: uprightness (cosine of the tilt), seven joint angles rad, mouth to target in the mouth's frame m,
  velocities m/s and rad/s. The reward is (7 in_target + upright) / 8.
  """

  derived = ("xmat", "geom_xpos", "geom_xmat")

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/FishSwim.yaml`."""
    super().__init__(config, load_spec("fish").compile())
    model = self.mj_model
    self._torso = model.body("torso").id
    self._mouth = model.geom("mouth").id
    self._target = model.geom("target").id
    self._radii = float(model.geom("mouth").size[0] + model.geom("target").size[0])

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"upright": 1, "joint_angles": 7, "target": 3, "velocity": 13}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, root_key, joints_key, target_key = jax.random.split(rng, 4)
    quat = jax.random.normal(root_key, (4,))
    joints = jax.random.uniform(joints_key, (self.mj_model.nq - _ROOT,), minval=-0.2, maxval=0.2)
    low, high = jnp.array([-0.4, -0.4, 0.1]), jnp.array([0.4, 0.4, 0.3])
    return {
      "qpos": jnp.concatenate([jnp.zeros(3), quat / jnp.linalg.norm(quat), joints]),
      "mocap_pos": jax.random.uniform(target_key, (1, 3), minval=low, maxval=high),
    }

  def observe(self, data: PhysicsData) -> jax.Array:
    upright = data.xmat[self._torso, 2, 2]
    return jnp.concatenate([upright[None], data.qpos[_ROOT:], self._mouth_to_target(data), data.qvel])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(self._mouth_to_target(data))
    in_target = tolerance(distance, (0, self._radii), margin=2 * self._radii)
    upright = (data.xmat[self._torso, 2, 2] + 1) / 2
    return (7 * in_target + upright) / 8, {"in_target": in_target, "upright": upright}

  def _mouth_to_target(self, data: PhysicsData) -> jax.Array:
    return (data.geom_xpos[self._target] - data.geom_xpos[self._mouth]) @ data.geom_xmat[self._mouth]
