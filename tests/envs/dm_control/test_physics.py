"""Every domain's physics equals that of the `dm_control` package's own model, after the documented changes to it.

The changes are those of Playground's models (paper, appendix "DM Control", table of XML modifications); what is not in
the table has to be the same. Both models run in C MuJoCo.
"""

import dataclasses
import importlib
import sys
import warnings
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import mjtCone, mjtDisableBit, mjtIntegrator, mjtJoint

from tests.envs.dm_control.suite import DOMAIN, FIGURES
from tests.envs.golden import load_task

pytestmark = pytest.mark.skipif(sys.version_info >= (3, 13), reason="dm_control has no wheels for it (labmaze)")


def _nothing(spec: mujoco.MjSpec) -> None:
  pass


@dataclasses.dataclass(frozen=True)
class Changes:
  """What Playground changes in a model of `dm_control`; None leaves as it is. `eulerdamp` is disabled in all.

  Attributes:
    iterations: of the solver.
    ls_iterations: of its line search.
    timestep: s.
    integrator: of time.
    cone: of friction.
    disable: flags besides `eulerdamp`.
    edit: everything else that acts on the dynamics.
  """

  iterations: int
  ls_iterations: int
  timestep: float | None = None
  integrator: mjtIntegrator | None = None
  cone: mjtCone | None = None
  disable: int = 0
  edit: Callable[[mujoco.MjSpec], None] = _nothing


def _finger(spec: mujoco.MjSpec) -> None:
  spec.joint("hinge").damping[0] = 0.03  # FingerSpin's, in both packages set by the task
  for name in ("proximal_decoration", "spinner_decoration"):
    spec.geom(name).contype = spec.geom(name).conaffinity = 0


def _fish(spec: mujoco.MjSpec) -> None:
  massive = spec.geom("torso_massive")
  massive.type, massive.size = mujoco.mjtGeom.mjGEOM_SPHERE, [0.03, 0, 0]


CHANGES = {
  "acrobot": Changes(2, 4, integrator=mjtIntegrator.mjINT_EULER),
  "ball_in_cup": Changes(1, 4),
  "cartpole": Changes(1, 4, integrator=mjtIntegrator.mjINT_EULER),
  "cheetah": Changes(4, 8),
  "finger": Changes(
    2, 8, 0.005, mjtIntegrator.mjINT_IMPLICITFAST, mjtCone.mjCONE_PYRAMIDAL, edit=_finger,
  ),
  "fish": Changes(2, 6, 0.002, disable=mjtDisableBit.mjDSBL_CONTACT, edit=_fish),
  "hopper": Changes(4, 10),
  "humanoid": Changes(4, 8),
  "pendulum": Changes(4, 8, 0.01),
  "point_mass": Changes(1, 4),
  "reacher": Changes(1, 6, 0.005),
  "swimmer": Changes(4, 8, 0.003),
  "walker": Changes(2, 5),
}  # fmt: skip


def reference(domain: str) -> mujoco.MjModel:
  """The package's own model with the documented changes."""
  changes = CHANGES[domain]
  with warnings.catch_warnings(category=UserWarning, action="ignore"):  # no display, deprecated settotalmass
    module: Any = importlib.import_module(f"dm_control.suite.{domain}")
    xml, assets = module.get_model_and_assets(*((6,) if domain == "swimmer" else ()))
    spec = mujoco.MjSpec.from_string(xml if isinstance(xml, str) else xml.decode(), include=assets)
    for name in ("iterations", "ls_iterations", "timestep", "integrator", "cone"):
      if getattr(changes, name) is not None:
        setattr(spec.option, name, getattr(changes, name))
    spec.option.disableflags |= changes.disable | mjtDisableBit.mjDSBL_EULERDAMP
    spec.option.enableflags = 0  # `energy`: it is computed and acts on nothing
    changes.edit(spec)
    return spec.compile()


@dataclasses.dataclass
class Pair:
  """Our model and the package's, of one domain."""

  domain: str
  ours: mujoco.MjModel
  theirs: mujoco.MjModel


@pytest.fixture(params=FIGURES, scope="module")
def pair(request: pytest.FixtureRequest) -> Pair:
  task = next(task for task, domain in DOMAIN.items() if domain == request.param)
  return Pair(request.param, load_task(task).mj_model, reference(request.param))


def test_the_same_joints_and_actuators(pair: Pair) -> None:
  names = lambda model, kind, count: [getattr(model, kind)(i).name for i in range(count)]
  for kind, count in (("joint", pair.ours.njnt), ("actuator", pair.ours.nu)):
    assert names(pair.ours, kind, count) == names(pair.theirs, kind, count)
  assert (pair.ours.nq, pair.ours.nv, pair.ours.nu) == (pair.theirs.nq, pair.theirs.nv, pair.theirs.nu)


def test_the_same_options(pair: Pair) -> None:
  options = [name for name in dir(pair.ours.opt) if not name.startswith("_")]
  for name in options:
    np.testing.assert_array_equal(getattr(pair.ours.opt, name), getattr(pair.theirs.opt, name), err_msg=name)


def state(model: mujoco.MjModel, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """A random pose (a little beyond the joints' limits, on, above or in the ground), velocity and control."""
  qpos = np.empty(model.nq)
  for joint in range(model.njnt):
    adr, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
    if kind == mjtJoint.mjJNT_FREE:
      qpos[adr : adr + 3] = rng.uniform(0, 1.5, 3)
      qpos[adr + 3 : adr + 7] = rng.normal(size=4)
      qpos[adr + 3 : adr + 7] /= np.linalg.norm(qpos[adr + 3 : adr + 7])
    elif kind == mjtJoint.mjJNT_SLIDE and not model.jnt_limited[joint]:
      qpos[adr] = rng.uniform(-0.4, 0.4)
    else:
      qpos[adr] = rng.uniform(low - 0.1 * (high - low), high + 0.1 * (high - low))
  return qpos, rng.normal(size=model.nv), rng.uniform(-1.2, 1.2, model.nu)


def forward(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray, ctrl: np.ndarray) -> mujoco.MjData:
  data = mujoco.MjData(model)
  data.qpos, data.qvel, data.ctrl = qpos, qvel, ctrl
  mujoco.mj_forward(model, data)
  return data


def test_the_same_accelerations_and_sensors(pair: Pair) -> None:
  rng = np.random.default_rng(0)
  constrained = 0
  for _ in range(100):
    at = state(pair.ours, rng)
    ours, theirs = forward(pair.ours, *at), forward(pair.theirs, *at)
    constrained += ours.nefc > 0
    assert (ours.ncon, ours.nefc) == (theirs.ncon, theirs.nefc)
    largest = max(1.0, np.abs(theirs.qacc).max())
    np.testing.assert_allclose(ours.qacc, theirs.qacc, rtol=0, atol=1e-6 * largest)
    for i in range(pair.ours.nsensor):
      name = pair.ours.sensor(i).name
      np.testing.assert_allclose(ours.sensor(name).data, theirs.sensor(name).data, atol=1e-6 * largest, err_msg=name)
  off = pair.ours.opt.disableflags
  contacts = not off & (mjtDisableBit.mjDSBL_CONTACT | mjtDisableBit.mjDSBL_CONSTRAINT)
  limits = pair.ours.jnt_limited.any() and not off & mjtDisableBit.mjDSBL_CONSTRAINT
  assert constrained >= 10 or not (contacts or limits)
