"""Get up after a fall: one task for all robots, composed by config."""

from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.locomotion.legged import LeggedTask
from playground.envs.physics import mjx
from playground.mdp.legged import Context


class Getup(LeggedTask):
  """Rises from whatever pose it has fallen into, and stands still (paper: appendix "Locomotion", fall recovery).

  Most episodes start dropped from a height, turned anyhow, with any joint angles; the others in the standing pose. Both
  come to rest first. An action moves the targets away from where the joints are, so a robot without action gives way.

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - Spot observes the direction of gravity in its own frame (0.2.0 gives it the upward axis in the world frame, which
    depends on the heading).
  """

  summaries: ClassVar[Mapping[str, str]] = {"upright": "last"}

  def __init__(self, config: Any):
    super().__init__(config)
    self._settle_steps = round(config.reset.settle_time / self.sim_dt)

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    model = self.mjx_model if model is None else model
    start = self.config.reset
    rng, *noise_key, drop_key, pose_key = jax.random.split(rng, 4 if self._own_noise_key else 3)
    dropped = jax.random.bernoulli(drop_key, start.drop_probability)
    qpos = jnp.where(dropped, self._fallen_pose(pose_key), self.robot.init_qpos)
    qvel = jnp.zeros(self.mj_model.nv)
    if start.base_vel > 0:
      rng, key = jax.random.split(rng)
      qvel = self._base_velocity(key)
    data = self._start(model, qpos, qvel)
    if self._settle_steps > 0:
      data = self.physics.step(model, data, data.ctrl, self._settle_steps)
    info = {"rng": rng, "last_last_act": jnp.zeros(self.action_size)}
    return self._first_state(data.replace(time=jnp.zeros_like(data.time)), info, *noise_key)

  def _measure(self, now: Context) -> dict[str, jax.Array]:
    """Adds whether the base is upright, within 18 degrees."""
    return super()._measure(now) | {"upright": (now.sensor("upvector")[2] > 0.95).astype(jnp.float32)}

  def _fallen_pose(self, key: jax.Array) -> jax.Array:
    """A pose in the air: any orientation, uniformly, and joint angles uniform within their ranges."""
    _, turn_key, joints_key = jax.random.split(key, 3)
    quat = jax.random.normal(turn_key, (4,))
    quat = quat / (jnp.linalg.norm(quat) + 1e-6)
    lower, upper = self.robot.joint_range
    joints = jax.random.uniform(joints_key, lower.shape, minval=lower, maxval=upper)
    return jnp.concatenate([jnp.array([0.0, 0.0, self.config.reset.drop_height]), quat, joints])
