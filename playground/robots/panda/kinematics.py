"""Kinematics of the Franka Panda in closed form: the pose of its hand's tip from joint angles, and back.

Frames follow Craig's convention (rotate and shift along the joint before's x, then about and along the joint's own z)
with the manufacturer's published parameters. Everything is for one arm; callers vmap.

The inverse fixes joint 7. That leaves joints 1 to 6 for a pose. The axes of 1 to 3 meet in the shoulder S, those of 5
and 6 in the wrist W. Joint 7's angle and the pose give W. The distance from S to W gives joint 4; where S lies as seen
from frame 6 gives joint 6; the rest are angles of frames that are known by then.
"""

import jax
import jax.numpy as jnp

# Of each joint: twist alpha (rad) and length a (m) before it, offset d (m) along it.
_ALPHA = (0.0, -jnp.pi / 2, jnp.pi / 2, jnp.pi / 2, -jnp.pi / 2, jnp.pi / 2, jnp.pi / 2)
_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)
_SHOULDER, _UPPER_ARM, _FOREARM = _D[0], _D[2], _D[4]  # its height; lengths
_ELBOW, _WRIST = _A[3], _A[6]  # how far the axis of joint 4 is off both arms, that of 7 off that of 6

FLANGE = 0.107  # m from joint 6's axis, along joint 7's
TIP = FLANGE + 0.1034  # the manufacturer's tip of the hand, between the ends of its fingers
HAND_TURN = -jnp.pi / 4  # rad, of the hand on the flange

_LOWER = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
_UPPER = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
JOINT_RANGE = jnp.array([_LOWER, _UPPER])  # rad, lower and upper


def forward_kinematics(q: jax.Array, tip: float = TIP) -> tuple[jax.Array, jax.Array]:
  """Returns position of the tip [3], m, and rotation matrix of the hand [3, 3], in the frame of the arm's base.

  `q` are joint angles [7], rad; `tip` is m beyond joint 6's axis, along the hand.
  """
  pos, rot = jnp.zeros(3), jnp.eye(3)
  for i in range(7):
    pos += rot @ jnp.array([_A[i], -_D[i] * jnp.sin(_ALPHA[i]), _D[i] * jnp.cos(_ALPHA[i])])
    rot = rot @ _joint_rotation(i, q[i])
  rot = rot @ _about_z(HAND_TURN)
  return pos + tip * rot[:, 2], rot


def inverse_kinematics(pos: jax.Array, rot: jax.Array, q7: jax.Array, near: jax.Array, tip: float = TIP) -> jax.Array:
  """Joint angles that put the hand's tip at a pose.

  Args:
    pos, rot, tip: as `forward_kinematics` has them.
    q7: angle of joint 7, rad.
    near: joint angles [7], rad, that say which of four solutions to take: the one with joint 2 on its side of zero and
      joint 5 on its side of a quarter turn. Where joint 1 is free (the upper arm is vertical), it is as in `near`.

  Returns:
    Angles [7], rad, which may lie outside `JOINT_RANGE` (see `within_limits`); joint 4 is at or below -0.47, where the
    arm is stretched. Some are NaN where no arm of these lengths reaches the pose.
  """
  rot7 = rot @ _about_z(-HAND_TURN)
  rot6 = rot7 @ _joint_rotation(6, q7).T
  wrist = pos - tip * rot[:, 2] - _WRIST * rot6[:, 0]
  shoulder = jnp.array([0.0, 0.0, _SHOULDER]) - wrist  # as seen from the wrist, from here on

  # The distance |S W| is a cosine of joint 4. Of its two angles, the other is beyond the stretched arm.
  cos_part, sin_part = _UPPER_ARM * _FOREARM - _ELBOW**2, -_ELBOW * (_UPPER_ARM + _FOREARM)
  both = (shoulder @ shoulder - _UPPER_ARM**2 - _FOREARM**2 - 2 * _ELBOW**2) / 2
  q4 = jnp.arctan2(sin_part, cos_part) - jnp.arccos(_to_rounding(both / jnp.hypot(cos_part, sin_part)))
  s4, c4 = jnp.sin(q4), jnp.cos(q4)

  # In frame 4, S has these coordinates along x and along the forearm. Joint 6 turns the forearm to where they fit.
  across = _ELBOW - _UPPER_ARM * s4 - _ELBOW * c4
  along = _ELBOW * s4 - _UPPER_ARM * c4 - _FOREARM
  x, y, _ = rot6.T @ shoulder
  turn = jnp.arcsin(_to_rounding(along / jnp.hypot(x, y)))
  turn = jnp.where(jnp.cos(near[4]) <= 0, jnp.pi - turn, turn)
  highest = JOINT_RANGE[1, 5]
  q6 = highest - jnp.mod(highest - turn + jnp.arctan2(y, x), 2 * jnp.pi)

  rot5 = rot6 @ _joint_rotation(5, q6).T
  forearm = rot5[:, 2]
  x4 = (shoulder - along * forearm) / across
  in_frame5 = rot5.T @ x4
  q5 = jnp.arctan2(-in_frame5[1], in_frame5[0])

  upper_arm = s4 * x4 + c4 * forearm
  x3 = c4 * x4 - s4 * forearm
  side = jnp.where(near[1] < 0, -1.0, 1.0)
  horizontal = jnp.hypot(upper_arm[0], upper_arm[1])
  q2 = side * jnp.arctan2(horizontal, upper_arm[2])
  q1 = jnp.where(horizontal < 1e-6, near[0], jnp.arctan2(side * upper_arm[1], side * upper_arm[0]))
  in_frame2 = (_about_z(q1) @ _joint_rotation(1, q2)).T @ x3
  q3 = jnp.arctan2(in_frame2[2], in_frame2[0])
  return jnp.stack([q1, q2, q3, q4, q5, q6, jnp.asarray(q7, q4.dtype)])


def within_limits(q: jax.Array) -> jax.Array:
  """Whether all angles (shape [7], rad) lie in `JOINT_RANGE`; false for NaN."""
  return ((JOINT_RANGE[0] <= q) & (q <= JOINT_RANGE[1])).all()


def _to_rounding(cosine: jax.Array) -> jax.Array:
  """Clips a cosine that rounding took beyond 1, at the border of the arm's reach."""
  return jnp.where(jnp.abs(cosine) < 1 + 1e-5, jnp.clip(cosine, -1.0, 1.0), cosine)


def _joint_rotation(i: int, angle: jax.Array) -> jax.Array:
  """Frame i + 1 in frame i, counted from 0, the base."""
  s, c = jnp.sin(_ALPHA[i]), jnp.cos(_ALPHA[i])
  return jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ _about_z(angle)


def _about_z(angle: jax.Array | float) -> jax.Array:
  s, c = jnp.sin(angle), jnp.cos(angle)
  return jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
