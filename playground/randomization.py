"""Domain randomisation: the events of a task that draw fields of its model.

Such an event names the entries of a model field, the operation, and the distribution:

```yaml
events:
  link_masses:
    mode: startup
    func: model_field
    params: {field: body_mass, target: all, operation: scale, range: [0.9, 1.1]}
```

Those of mode `startup` are drawn once an environment and become model fields with a batch axis; those of mode `reset`
are drawn in each episode (`playground.envs.task`), on top of the environment's own model. They apply in order, each to
the result of those before. Lights, cameras, colours and materials are fields like any others (docs/vision.md). What
sensors and contacts need follows: `body_subtreemass` from masses, `geom_rbound` and `geom_aabb` from sizes. Other
derived fields (`dof_invweight0`, `body_invweight0`, `dof_M0`) keep their nominal values, as in Playground 0.2.0.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src.math import quat_mul, rotate

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.mdp.events import ModelField
from playground.mdp.options import MODEL_FIELD, is_model_field
from playground.mdp.terms import bind_one
from playground.text import format_value

# The kind of object that has a row in a field, by the prefix of the field's name.
_PREFIXES = {"cam": "camera", "mat": "material", "jnt": "joint", "dof": "joint", "qpos": "joint"}
_PREFIXES |= {name: name for name in ("geom", "body", "site", "actuator", "tendon", "pair", "light")}
_COUNTERS = {"actuator": "nu", "dof": "njnt", "qpos": "njnt"}  # of objects, where it is not n<prefix>
# Quantities in several fields: (field, column, sign) of each. A servo pulls with gain * ctrl + bias * q, so its
# position gain is in both with opposite signs; a body that is denser has more inertia in proportion.
_LINKED: dict[str, tuple[tuple[str, int | None, float], ...]] = {
  "actuator_kp": (("actuator_gainprm", 0, 1.0), ("actuator_biasprm", 1, -1.0)),
  "body_density": (("body_mass", None, 1.0), *(("body_inertia", axis, 1.0) for axis in range(3))),
}
_SCALED_ONLY = ("body_density",)
_NOT_NEGATIVE = ("body_mass", "body_inertia", "geom_friction", "pair_friction", "dof_damping", "dof_armature")
_NOT_NEGATIVE += ("dof_frictionloss",)
# Fields that act only on rows for which the model has another field on.
_SWITCHES = {
  "jnt_range": "jnt_limited",
  "jnt_actfrcrange": "jnt_actfrclimited",
  "tendon_range": "tendon_limited",
  "tendon_actfrcrange": "tendon_actfrclimited",
  "actuator_ctrlrange": "actuator_ctrllimited",
  "actuator_forcerange": "actuator_forcelimited",
  "actuator_actrange": "actuator_actlimited",
}
# Fields that MuJoCo's compiler derives from another one, and that follow its draws.
_DERIVED = {"body_mass": ("body_subtreemass",), "geom_size": ("geom_rbound", "geom_aabb")}
_TURNS = ("quat", "_axis", "_dir", "_pos")  # ends of the names of fields of directions, quaternions and places

_KINDS = ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
_PRIMITIVES = tuple(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}") for kind in _KINDS)

_OPERATIONS: dict[str, Callable[[jax.Array, jax.Array], jax.Array]] = {
  "set": lambda nominal, draw: jnp.broadcast_to(draw, nominal.shape),
  "scale": lambda nominal, draw: nominal * draw,
  "add": lambda nominal, draw: nominal + draw,
  "rotate": lambda nominal, draw: jax.vmap(_turn)(nominal, draw),
}
_DISTRIBUTIONS: dict[str, Callable[[jax.Array, tuple[int, ...], float, float], jax.Array]] = {
  "uniform": lambda key, shape, lo, hi: jax.random.uniform(key, shape, minval=lo, maxval=hi),
  "log_uniform": lambda key, shape, lo, hi: jnp.exp(_DISTRIBUTIONS["uniform"](key, shape, math.log(lo), math.log(hi))),
  "normal": lambda key, shape, mean, std: mean + std * jax.random.normal(key, shape),
  "bernoulli": lambda key, shape, mean, _: jax.random.bernoulli(key, mean, shape),
}


class _Slot(NamedTuple):
  """Entries of a field that a term changes: `field[index]`, times `sign`."""

  field: str
  index: tuple[np.ndarray, ...]
  sign: float


class _Draw(NamedTuple):
  """A term on a model: the `shape` of its draw, and the `slots` that it changes."""

  term: ModelField
  slots: tuple[_Slot, ...]
  shape: tuple[int, ...]

  @property
  def count(self) -> int:
    return 1 if self.term.shared else math.prod(self.shape)

  def __call__(self, key: jax.Array) -> jax.Array:
    # One flat draw, a scalar if single: the order and shapes of Playground 0.2.0, so that the numbers are the same.
    rotates, scalar = self.term.operation == "rotate", self.count == 1
    key, axis_key = jax.random.split(key) if rotates else (key, key)
    draw = _DISTRIBUTIONS[self.term.distribution](key, () if scalar else (self.count,), *self.term.parameters)
    draw = draw if scalar else draw.reshape(self.shape)
    if not rotates:
      return draw
    shape = (*(() if self.term.shared else self.shape), 3)
    if self.term.axis is None:
      axes = jax.random.normal(axis_key, shape)
    else:
      low, high = jnp.array(self.term.axis, jnp.float32).T
      axes = jax.random.uniform(axis_key, shape, minval=low, maxval=high)
    axes = axes / jnp.linalg.norm(axes, axis=-1, keepdims=True)
    return jnp.broadcast_to(jnp.asarray(draw)[..., None] * axes, (*self.shape, 3))


class Randomizer:
  """Draws model fields for environments.

  Attributes:
    fields: names of the `mjx.Model` fields that any term touches, in order of first use, then of those that follow.
  """

  def __init__(
    self,
    mj_model: mujoco.MjModel,
    events: Mapping[str, Any],
    mode: str = "startup",
    impl: str = "jax",
    in_c: bool = False,
  ):
    """Binds those of `env.events` of func `model_field` and this mode to a model, whose values are the nominal ones.

    Raises ConfigError for an event that does not fit the model, or whose change the simulator ignores: the physics
    backend `impl`, or with `in_c` C MuJoCo, in which policies of either backend are played.
    """
    terms = model_fields(events, mode)
    self._draws = {name: _bind(mj_model, term, f"env.events.{name}.params") for name, term in terms.items()}
    touched = list(dict.fromkeys(slot.field for draw in self._draws.values() for slot in draw.slots))
    derived = (name for field in touched for name in _DERIVED.get(field, ()))
    self.fields: tuple[str, ...] = tuple(dict.fromkeys([*touched, *derived]))
    self._nominal = {field: np.array(getattr(mj_model, field)) for field in self.fields}
    if "body_mass" in touched:
      self._carried = _carried(mj_model)
    if "geom_size" in touched:
      self._geom_types = np.array(mj_model.geom_type)
      if impl == "warp":
        self._nominal["geom_aabb"] = self._nominal["geom_aabb"].reshape(-1, 2, 3)
    spans = {field: [self._nominal[field]] * 2 for field in touched}  # least and greatest values so far
    for name, draw in self._draws.items():
      for slot in draw.slots:
        if reason := _acts_not(mj_model, draw.term, slot, "c" if in_c else impl):
          raise ConfigError(f"env.events.{name}: {reason}.")
        if slot.field in _NOT_NEGATIVE:
          spans[slot.field] = _span_after(spans[slot.field], draw.term, slot, f"env.events.{name}.params")

  def sample(self, key: jax.Array, model: mjx.Model | None = None) -> dict[str, jax.Array]:
    """Draws one environment's fields, each whole and in its model shape. Pure: jit and vmap freely.

    The events change the fields of `model`, which may be randomised already; without it the nominal values.
    """
    start = self._nominal if model is None else {field: getattr(model, field) for field in self.fields}
    values = {field: jnp.asarray(value) for field, value in start.items()}
    for draw in self._draws.values():
      key, draw_key = jax.random.split(key)
      drawn, operation = draw(draw_key), _OPERATIONS[draw.term.operation]
      for field, index, sign in draw.slots:
        new = sign * operation(sign * values[field][index], drawn)
        values[field] = values[field].at[index].set(new.astype(values[field].dtype))
    if "body_mass" in values:
      values["body_subtreemass"] = (self._carried * values["body_mass"]).sum(-1)
    if "geom_size" in values:
      values |= _bounds(self._geom_types, values["geom_size"], values["geom_rbound"], values["geom_aabb"])
    return values

  def sample_batch(self, keys: jax.Array) -> dict[str, jax.Array]:
    """Draws N environments' fields from keys [N]: each field gets a leading axis N."""
    return jax.vmap(self.sample)(keys)

  def without_nominal(self) -> list[str]:
    """Returns a sentence for each term that sets values in a range in which the nominal ones are not."""
    found = []
    for name, draw in self._draws.items():
      if draw.term.operation == "set" and draw.term.range:
        low, high = draw.term.range
        nominal = np.concatenate([np.ravel(slot.sign * self._nominal[slot.field][slot.index]) for slot in draw.slots])
        if others := sorted({f"{value:g}" for value in nominal if not low <= value <= high}):
          found.append(f"env.events.{name} draws {low:g} to {high:g}, and the nominal model has {', '.join(others)}.")
    return found


def model_fields(events: Mapping[str, Any] | None, mode: str = "startup") -> dict[str, ModelField]:
  """Returns the enabled events of func `model_field` and a mode by name, checked as far as possible without a model."""
  found = {}
  for name, entry in (events or {}).items():
    if entry is None or not is_model_field(name, entry):
      continue
    key = f"env.events.{name}"
    term = bind_one("events", key, name, entry)
    if term.options.mode not in ("startup", "reset"):
      raise ConfigError(f"{key}.mode={term.options.mode} must be startup or reset: func {MODEL_FIELD} has these two.")
    field = term()
    field.check(f"{key}.params")
    if term.options.mode == mode and term.options.enabled:
      found[name] = field
  return found


def domain_randomizer(
  mj_model: mujoco.MjModel, events: Mapping[str, Any], impl: str = "jax"
) -> Callable[[mjx.Model, jax.Array], tuple[mjx.Model, mjx.Model]]:
  """Returns Playground 0.2.0's kind of randomizer, for Brax's wrappers.

  The callable maps `(mjx_model, rng[N])` to `(model, in_axes)`: the model with a leading axis N on every randomised
  field, and the same structure with 0 at those fields and None elsewhere, for `jax.vmap`.
  """
  randomizer = Randomizer(mj_model, events, impl=impl)

  def randomize(mjx_model: mjx.Model, rng: jax.Array) -> tuple[mjx.Model, mjx.Model]:
    in_axes: Any = jax.tree.map(lambda _: None, mjx_model)
    fields: Any = randomizer.sample_batch(rng)
    model: Any = mjx_model.tree_replace(fields)
    return model, in_axes.tree_replace(dict.fromkeys(randomizer.fields, 0))

  return randomize


def _bind(mj_model: mujoco.MjModel, term: ModelField, key: str) -> _Draw:
  """Finds the entries of the model that a term changes."""
  fields = [*_randomizable(mj_model), *_LINKED]
  if term.field not in fields:
    raise UnknownNameError(
      f"{key}.field {term.field!r} is no field of the model that can be randomised.{nearest(str(term.field), fields)}"
    )
  rows = _rows(mj_model, term, key)
  _check_kind(mj_model, term, key)
  if term.field in _LINKED:
    if term.column is not None:
      shown = f"{key}.column={format_value(term.column)}"
      raise ConfigError(f"{shown}: field {term.field!r} has no columns, leave the key out.")
    if term.field in _SCALED_ONLY and term.operation != "scale":
      raise ConfigError(f"{key}.operation={term.operation!r}: field {term.field!r} can only be scaled.")
    if term.field == "actuator_kp" and (mj_model.actuator_biasprm[rows, 1] >= 0).any():
      raise ConfigError(f"{key}.field 'actuator_kp' is of position servos, which not all of these actuators are.")
    index = lambda column: (rows,) if column is None else (rows, np.array(column))
    slots = tuple(_Slot(field, index(column), sign) for field, column, sign in _LINKED[term.field])
    return _Draw(term, slots, (len(rows),))
  shape = getattr(mj_model, term.field).shape
  width = shape[1] if len(shape) == 2 else 0
  columns = np.atleast_1d(np.arange(width) if term.column is None else term.column)
  if (columns >= width).any():
    allowed = f"columns 0 to {width - 1}" if width else "no columns, leave the key out"
    raise ConfigError(f"{key}.column={format_value(term.column)}: field {term.field!r} has {allowed}.")
  index = np.ix_(rows, columns) if width else (rows,)
  drawn = (len(rows),) if term.operation == "rotate" or not width else (len(rows), len(columns))
  return _Draw(term, (_Slot(term.field, index, 1.0),), drawn)


def _check_kind(mj_model: mujoco.MjModel, term: ModelField, key: str) -> None:
  """Raises ConfigError where an operation or distribution does not fit the field."""
  values = getattr(mj_model, term.field, None)
  is_switch = values is not None and values.dtype == bool
  if is_switch != (term.distribution == "bernoulli") or (is_switch and term.operation != "set"):
    needs = "is a switch: it needs operation set, distribution bernoulli" if is_switch else "is no switch"
    raise ConfigError(f"{key}: field {term.field!r} {needs}, not {term.operation} and {term.distribution}.")
  turns = values is not None and term.field.endswith(_TURNS) and values.ndim == 2 and term.column is None
  if term.operation == "rotate" and not turns:
    raise ConfigError(f"{key}.operation='rotate' needs a whole field of directions or quaternions, not {term.field!r}.")


def _span_after(span: list[np.ndarray], term: ModelField, slot: _Slot, key: str) -> list[np.ndarray]:
  """Returns the least and greatest values of a field after a term, of a normal draw those of its mean.

  Raises:
    ConfigError: a quantity like a mass can be below 0.
  """
  name, ends = ("range", term.range) if term.range else ("mean", (term.mean,))
  change = _OPERATIONS[term.operation]
  results = [np.asarray(change(jnp.asarray(bound[slot.index]), jnp.asarray(end))) for bound in span for end in ends]
  if (lowest := min(float(result.min()) for result in results)) < 0:
    shown = f"{key}.{name}={format_value(getattr(term, name))}"
    raise ConfigError(f"{shown}: {term.operation} gives {term.field} {lowest:g}, but it is never negative.")
  after = [bound.copy() for bound in span]
  after[0][slot.index], after[1][slot.index] = np.min(results, 0), np.max(results, 0)
  return after


def _acts_not(mj_model: mujoco.MjModel, term: ModelField, slot: _Slot, impl: str) -> str:
  """Returns why the simulator would ignore a change, and the remedy; '' where it acts."""
  field, rows = slot.field, np.ravel(slot.index[0])
  others, named = f"train with env.impl={'jax' if impl == 'warp' else 'warp'}", format_value(term.target)
  if (switch := _SWITCHES.get(field)) and not getattr(mj_model, switch)[rows].any():
    return f"{field} acts on nothing, since {switch} is off in the model: give {named} a range in the MJCF"
  if field == "body_gravcomp" and not mj_model.ngravcomp:
    return "body_gravcomp acts on nothing, since the model has none: give a body some in the MJCF"
  if field == "geom_size" and not np.isin(mj_model.geom_type[rows], _PRIMITIVES).all():
    return "geom_size acts on spheres, capsules, cylinders, ellipsoids and boxes alone: name those in params.target"
  if field in ("body_pos", "body_quat") and 0 in rows:
    return f"{field} would move the world: name the bodies in params.target"
  from_0 = field in ("dof_frictionloss", "tendon_frictionloss") and term.operation != "scale"
  if from_0 and impl == "jax" and (getattr(mj_model, field)[rows] == 0).any():
    return f"MJX on JAX leaves out friction that is 0 in the model: give {named} some in the MJCF, or {others}"
  if impl == "warp" and _is_static(mj_model, slot):
    return f"MuJoCo-Warp does not move what is fixed to the world: leave out {named}, or {others}"
  return ""


def _is_static(mj_model: mujoco.MjModel, slot: _Slot) -> bool:
  """Whether a slot places a body or geom that is fixed to the world, which MuJoCo-Warp does once, when it starts."""
  kind, _, what = slot.field.partition("_")
  if kind not in ("body", "geom") or what not in ("pos", "quat"):
    return False
  bodies = np.ravel(slot.index[0]) if kind == "body" else mj_model.geom_bodyid[np.ravel(slot.index[0])]
  return bool(((mj_model.body_weldid[bodies] == 0) & (mj_model.body_mocapid[bodies] < 0)).any())


def _carried(mj_model: mujoco.MjModel) -> np.ndarray:
  """Returns which bodies each body carries, itself included, [nbody, nbody] of 0 and 1."""
  carried = np.eye(mj_model.nbody, dtype=np.float32)
  for body in range(mj_model.nbody - 1, 0, -1):
    carried[mj_model.body_parentid[body]] += carried[body]
  return carried


def _bounds(types: np.ndarray, size: jax.Array, rbound: jax.Array, aabb: jax.Array) -> dict[str, jax.Array]:
  """Returns the spheres and boxes about geoms of these sizes, [ngeom, 3]; those of planes and meshes stay."""
  sphere, capsule, ellipsoid, cylinder, box = (types == kind for kind in _PRIMITIVES)
  x, second, third = size.T
  y = jnp.where(ellipsoid | box, second, x)
  z = jnp.where(sphere, x, jnp.where(capsule, x + second, jnp.where(cylinder, second, third)))
  half = jnp.stack([x, y, z], -1)
  radius = jnp.where(box, jnp.linalg.norm(half, axis=-1), jnp.where(cylinder, jnp.hypot(x, z), half.max(-1)))
  primitive = np.isin(types, _PRIMITIVES)
  boxes = jnp.concatenate([jnp.zeros_like(half), half], -1).reshape(aabb.shape)
  return {
    "geom_rbound": jnp.where(primitive, radius, rbound),
    "geom_aabb": jnp.where(primitive.reshape(-1, *[1] * (aabb.ndim - 1)), boxes, aabb),
  }


def _turn(row: jax.Array, by: jax.Array) -> jax.Array:
  """Turns a direction [3] or quaternion [4] by a rotation vector, rad, in the same frame."""
  angle = jnp.linalg.norm(by)
  half = jnp.concatenate([jnp.cos(angle / 2)[None], jnp.sinc(angle / (2 * jnp.pi)) / 2 * by])
  return rotate(row, half) if len(row) == 3 else quat_mul(half, row)


def _randomizable(mj_model: mujoco.MjModel) -> list[str]:
  """Fields of numbers or switches that are arrays (not constants) of an `mjx.Model`, with a row per object."""
  fields = dataclasses.fields(mjx.Model)  # pyright: ignore[reportArgumentType]  # MJX's own dataclass decorator
  names = [field.name for field in fields if field.type in (jax.Array, "jax.Array")]
  arrays = {name: getattr(mj_model, name, None) for name in names if _prefix(name) in _PREFIXES}
  return [n for n, a in arrays.items() if isinstance(a, np.ndarray) and a.dtype.kind in "fb" and a.ndim in (1, 2)]


def _prefix(field: str) -> str:
  return field.split("_")[0].removesuffix("0")


def _rows(mj_model: mujoco.MjModel, term: ModelField, key: str) -> np.ndarray:
  """Returns the rows of a term's field that belong to its target."""
  prefix = _prefix(term.field)
  kind, count = _PREFIXES[prefix], getattr(mj_model, _COUNTERS.get(prefix, f"n{prefix}"))
  starts, end = np.arange(count), count
  if prefix in ("dof", "qpos"):  # a joint has as many rows as it has degrees of freedom, or coordinates
    starts = getattr(mj_model, f"jnt_{prefix}adr")
    end = mj_model.nv if prefix == "dof" else mj_model.nq
  spans = [range(a, b) for a, b in pairwise([*starts.tolist(), end])]
  if term.target == "all":
    chosen = spans
  elif term.target == "joints":
    if kind != "joint":
      raise ConfigError(f"{key}.target='joints' needs a field of joints (jnt_*, dof_*, qpos*), not {term.field!r}.")
    chosen = [s for s, t in zip(spans, mj_model.jnt_type, strict=True) if t != mujoco.mjtJoint.mjJNT_FREE]
  else:
    ids = {name: i for i in range(count) if (name := getattr(mj_model, kind)(i).name)}
    targets = [term.target] if isinstance(term.target, str) else list(dict.fromkeys(term.target))
    for name in targets:
      if name not in ids:
        raise UnknownNameError(f"{key}.target {name!r} is no {kind} of the model.{nearest(str(name), ids)}")
    chosen = [spans[ids[name]] for name in targets]
  rows = np.array([row for span in chosen for row in span], dtype=np.int32)
  if not rows.size:
    raise ConfigError(f"{key}.target={term.target!r} names nothing that field {term.field!r} has.")
  return rows
