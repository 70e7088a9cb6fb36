"""An arm in the plane that reaches for a target (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.dm_control.suite import SuiteTask, Terms, draw_angle
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData


class Reacher(SuiteTask):
  """Brings the fingertip to the target with motors at shoulder and wrist (actions in [-1, 1]).

  Observation [6]: joint angles rad, target from the fingertip (x, y) m, joint velocities rad/s. The reward is 1 while
  fingertip and target touch, else 0. An episode starts at rest, with arm and target anywhere.
  """

  domain = "reacher"
  derived = ("geom_xpos",)

  def scene(self, config: Any) -> mujoco.MjSpec:
    spec = super().scene(config)
    spec.geom("target").size[0] = config.target_radius
    return spec

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, shoulder_key, wrist_key, angle_key, radius_key = jax.random.split(rng, 5)
    wrist = self.draw_joints(wrist_key, slice(1, 2))
    angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
    radius = jax.random.uniform(radius_key, minval=0.05, maxval=0.2)
    target = jnp.stack([radius * jnp.sin(angle), radius * jnp.cos(angle), self.mj_model.body("target").pos[2]])
    return {"qpos": jnp.append(draw_angle(shoulder_key), wrist), "mocap_pos": target[None]}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    return {"joint_angles": data.qpos, "to_target": self._to_target(data), "velocity": data.qvel}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    radii = self.mj_model.geom("target").size[0] + self.mj_model.geom("finger").size[0]
    return tolerance(jnp.linalg.norm(self._to_target(data)), (0.0, radii)), {}

  def _to_target(self, data: PhysicsData) -> jax.Array:
    return (data.geom_xpos[self.geom["target"]] - data.geom_xpos[self.geom["finger"]])[:2]
