"""A fish that swims to a target (DM Control Suite)."""

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

_ROOT = 7  # entries of qpos before the joints: position and quaternion of the torso


class FishSwim(SuiteTask):
  """Brings the fish's mouth to a target (five servos: tail, its twist, flap of both fins, pitch of each, in [-1, 1]).

  Observation [24]: uprightness (cosine of the tilt), seven joint angles rad, mouth to target in the mouth's frame m,
  velocities m/s and rad/s. The reward is (7 in_target + upright) / 8.
  """

  domain = "fish"
  derived = ("xmat", "geom_xpos", "geom_xmat")

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, root_key, joints_key, target_key = jax.random.split(rng, 4)
    quat = jax.random.normal(root_key, (4,))
    joints = jax.random.uniform(joints_key, (self.mj_model.nq - _ROOT,), minval=-0.2, maxval=0.2)
    low, high = jnp.array([-0.4, -0.4, 0.1]), jnp.array([0.4, 0.4, 0.3])
    return {
      "qpos": jnp.concatenate([jnp.zeros(3), quat / jnp.linalg.norm(quat), joints]),
      "mocap_pos": jax.random.uniform(target_key, (1, 3), minval=low, maxval=high),
    }

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    return {
      "upright": data.xmat[self.body["torso"], 2, 2],
      "joint_angles": data.qpos[_ROOT:],
      "target": self._mouth_to_target(data),
      "velocity": data.qvel,
    }

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(self._mouth_to_target(data))
    radii = self.mj_model.geom("mouth").size[0] + self.mj_model.geom("target").size[0]
    in_target = tolerance(distance, (0, radii), margin=2 * radii)
    upright = (data.xmat[self.body["torso"], 2, 2] + 1) / 2
    return (7 * in_target + upright) / 8, {"in_target": in_target, "upright": upright}

  def _mouth_to_target(self, data: PhysicsData) -> jax.Array:
    mouth = self.geom["mouth"]
    return (data.geom_xpos[self.geom["target"]] - data.geom_xpos[mouth]) @ data.geom_xmat[mouth]
