"""The meshes of Menagerie on our robots: drawn otherwise, simulated the same."""

import mujoco
import numpy as np
import pytest

from playground import registry
from playground.errors import ConfigError, HardwareError, UnknownNameError
from playground.rendering import visuals

# What a robot of Menagerie looks like: a mesh to be seen and one to collide with, with names that ours has, and others.
_GO1 = """
<mujoco model="go1">
  <compiler meshdir="assets"/>
  <default>
    <default class="visual"><geom type="mesh" group="2" contype="0" conaffinity="0" material="metal"/></default>
  </default>
  <asset>
    <material name="metal" rgba="0.1 0.2 0.3 1"/>
    <mesh file="trunk.obj" scale="2 2 2"/>
  </asset>
  <worldbody>
    <body name="trunk">
      <geom class="visual" mesh="trunk" pos="0.1 0 0"/>
      <geom type="mesh" mesh="trunk" group="3"/>
      <body name="somebody_else"><geom class="visual" mesh="trunk"/></body>
    </body>
  </worldbody>
</mujoco>
"""
_TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.fixture(scope="module")
def go1():
  return registry.load("Go1JoystickFlatTerrain")


@pytest.fixture
def menagerie(tmp_path, monkeypatch):
  """A checkout of Menagerie that has one robot."""
  folder = tmp_path / "unitree_go1"
  (folder / "assets").mkdir(parents=True)
  (folder / "go1.xml").write_text(_GO1)
  (folder / "assets" / "trunk.obj").write_text(_TETRAHEDRON)
  monkeypatch.setenv("MENAGERIE_ROOT", str(tmp_path))


def test_meshes_take_the_place_of_primitives(go1, menagerie):
  before, drawn = go1.mj_model, visuals.drawn_model(go1, "menagerie")
  trunk = drawn.body("trunk").id
  meshes = [g for g in range(drawn.ngeom) if drawn.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH]
  assert len(meshes) == 1 and drawn.geom_bodyid[meshes[0]] == trunk
  np.testing.assert_allclose(drawn.geom_rgba[meshes[0]], [0.1, 0.2, 0.3, 1], rtol=1e-6)
  assert drawn.mesh_vert.max() - drawn.mesh_vert.min() > 1.5  # scaled
  own = [g for g in range(drawn.ngeom) if drawn.geom_bodyid[g] == trunk and g not in meshes]
  assert all(drawn.geom_group[g] >= 3 for g in own), "the primitives of a dressed body are gone"
  hips = lambda model: (model.geom_bodyid == model.body("FR_hip").id).sum()
  assert hips(drawn) == hips(before), "a body without a mesh keeps its primitives"


def test_what_is_simulated_is_the_same(go1, menagerie):
  before, drawn = go1.mj_model, visuals.drawn_model(go1, "menagerie")
  assert (drawn.nq, drawn.nv, drawn.nu) == (before.nq, before.nv, before.nu)
  np.testing.assert_array_equal(drawn.body_mass, before.body_mass)
  np.testing.assert_array_equal(drawn.body_inertia, before.body_inertia)
  assert go1.mj_model.nmesh == 0, "the task's own model is untouched"


def test_primitives_are_the_tasks_own_model(go1):
  assert visuals.drawn_model(go1, "primitives") is go1.mj_model


def test_unknown_visuals(go1):
  with pytest.raises(UnknownNameError, match=r"video.visuals: 'menagery'.*Did you mean 'menagerie'"):
    visuals.drawn_model(go1, "menagery")


def test_a_task_whose_robot_is_not_in_menagerie():
  with pytest.raises(ConfigError, match=r"only apollo.*have meshes"):
    visuals.drawn_model(registry.load("CartpoleBalance"), "menagerie")


def test_meshes_out_of_reach(go1, tmp_path, monkeypatch):
  monkeypatch.setenv("MENAGERIE_ROOT", "")
  monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path))
  monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nowhere").as_uri())
  with pytest.raises(HardwareError, match="prefetch unitree_go1"):
    visuals.drawn_model(go1, "menagerie")


def test_a_robot_with_other_names(go1):
  source = mujoco.MjSpec.from_string("<mujoco><worldbody><body name='x'/></worldbody></mujoco>")
  with pytest.raises(ConfigError, match="no body of the robot"):
    visuals.dress(go1.spec.copy(), source)


@pytest.mark.parametrize("robot", visuals.MENAGERIE)
def test_every_robot_is_in_menagerie(robot):
  import mujoco_menagerie

  name, entry = visuals.MENAGERIE[robot]
  assert entry in mujoco_menagerie.get(name).entry_names
