"""A Panda that opens a drawer."""

from typing import Any

import jax
import jax.numpy as jnp

from playground.envs.base import State
from playground.envs.manipulation.arm import ArmTask
from playground.envs.physics import mjx
from playground.robots.panda.kinematics import JOINT_RANGE

# How far each joint of the arm may start from upright, in parts of `env.reset.joint_angle`: joints 4 and 6, which bend
# one way, up to twice as far as the others.
_SPREAD = jnp.array([[-1, -1, -1, -2, -1, 0, -1], [1, 1, 1, 0, 1, 2, 1]], jnp.float32)


class OpenCabinet(ArmTask):
  """Pulls the handle of a drawer to where it should be (paper, appendix "Manipulation").

  The arm starts upright, bent at random; the drawer starts closed.

  Beside those of `ArmTask` the default has one difference from Playground 0.2.0; `env.parity=true` has its ways:
  - The arm starts within its joints' limits, joint 4 of the pose that `robot_target_qpos` asks for included, and the
    target is drawn where it is (0.2.0 starts with joint 4 up to 0.07 rad beyond its limit, asks for 0, which it cannot
    have, and leaves the marker in the arm's base).
  """

  def __init__(self, config: Any):
    """Builds the scene. `config`: see `configs/env/PandaOpenCabinet.yaml`."""
    super().__init__(config, "panda_cabinet", keyframe="upright", body="handle", obstacle="barrier")
    if not self.parity:
      self._home_qpos, self._home_ctrl = (self._bend(x, 0.0) for x in (self._home_qpos, self._home_ctrl))

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    start = self.config.reset
    rng, target_key = jax.random.split(rng)
    target = jnp.array([start.target_x, 0.0, self.mj_model.body("handle").pos[2]])
    target = target.at[0].add(jax.random.uniform(target_key, minval=-start.target_spread, maxval=start.target_spread))
    rng, arm_key = jax.random.split(rng)
    low, high = start.joint_angle * _SPREAD
    angles = jax.random.uniform(arm_key, low.shape, minval=low, maxval=high)
    fields = {"qpos": self._bend(self._home_qpos, angles), "ctrl": self._bend(self._home_ctrl, angles)}
    if not self.parity:
      fields["mocap_pos"] = target[None]
    return self._start(fields, {"rng": rng, "target_pos": target}, model)

  def _bend(self, joints: jax.Array, angles: jax.Array | float) -> jax.Array:
    """qpos or ctrl with the arm's joints moved by `angles`, as far as they go."""
    arm = joints[:7] + angles
    return joints.at[:7].set(arm if self.parity else jnp.clip(arm, *JOINT_RANGE))
