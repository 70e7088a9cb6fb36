"""Physics on MJX: advances the few fields that a task stores between steps.

`mjx.Data` carries 40-150 KB an environment, nearly all of it scratch that the next forward pass writes again. A
`PhysicsData` holds only the simulator's state and the derived fields that the task reads; each step rebuilds the rest
from one template. So a state is small, complete (a resumed run is exact bit for bit) and the same for both backends.
"""

import contextlib
import copy
import dataclasses
import io
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from playground.errors import ConfigError
from playground.hardware.mesh import GROUP
from playground.physics.warp_kernels import KernelBuild, cancel_prestart, quiet_warp
from playground.text import first_line

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on stdout that Warp is not installed
  from mujoco import mjx

WORLDS = "worlds"  # the axis of the batch of environments, for `jax.vmap(axis_name=...)`: Warp's buffers grow with it
_FEW = 64  # smaller batches get the buffers of so many environments, since their mean may be above the average


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
  """Compiles a model whose fields may be drawn; raises MuJoCo's ValueError.

  No free body is "simple": of such a one MJX and C MuJoCo assume in each step that the centre of mass is at its origin,
  and C MuJoCo the nominal mass, so with another centre of mass it spins up in free fall. Bodies on slides may be
  simple: where their centre of mass is acts on nothing, and their constraints would be a little softer.
  """
  for body in spec.bodies:
    if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints):
      body.simple = 0
  return spec.compile()


class BufferUse(struct.PyTreeNode):
  """The use of Warp's buffers in the last control step, the most of any of its physics steps; each shape [].

  Attributes:
    constraints: constraint rows of the environment (`njmax` bounds them).
    contacts: contacts and pairs that might touch, over all environments together (`naconmax` bounds both).
    overflow: mujoco_warp's `OverflowType` bits of the buffers that were too small, 0 if none was.
  """

  constraints: jax.Array
  contacts: jax.Array
  overflow: jax.Array

  def join(self, other: "BufferUse") -> "BufferUse":
    """Returns the use of two physics steps."""
    constraints, contacts = (jnp.maximum(getattr(self, k), getattr(other, k)) for k in ("constraints", "contacts"))
    return BufferUse(constraints, contacts, self.overflow | other.overflow)


_ABSENT: Any = None  # a derived field that the task does not name


class PhysicsData(struct.PyTreeNode):
  """One environment's simulator state, named as in `mujoco.MjData`; derived fields a task does not read are None.

  `buffers` (Warp only, else None) is no part of the state: it is the use of buffers in the last step.

  After a step the derived fields belong to the state before the last integration, `qpos` and `qvel` to the one after
  it (`mj_step` is forward, then integrate).
  """

  time: jax.Array
  qpos: jax.Array
  qvel: jax.Array
  act: jax.Array
  history: jax.Array
  ctrl: jax.Array
  qacc_warmstart: jax.Array
  qfrc_applied: jax.Array
  xfrc_applied: jax.Array
  eq_active: jax.Array
  mocap_pos: jax.Array
  mocap_quat: jax.Array
  qacc: jax.Array = _ABSENT
  sensordata: jax.Array = _ABSENT
  actuator_force: jax.Array = _ABSENT
  qfrc_actuator: jax.Array = _ABSENT
  xpos: jax.Array = _ABSENT
  xquat: jax.Array = _ABSENT
  xmat: jax.Array = _ABSENT
  xipos: jax.Array = _ABSENT
  xanchor: jax.Array = _ABSENT
  site_xpos: jax.Array = _ABSENT
  site_xmat: jax.Array = _ABSENT
  geom_xpos: jax.Array = _ABSENT
  geom_xmat: jax.Array = _ABSENT
  subtree_com: jax.Array = _ABSENT
  cvel: jax.Array = _ABSENT
  ten_length: jax.Array = _ABSENT
  buffers: BufferUse | None = None


_FIELDS = [field for field in dataclasses.fields(PhysicsData) if field.name != "buffers"]
# The next step depends on these fields only: everything else in `mjx.Data` follows from them.
STATE_FIELDS = tuple(field.name for field in _FIELDS if field.default is dataclasses.MISSING)
# Fields that observations, rewards and terminations may read besides.
DERIVED_FIELDS = tuple(field.name for field in _FIELDS if field.default is None)


class Physics:
  """A compiled model on one backend, with the two operations tasks need: `forward` and `step`."""

  def __init__(
    self,
    mj_model: mujoco.MjModel,
    *,
    impl: str = "jax",
    derived: tuple[str, ...] = DERIVED_FIELDS,
    **buffers: int | None,
  ):
    """Puts the model on the device.

    Args:
      mj_model: the compiled model; its `opt.timestep` is the physics step in seconds.
      impl: 'jax' or 'warp'.
      derived: the names out of `DERIVED_FIELDS` that the task reads.
      **buffers: `naconmax_per_env`, `naccdmax_per_env` and `njmax`: Warp's buffers, see `EnvConfig`. The environments
        of a batch, the axis `WORLDS` of the `jax.vmap` around, share the contacts.

    Raises:
      ConfigError: the model has something that MJX does not implement, or the integrator RK4.
    """
    if mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
      raise ConfigError(
        "The model's integrator is RK4, with which MJX and C MuJoCo read sensors at different times: write "
        "integrator='Euler' or 'implicitfast' in the MJCF."
      )
    self.mj_model = mj_model
    self.impl = impl
    self.derived = derived
    self._forward = mjx.forward if impl == "warp" else jax.jit(mjx.forward)  # most of the time of tracing: traced once
    try:
      self.model = _put_on_warp(mj_model) if impl == "warp" else mjx.put_model(mj_model, _device(), impl=impl)
    except NotImplementedError as error:
      raise ConfigError(
        f"MJX cannot simulate this model with env.impl={impl}: {first_line(error)}; change it in the MJCF."
      ) from error
    self._buffers = buffers

  def without_dynamics(self) -> "Physics":
    """Returns the same where nothing moves: `jax.eval_shape` takes a fraction of the time."""
    still = copy.copy(self)
    still._forward = lambda model, data: data
    still.step = lambda model, data, ctrl, num_substeps: data.replace(ctrl=ctrl)
    return still

  def compile_ahead(self) -> KernelBuild | None:
    """Starts to compile the kernels that Warp needs on a GPU; returns None for another backend or device."""
    if self.impl != "warp" or jax.default_backend() != "gpu":
      cancel_prestart()
      return None
    return KernelBuild(self.mj_model, self._buffers.get("njmax"))

  def make(self, **fields: jax.Array) -> PhysicsData:
    """Returns the model's default state with `fields` replaced; derived fields are those of fresh data."""
    fields = {name: jnp.asarray(value) for name, value in fields.items()}
    return self._keep(self._template().replace(**fields))

  def forward(self, model: mjx.Model, data: PhysicsData) -> PhysicsData:
    """Computes the derived fields of the present state, without advancing it."""
    return self._keep(self.present(model, data))

  def present(self, model: mjx.Model, data: PhysicsData) -> mjx.Data:
    """Returns MJX's own data of the present state, with all derived fields."""
    return self._forward(model, self._full(data))

  def step(self, model: mjx.Model, data: PhysicsData, ctrl: jax.Array, num_substeps: int) -> PhysicsData:
    """Advances by `num_substeps` physics steps under a constant `ctrl` (shape [nu])."""
    data = data.replace(ctrl=ctrl, buffers=None if data.buffers is None else jax.tree.map(jnp.zeros_like, data.buffers))

    def advance(data: PhysicsData, derived: tuple[str, ...]) -> PhysicsData:
      after = self._keep(self._advance(model, self._full(data)), derived)
      if data.buffers is None or after.buffers is None:
        return after
      return after.replace(buffers=data.buffers.join(after.buffers))

    if self.impl == "warp":  # computes all of them anyway, and allocates memory for each call site
      return jax.lax.scan(lambda data, _: (advance(data, self.derived), None), data, None, num_substeps)[0]
    # Only the last substep's derived fields are read, so the others do not compute them (such as sensors): 9 % faster
    # training of the Go1 on an H200, for four seconds more of compiling.
    if num_substeps > 1:
      data = data.replace(**dict.fromkeys(self.derived))
      data = jax.lax.scan(lambda data, _: (advance(data, ()), None), data, None, num_substeps - 1)[0]
    return advance(data, self.derived)

  def _advance(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.step`, with the forward dynamics that everything here shares."""
    if self.impl == "warp":
      return mjx.step(model, data)
    data = self._forward(model, data)
    if self.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
      return mjx.euler(model, data)
    return mjx.implicit(_without_saturated(model, data), data)

  def _template(self) -> mjx.Data:
    if self.impl == "jax":
      return mjx.make_data(self.mj_model, _device(), impl="jax")
    worlds = max(batch_size(), _FEW)
    sizes: dict[str, Any] = {"njmax": self._buffers.get("njmax")}
    for name in ("naconmax", "naccdmax"):
      each = self._buffers.get(f"{name}_per_env")
      sizes[name] = each and each * worlds
    return mjx.make_data(self.mj_model, _device(), impl="warp", **sizes)

  def _full(self, data: PhysicsData) -> mjx.Data:
    return self._template().replace(**{name: getattr(data, name) for name in STATE_FIELDS})

  def _keep(self, data: mjx.Data, derived: tuple[str, ...] | None = None) -> PhysicsData:
    derived = self.derived if derived is None else derived
    kept = {name: getattr(data, name) for name in (*STATE_FIELDS, *derived)}
    return PhysicsData(**kept, buffers=_buffer_use(data) if self.impl == "warp" else None)


def _device() -> Any:
  """The device that MJX puts models and data on: one of this process, for MJX's own default is one of process 0."""
  return jax.local_devices()[0]


def batch_size() -> int:
  """How many environments share Warp's buffers: a batch, for each agent that shares the device."""
  return _axis_size(WORLDS) * _axis_size(GROUP)


def _axis_size(name: str) -> int:
  try:
    return jax.lax.axis_size(name)
  except NameError:  # nothing around is mapped over it
    return 1


def _without_saturated(model: mjx.Model, data: mjx.Data) -> mjx.Model:
  """The model for `mjx.implicit`: a force at its limit does not change with the velocity.

  C MuJoCo and MuJoCo-Warp leave such forces out of the derivative; MJX 3.17 does not, which damps the joint.
  """
  if not model.actuator_forcelimited.any():
    return model
  low, high = model.actuator_forcerange.T
  saturated = model.actuator_forcelimited & ((data.actuator_force <= low) | (data.actuator_force >= high))
  prm = {name: getattr(model, name).at[:, 2].multiply(~saturated) for name in ("actuator_biasprm", "actuator_gainprm")}
  return model.replace(**prm)


def _put_on_warp(mj_model: mujoco.MjModel) -> mjx.Model:
  """The model on Warp, without its messages on loading kernels, and on solvers and buffers at their limits.

  Few solver iterations are what these tasks ask for, and one line for each solve is slower than the solve. Buffers that
  are too small are in `PhysicsData.buffers`, which the trainers count.
  """
  quiet_warp()
  model = mjx.put_model(mj_model, _device(), impl="warp")
  return model.tree_replace({"opt._impl.warn_overflow": 0})  # pyright: ignore[reportReturnType]


def _buffer_use(data: mjx.Data) -> BufferUse:
  from mujoco.mjx.third_party.mujoco_warp import OverflowType

  impl: Any = data._impl
  iterations = int(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)  # reached often, and meant to be
  contacts = jnp.maximum(impl.nacon, impl.ncollision).reshape(())
  return BufferUse(impl.nefc.reshape(()), contacts, impl.overflow.reshape(()) & ~iterations)
