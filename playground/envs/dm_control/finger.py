"""A finger that spins a body on a hinge, or turns it to a target (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData

_XZ = jnp.array([0, 2])  # the plane of the finger
_SPIN_VELOCITY = -15.0  # rad/s, at least this fast


class Finger(SuiteTask):
  """What spinning and turning share: the finger (two motors, actions in [-1, 1]), the spinner and their observation.

  Observation [9]: angles of the finger's joints rad, tip of the spinner from its hinge (x, z) m, velocities of both
  joints and the hinge rad/s, log(1 + force in N) on the fingertip's top and bottom.
  """

  derived = ("sensordata",)

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"joint_angles": 2, "tip_position": 2, "velocity": 3, "touch": 2}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, finger_key, _, hinge_key = jax.random.split(rng, 4)
    low, high = self.mj_model.jnt_range[:2].T
    finger = jax.random.uniform(finger_key, (2,), minval=low, maxval=high)
    hinge = jax.random.uniform(hinge_key, minval=-jnp.pi, maxval=jnp.pi)
    return {"qpos": jnp.append(finger, hinge)}

  def observe(self, data: PhysicsData) -> jax.Array:
    angles = [self.sensor(data, name) for name in ("proximal", "distal")]
    touch = [jnp.log1p(self.sensor(data, name)) for name in ("touchtop", "touchbottom")]
    return jnp.concatenate([*angles, self._from_spinner(data, "tip"), data.qvel, *touch])

  def _from_spinner(self, data: PhysicsData, name: str) -> jax.Array:
    return (self.sensor(data, name) - self.sensor(data, "spinner"))[_XZ]


class FingerSpin(Finger):
  """Spins the body: reward 1 while it turns at 15 rad/s or more (clockwise as seen by `cam0`), else 0."""

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/FingerSpin.yaml`."""
    spec = load_spec("finger")
    spec.joint("hinge").damping[0] = config.hinge_damping
    for site in ("target", "tip"):
      spec.site(site).rgba[3] = 0.0  # no target here
    super().__init__(config, spec.compile())

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return (self.sensor(data, "hinge_velocity")[0] <= _SPIN_VELOCITY).astype(jnp.float32), {}


class FingerTurn(Finger):
  """Turns the body until its tip is in the target: reward 1 there, else 0.

  Observation [12]: that of `Finger`, the target from the hinge (x, z) and how far the tip is outside the target
  (negative inside), all m.
  """

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/FingerTurnEasy.yaml`."""
    spec = load_spec("finger")
    spec.site("target").size[0] = config.target_radius
    super().__init__(config, spec.compile())
    self._target_radius: float = config.target_radius
    self._hinge = jnp.array(self.mj_model.body("spinner").pos)
    self._reach = float(self.mj_model.geom("cap1").size.sum())  # to the end of the spinner

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": super().observation_parts["state"] | {"target_position": 2, "distance_to_target": 1}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    angle = jax.random.uniform(jax.random.split(rng, 3)[2], minval=-jnp.pi, maxval=jnp.pi)
    offset = self._reach * jnp.stack([jnp.sin(angle), jnp.zeros(()), jnp.cos(angle)])
    return {**super().initial(rng), "mocap_pos": (self._hinge + offset)[None]}

  def observe(self, data: PhysicsData) -> jax.Array:
    target = self._from_spinner(data, "target")
    return jnp.concatenate([super().observe(data), target, self._distance(data)[None]])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return (self._distance(data) <= 0).astype(jnp.float32), {}

  def _distance(self, data: PhysicsData) -> jax.Array:
    gap = self._from_spinner(data, "target") - self._from_spinner(data, "tip")
    return jnp.linalg.norm(gap) - self._target_radius
