"""Gains of a robot's position servos, where a task sets others than the MJCF has."""

from collections.abc import Sequence

import mujoco
import numpy as np


def set_gains(
  mj_model: mujoco.MjModel,
  kp: float | Sequence[float] | None = None,
  kv: float | Sequence[float] | None = None,
  damping: float | Sequence[float] | None = None,
) -> None:
  """Sets the gains of every servo, in place; None leaves those of the MJCF.

  A servo's torque is kp * (ctrl - q) - kv * qd, clipped to its range; the joint itself adds -damping * qd.

  Args:
    mj_model: a robot's compiled scene: one free joint, then one position servo for each hinge.
    kp: position gain, N m/rad, one for all or one for each.
    kv: velocity gain of the servo, N m s/rad.
    damping: passive damping of every joint but the free one, N m s/rad.
  """
  if kp is not None:
    mj_model.actuator_gainprm[:, 0] = kp
    mj_model.actuator_biasprm[:, 1] = -np.asarray(kp)
  if kv is not None:
    mj_model.actuator_biasprm[:, 2] = -np.asarray(kv)
  if damping is not None:
    mj_model.dof_damping[6:] = damping
