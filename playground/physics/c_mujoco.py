"""Physics in C MuJoCo, behind the same two operations as MJX's.

Policies are tried in this second simulator before they run on a robot. It needs no compiling. It steps the environments
of a batch one after another on one core, so it is for evaluation, not for training.
"""

import copy
import threading

import jax
import mujoco
import numpy as np

from playground.errors import ConfigError
from playground.physics.backend import STATE_FIELDS, Physics, PhysicsData, mjx

_MODEL_FIELDS = tuple(field.name for field in mjx.Model.fields())


class CPhysics(Physics):
  """MuJoCo's own `mj_forward` and `mj_step`, called back from jitted code; see `Physics`.

  A state is complete (`STATE_FIELDS`), so every call sets all of it and nothing is left over from the one before. The
  arrays of a randomised model go with it; what MuJoCo derives from them when it compiles a model stays nominal, as in
  MJX. Within a control step MuJoCo computes in double precision; the state between two steps is single.
  """

  def __init__(self, other: Physics):
    """Simulates the model of `other`, a task's physics in MJX, and keeps its `model`, which is rendered."""
    # Only templates of states come from MJX, on the backend that has the model: the other may not implement it.
    super().__init__(other.mj_model, impl=other.impl, derived=other.derived, **other._buffers)
    self.model = other.model
    self._c_model = copy.copy(other.mj_model)
    for frames in (self._c_model.body_sameframe, self._c_model.geom_sameframe, self._c_model.site_sameframe):
      frames[:] = 0  # else `mj_kinematics` takes a drawn place in the body for the body's own
    simple = self._c_model.dof_simplenum.astype(bool)  # of these MuJoCo reads the inertia (`dof_M0`), which is nominal
    self._slides = simple & (self._c_model.jnt_type[self._c_model.dof_jntid] == mujoco.mjtJoint.mjJNT_SLIDE)
    # C MuJoCo would reset an unstable simulation. Its numbers should show instead, as in MJX. And it would look for the
    # contacts of a body with several geoms where the nominal geoms are.
    self._c_model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET | mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    self._c_data = mujoco.MjData(self._c_model)
    self._lock = threading.Lock()  # programs may run at the same time
    example = self._keep(self._template())
    self._shapes = {
      name: jax.ShapeDtypeStruct(np.shape(value), value.dtype)
      for name in (*STATE_FIELDS, *self.derived)
      if (value := getattr(example, name)) is not None
    }

  def __deepcopy__(self, memo: dict[int, object]) -> "CPhysics":
    """Returns a simulator of its own, for Python cannot copy a lock."""
    other = copy.copy(self)
    other.mj_model = copy.deepcopy(self.mj_model, memo)
    return CPhysics(other)

  def forward(self, model: mjx.Model, data: PhysicsData) -> PhysicsData:
    return self._call(model, data, 0)

  def step(self, model: mjx.Model, data: PhysicsData, ctrl: jax.Array, num_substeps: int) -> PhysicsData:
    return self._call(model, data.replace(ctrl=ctrl), num_substeps)

  def _keep(self, data: mjx.Data, derived: tuple[str, ...] | None = None) -> PhysicsData:
    return super()._keep(data, derived).replace(buffers=None)

  def _call(self, model: mjx.Model, data: PhysicsData, num_substeps: int) -> PhysicsData:
    state = {name: getattr(data, name) for name in STATE_FIELDS}
    drawn = {name: value for name in _MODEL_FIELDS if (value := getattr(model, name)) is not getattr(self.model, name)}
    if other := [name for name, value in drawn.items() if not isinstance(value, jax.Array)]:
      raise ConfigError(f"C MuJoCo takes randomised arrays of a model, and its `{other[0]}` is none.")
    run = lambda state, drawn: self._run(state, drawn, num_substeps)
    return PhysicsData(**jax.pure_callback(run, self._shapes, state, drawn, vmap_method="broadcast_all"))

  def _run(
    self, state: dict[str, np.ndarray], drawn: dict[str, np.ndarray], num_substeps: int
  ) -> dict[str, np.ndarray]:
    """Runs each environment of a batch (any leading axes): `num_substeps` steps, or for 0 a forward pass.

    `drawn` are the fields of its model that are not the nominal ones.
    """
    state, drawn = jax.tree.map(np.asarray, (state, drawn))
    batch = state["time"].shape
    out = {name: np.empty((*batch, *shape.shape), shape.dtype) for name, shape in self._shapes.items()}
    with self._lock:
      for i in np.ndindex(batch):
        for name, value in state.items():
          setattr(self._c_data, name, value[i].reshape(np.shape(getattr(self._c_data, name))))
        for name, value in drawn.items():
          getattr(self._c_model, name)[:] = value[i].reshape(np.shape(getattr(self._c_model, name)))
        self._c_model.dof_M0[self._slides] = self._inertia_of_slides()
        if num_substeps:
          mujoco.mj_step(self._c_model, self._c_data, num_substeps)
          if not np.isfinite(state["ctrl"][i]).all():  # C MuJoCo has taken all of it as 0
            self._c_data.qpos[:] = self._c_data.qvel[:] = np.nan
        else:
          mujoco.mj_forward(self._c_model, self._c_data)
        for name, values in out.items():
          values[i] = np.reshape(getattr(self._c_data, name), self._shapes[name].shape)
      for name in (*drawn, "dof_M0"):
        getattr(self._c_model, name)[:] = getattr(self.mj_model, name)
    return out

  def _inertia_of_slides(self) -> np.ndarray:
    """Returns the kg of each slide that moves one body alone, with its armature."""
    return (self._c_model.body_mass[self._c_model.dof_bodyid] + self._c_model.dof_armature)[self._slides]
