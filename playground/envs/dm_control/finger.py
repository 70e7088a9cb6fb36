"""A finger that spins a body on a hinge, or turns it to a target (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.dm_control.suite import SuiteTask, Terms, draw_angle
from playground.physics.backend import PhysicsData

_XZ = jnp.array([0, 2])  # the plane of the finger
_SPIN_VELOCITY = -15.0  # rad/s, at least this fast


class Finger(SuiteTask):
  """Base of spinning and turning: the finger (two motors, actions in [-1, 1]), the spinner and their observation.

  Observation [9]: angles of the finger's joints rad, tip of the spinner from its hinge (x, z) m, velocities of both
  joints and the hinge rad/s, log(1 + force in N) on the fingertip's top and bottom.
  """

  domain = "finger"
  derived = ("sensordata",)

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, finger_key, _, hinge_key = jax.random.split(rng, 4)
    return {"qpos": jnp.append(self.draw_joints(finger_key, slice(2)), draw_angle(hinge_key))}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    read = lambda *names: jnp.concatenate([self.sensor(data, name) for name in names])
    return {
      "joint_angles": read("proximal", "distal"),
      "tip_position": self._from_spinner(data, "tip"),
      "velocity": data.qvel,
      "touch": jnp.log1p(read("touchtop", "touchbottom")),
    }

  def _from_spinner(self, data: PhysicsData, name: str) -> jax.Array:
    return (self.sensor(data, name) - self.sensor(data, "spinner"))[_XZ]


class FingerSpin(Finger):
  """Spins the body: reward 1 while it turns at 15 rad/s or more (clockwise as seen by `cam0`), else 0."""

  def scene(self, config: Any) -> mujoco.MjSpec:
    spec = super().scene(config)
    spec.joint("hinge").damping[0] = config.hinge_damping
    for site in ("target", "tip"):
      spec.site(site).rgba[3] = 0.0  # no target here
    return spec

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return (self.sensor(data, "hinge_velocity")[0] <= _SPIN_VELOCITY).astype(jnp.float32), {}


class FingerTurn(Finger):
  """Turns the body until its tip is in the target: reward 1 there, else 0.

  Observation [12]: that of `Finger`, the target from the hinge (x, z) and how far the tip is outside the target
  (negative inside), all m.
  """

  def scene(self, config: Any) -> mujoco.MjSpec:
    spec = super().scene(config)
    spec.site("target").size[0] = config.target_radius
    return spec

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    angle = draw_angle(jax.random.split(rng, 3)[2])
    reach = self.mj_model.geom("cap1").size.sum()  # to the end of the spinner, m
    offset = reach * jnp.stack([jnp.sin(angle), jnp.zeros(()), jnp.cos(angle)])
    return {**super().initial(rng), "mocap_pos": (self.mj_model.body("spinner").pos + offset)[None]}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    target = {"target_position": self._from_spinner(data, "target"), "distance_to_target": self._distance(data)}
    return super().parts(data) | target

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return (self._distance(data) <= 0).astype(jnp.float32), {}

  def _distance(self, data: PhysicsData) -> jax.Array:
    gap = self._from_spinner(data, "target") - self._from_spinner(data, "tip")
    return jnp.linalg.norm(gap) - self.config.target_radius
