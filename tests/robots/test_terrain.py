"""Terrains: their shape, where robots start on them, and contacts with them in MJX."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml

from playground import registry
from playground.config import compose
from playground.errors import ConfigError
from playground.physics.backend import mjx
from playground.robots.scene import ROBOTS, build_scene
from playground.robots.terrain import HALF_EXTENT, POINTS, START, add_terrain

ROBOT_NAMES = sorted(path.stem for path in ROBOTS.glob("*/*.xml") if path.stem == path.parent.name)


def heights(terrain: str, **parameters: Any) -> np.ndarray:
  """World heights (m) of the terrain's points, shape [along y, along x]."""
  spec = mujoco.MjSpec()
  peak = add_terrain(spec, terrain, parameters)
  model = spec.compile()
  assert model.geom(0).name == "floor"
  np.testing.assert_allclose(model.hfield_size[0, :2], HALF_EXTENT)
  grid = model.hfield_data.reshape(POINTS, POINTS) * model.hfield_size[0, 2] + model.geom_pos[0, 2]
  np.testing.assert_allclose(grid[distance() <= START].max(), peak, atol=1e-6)
  return grid


def distance() -> np.ndarray:
  axis = np.abs(np.linspace(-HALF_EXTENT, HALF_EXTENT, POINTS))
  return np.maximum(axis[:, None], axis)


def correlation(grid: np.ndarray) -> float:
  """Of neighbouring points."""
  return float(np.corrcoef(grid[:, 1:].ravel(), grid[:, :-1].ravel())[0, 1])


@pytest.mark.parametrize("terrain", ["rough", "white_noise"])
def test_noise_is_seeded_and_in_range(terrain: str) -> None:
  grid = heights(terrain)
  np.testing.assert_array_equal(grid, heights(terrain))
  assert abs(np.corrcoef(grid.ravel(), heights(terrain, seed=1).ravel())[0, 1]) < 0.1
  np.testing.assert_allclose([grid.min(), grid.max()], [0, 0.05], atol=1e-7)
  np.testing.assert_allclose(heights(terrain, elevation=0.2), 4 * grid, atol=1e-6)


def test_white_noise_has_the_statistics_of_the_figures() -> None:
  """Mean, deviation and range of the reference's heights, and no correlation of neighbours."""
  data = heights("white_noise") / 0.05
  np.testing.assert_allclose([data.mean(), data.std()], [0.498532092, 0.289956704], atol=5e-3)
  assert abs(correlation(data)) < 0.01


def test_perlin_noise_is_smooth_and_its_wavelength_counts() -> None:
  fine, broad = heights("rough"), heights("rough", wavelength=4.0, octaves=1)
  assert 0.7 < correlation(fine) < correlation(broad)
  assert correlation(broad) > 0.99
  corners = np.linspace(0, POINTS - 1, 6).round().astype(int)  # one layer is 0 at the corners of its cells
  layer = heights("rough", wavelength=4.0, octaves=1)[np.ix_(corners, corners)]
  np.testing.assert_allclose(layer, layer[0, 0], atol=1e-6)


@pytest.mark.parametrize("sign", [1, -1])
def test_stairs_rise_ring_by_ring_about_a_flat_platform(sign: int) -> None:
  grid = heights("stairs", step_height=sign * 0.15, step_width=0.5, platform=3.0)
  steps = sign * grid / 0.15
  np.testing.assert_allclose(steps, steps.round(), atol=1e-5)
  assert not grid[distance() < 1.5].any()
  along = steps[POINTS // 2, POINTS // 2 :].round()
  assert set(np.diff(along)) == {0, 1} and along[-1] == 17
  np.testing.assert_allclose(grid, grid.T, atol=1e-6)


@pytest.mark.parametrize("gradient", [0.3, -0.3])
def test_slope_has_its_gradient_beyond_the_platform(gradient: float) -> None:
  grid = heights("slope", gradient=gradient)
  np.testing.assert_allclose(grid, gradient * np.maximum(distance() - 1.0, 0), atol=1e-5)


def depth(robot: str, terrain: str, **parameters: Any) -> float:
  """How deep (m) feet are in the ground at most, at keyframes all over the area where robots start."""
  model = build_scene(robot, terrain=terrain, parameters=parameters).compile()
  keyframe = yaml.safe_load((ROBOTS.parents[1] / f"configs/robot/{robot}.yaml").read_text())["keyframe"]
  data, result = mujoco.MjData(model), [0.0]
  for i, j in np.ndindex(4, 4):
    mujoco.mj_resetDataKeyframe(model, data, model.key(keyframe).id)
    data.qpos[:2] = i / 3 - 0.5, j / 3 - 0.5
    mujoco.mj_forward(model, data)
    result += [-contact.dist for contact in data.contact if 0 in contact.geom]
  return max(result)


@pytest.mark.parametrize("robot", ROBOT_NAMES)
def test_no_robot_starts_in_the_ground(robot: str) -> None:
  """Feet are no deeper than on flat ground, but for 5 mm, whatever the height of the bumps; stairs start flat."""
  flat = depth(robot, "flat")
  assert flat < 0.02
  assert depth(robot, "rough") < flat + 5e-3
  assert depth(robot, "rough", elevation=0.2) < flat + 5e-3
  np.testing.assert_allclose(depth(robot, "stairs"), flat, atol=1e-3)


def test_cylinders_of_the_full_collision_variants_stand_on_height_fields() -> None:
  """MJX on JAX would refuse them."""
  flat, rough = (build_scene("go1", terrain=t, collision="full_self").compile() for t in ("flat", "rough"))
  mjx.put_model(rough, impl="jax")
  np.testing.assert_array_equal(flat.body_mass, rough.body_mass)
  types = rough.geom_type[(rough.geom_contype | rough.geom_conaffinity) != 0]
  assert mujoco.mjtGeom.mjGEOM_CYLINDER not in types


@pytest.mark.parametrize(
  ("terrain", "parameters", "message"),
  [
    ("rogh", {}, r"env\.scene\.terrain: 'rogh' is unknown; choose from flat, .*Did you mean 'rough'\?"),
    ("stairs", {"step_hight": 1}, r"terrain_params\.step_hight does not exist: stairs .*Did you mean 'step_height'\?"),
    ("flat", {"seed": 1}, r"env\.scene\.terrain_params\.seed does not exist: flat takes no parameters"),
    ("stairs", {"step_height": 0}, "no heights: choose terrain=flat"),
    ("slope", {"platform": 0}, r"terrain_params\.platform=0 must be a number above 0"),
    (
      "rough",
      {"octaves": 14},
      r"octaves=14 from wavelength=0\.5 m on are finer than the 256 points of the height field",
    ),
    ("rough", {"wavelength": 1e-6, "octaves": 1}, "octaves=1 from wavelength=1e-06 m on are finer"),
    ("rough", {"wavelength": -1.0}, r"terrain_params\.wavelength=-1\.0 must be a number above 0"),
  ],
)
def test_refusals(terrain: str, parameters: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message) as error:
    build_scene("go1", terrain=terrain, parameters=parameters)
  assert "\n" not in str(error.value)


# On the command line


def ground(*overrides: str) -> mujoco.MjModel:
  return registry.build(compose(["env=joystick", "robot=go1", *overrides]).env).mj_model


def test_terrain_is_chosen_by_its_short_name() -> None:
  model = ground("terrain=stairs", "env.scene.terrain_params={step_height: 0.05}")
  assert model.geom_type[0] == mujoco.mjtGeom.mjGEOM_HFIELD
  np.testing.assert_allclose(model.hfield_size[0, 2], 0.05 * 23)
  assert ground().geom_type[0] == mujoco.mjtGeom.mjGEOM_PLANE


def test_parameters_are_those_of_the_terrain() -> None:
  with pytest.raises(ConfigError, match=r"terrain_params\.step_height does not exist: rough takes"):
    ground("terrain=rough", "env.scene.terrain_params={step_height: 0.05}")


def test_0_2_0_takes_white_noise_for_rough() -> None:
  configs: list[Any] = [registry.config(f"{prefix}Go1JoystickRoughTerrain") for prefix in ("", "v020/")]
  assert [config.scene.terrain for config in configs] == ["rough", "white_noise"]
  assert np.any(heights("rough") != heights("white_noise"))


def test_a_terrain_of_no_use_to_the_task() -> None:
  with pytest.raises(ConfigError, match=r"env\.scene\.terrain does not exist"):
    compose(["env=CartpoleBalance", "terrain=rough"])


# Contacts

SHAPES = {"sphere": [0.03, 0, 0], "capsule": [0.03, 0.06, 0], "box": [0.08, 0.03, 0.01]}


def test_mjx_finds_the_contacts_of_c_mujoco() -> None:
  """Whether each kind of foot touches, what its sensor says, and how deep it is, at many places on bumps.

  Which of a foot's contacts is deepest is a matter of the algorithm where an edge of the ground is inside the foot.
  """
  spec = mujoco.MjSpec()
  add_terrain(spec, "rough", {"elevation": 0.2})
  for name, size in SHAPES.items():
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint()
    shape = getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}")
    body.add_geom(name=name, type=shape, size=size, contype=0, conaffinity=1)
    spec.add_sensor(
      name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=name,
      reftype=mujoco.mjtObj.mjOBJ_GEOM, refname="floor", intprm=[1, 1, 1],
    )  # fmt: skip
  model = spec.compile()
  device_model = mjx.put_model(model, impl="jax")
  template = mjx.make_data(model, impl="jax")
  rng = np.random.default_rng(0)
  qpos = np.zeros((32, 3, 7))
  qpos[..., :2] = rng.uniform(-3, 3, (32, 3, 2))
  qpos[..., 2] = rng.uniform(0.06, 0.14, (32, 3))
  qpos[..., 3:] = [1, 0, 0, 0]
  qpos = qpos.reshape(32, 21)

  @jax.jit
  @jax.vmap
  def in_mjx(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    data = mjx.forward(device_model, template.replace(qpos=qpos))
    contact: Any = data._impl.contact
    deepest = [jnp.min(contact.dist, where=contact.geom[:, 1] == i, initial=1.0) for i in (1, 2, 3)]
    return jnp.stack(deepest), data.sensordata

  theirs, sensors = map(np.asarray, in_mjx(qpos))
  data, ours = mujoco.MjData(model), np.ones((32, 3))
  for i in range(32):
    data.qpos = qpos[i]
    mujoco.mj_forward(model, data)
    for contact in data.contact:
      ours[i, contact.geom[1] - 1] = min(ours[i, contact.geom[1] - 1], contact.dist)
  touch = ours < 0
  assert 10 < touch.sum() < 86
  clear = np.abs(ours) > 5e-3
  np.testing.assert_array_equal((theirs < 0)[clear], touch[clear])
  np.testing.assert_array_equal((sensors > 0)[clear], touch[clear])
  assert np.mean(np.abs(theirs - ours)[touch] < 1e-3) > 0.8
  np.testing.assert_allclose(theirs[touch], ours[touch], atol=0.02)
