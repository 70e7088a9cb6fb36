"""An arm in the plane that reaches for a target (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.dm_control.suite import SuiteTask, Terms, load_spec
from playground.envs.physics import PhysicsData
from playground.mdp.tolerance import tolerance


class Reacher(SuiteTask):
  """Brings the fingertip to the target with motors at shoulder and wrist (actions in [-1, 1]).

  Observation [6]: joint angles rad, target from the fingertip (x, y) m, joint velocities rad/s. The reward is 1 while
  fingertip and target touch, else 0. An episode starts at rest, with arm and target anywhere.
  """

  derived = ("geom_xpos",)

  def __init__(self, config: Any):
    """Loads the model. `config`: see `configs/env/_reacher.yaml`."""
    spec = load_spec("reacher")
    spec.geom("target").size[0] = config.target_radius
    super().__init__(config, spec.compile())
    target, finger = self.mj_model.geom("target"), self.mj_model.geom("finger")
    self._target, self._finger = target.id, finger.id
    self._target_height = jnp.array(self.mj_model.body("target").pos[2])
    self._reach = float(target.size[0] + finger.size[0])  # where fingertip and target touch

  @property
  def observation_parts(self) -> dict[str, dict[str, int]]:
    return {"state": {"joint_angles": 2, "to_target": 2, "velocity": 2}}

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, shoulder_key, wrist_key, angle_key, radius_key = jax.random.split(rng, 5)
    shoulder = jax.random.uniform(shoulder_key, minval=-jnp.pi, maxval=jnp.pi)
    low, high = self.mj_model.joint("wrist").range
    wrist = jax.random.uniform(wrist_key, minval=low, maxval=high)
    angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
    radius = jax.random.uniform(radius_key, minval=0.05, maxval=0.2)
    target = jnp.stack([radius * jnp.sin(angle), radius * jnp.cos(angle), self._target_height])
    return {"qpos": jnp.stack([shoulder, wrist]), "mocap_pos": target[None]}

  def observe(self, data: PhysicsData) -> jax.Array:
    return jnp.concatenate([data.qpos, self._to_target(data), data.qvel])

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    return tolerance(jnp.linalg.norm(self._to_target(data)), (0.0, self._reach)), {}

  def _to_target(self, data: PhysicsData) -> jax.Array:
    return (data.geom_xpos[self._target] - data.geom_xpos[self._finger])[:2]
