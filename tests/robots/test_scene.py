"""Scenes: terrain, collision variants, contact sensors and their errors."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from playground.errors import ConfigError, UnknownNameError
from playground.robots.scene import COLLISIONS, build_scene, check_keys, find_mjcf
from playground.robots.terrain import add_terrain, ground_peak

LEG_GEOMS = ("hip", "thigh1", "thigh2", "thigh3", "calf1", "calf2")


def masks(model: mujoco.MjModel) -> dict[str, tuple[int, int, int]]:
  """contype, conaffinity and condim of every geom that can collide."""
  geoms = [model.geom(i) for i in range(model.ngeom)]
  values = {g.name: (int(g.contype[0]), int(g.conaffinity[0]), int(g.condim[0])) for g in geoms}
  return {name: value for name, value in values.items() if value[0] or value[1]}


def test_floor_is_geom_zero_and_decides_friction() -> None:
  model = build_scene("go1").compile()
  floor = model.geom(0)
  assert floor.name == "floor"
  assert floor.type[0] == mujoco.mjtGeom.mjGEOM_PLANE
  assert (floor.priority[0], floor.condim[0], floor.contype[0], floor.conaffinity[0]) == (1, 3, 1, 0)
  np.testing.assert_allclose(floor.friction, [0.6, 0.005, 0.0001])


def test_light_follows_the_robot() -> None:
  model = build_scene("go1").compile()
  assert model.light_targetbodyid[0] == model.body("trunk").id


@pytest.mark.parametrize(("collision", "contype"), [("full_floor", 0), ("full_self", 1)])
def test_full_collision(collision: str, contype: int) -> None:
  """Figures: go1_standard_flat (full_floor), go1_full_flat (full_self)."""
  model = build_scene("go1", collision=collision).compile()
  legs = {f"{leg}_{part}" for leg in ("fr", "fl", "rr", "rl") for part in LEG_GEOMS}
  expected = dict.fromkeys(legs | {"trunk_left", "trunk_right"}, (contype, 1, 1))
  assert masks(model) == expected | dict.fromkeys(("FR", "FL", "RR", "RL"), (contype, 1, 3)) | {"floor": (1, 0, 3)}
  assert bool(model.nnumeric) == (collision == "full_self")


@pytest.mark.parametrize("collision", ["full_floor", "full_self"])
def test_a_fallen_robot_rests_on_its_body(collision: str) -> None:
  """Without feet near the floor, the trunk carries it; with feet alone it would sink."""
  heights = {}
  for variant in ("feet", collision):
    model = build_scene("go1", collision=variant).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    data.qpos[2], data.qpos[3:7] = 0.3, [0, 1, 0, 0]  # on its back
    mujoco.mj_step(model, data, 500)
    heights[variant] = data.qpos[2]
  assert heights["feet"] < 0 < 0.03 < heights[collision] < 0.3


BALL = (
  '<mujoco><default><default class="full"><geom contype="0" conaffinity="0"/></default></default><worldbody>'
  '<body name="ball"><freejoint/><geom size="0.1"/><geom class="full" size="0.2"/></body></worldbody></mujoco>'
)


@pytest.mark.parametrize("mjcf", ["go1", BALL])
def test_collision_variants_leave_the_dynamics_alone(mjcf: str, tmp_path: Path) -> None:
  if mjcf == BALL:  # whose mass is that of its geoms
    mjcf = str(tmp_path / "ball.xml")
    Path(mjcf).write_text(BALL)
  models = [build_scene(mjcf, collision=name).compile() for name in COLLISIONS]
  for model in models[1:]:
    np.testing.assert_array_equal(model.body_mass, models[0].body_mass)
    np.testing.assert_array_equal(model.body_inertia, models[0].body_inertia)


def test_floor_contact_sensors_come_last_in_order() -> None:
  model = build_scene("go1", floor_contacts=["RL", "FR"]).compile()
  assert [model.sensor(i).name for i in range(model.nsensor)][-2:] == ["RL_floor_found", "FR_floor_found"]
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
  mujoco.mj_forward(model, data)
  assert (data.sensordata[-2:] > 0).all()
  data.qpos[2] = 1.0
  mujoco.mj_forward(model, data)
  assert not data.sensordata[-2:].any()


def test_floor_contact_sensors_come_before_those_of_the_robots_parts() -> None:
  """So that the order is the reference's, which recorded sensor readings have."""
  model = build_scene("t1", floor_contacts=["left_foot_1"]).compile()
  names = [model.sensor(i).name for i in range(model.nsensor)]
  assert names[-3:] == ["right_foot_pos", "left_foot_1_floor_found", "left_foot_right_foot_found"]


def test_a_robot_without_geoms_for_full_collisions() -> None:
  with pytest.raises(ConfigError, match=r"env\.scene\.collision=full_self: t1 has collision geoms for the feet only"):
    build_scene("t1", collision="full_self")


def test_a_robot_is_ours_or_in_a_file_or_in_a_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  ours = find_mjcf("spot")
  monkeypatch.chdir(tmp_path)  # a path of that form would come first
  assert ours.is_file() and find_mjcf("playground/robots/spot/spot.xml") == ours == find_mjcf(str(ours))
  other = tmp_path / "ball.xml"
  other.write_text(
    '<mujoco><worldbody><body name="ball"><freejoint/><geom name="skin" size="0.1" contype="0"/></body></worldbody>'
    "</mujoco>"
  )
  model = build_scene(str(other), floor_contacts=["skin"]).compile()
  assert (model.geom(0).name, model.sensor(0).name) == ("floor", "skin_floor_found")
  other.write_text(other.read_text().replace("<body", '<geom name="floor" type="plane" size="1 1 1"/><body'))
  with pytest.raises(ConfigError, match=r"ball\.xml has a geom named floor: remove it, the scene adds the ground"):
    build_scene(str(other))
  other.write_text("<mujoco>\n<wordbody/></mujoco>")
  with pytest.raises(ConfigError, match=r"ball\.xml is not an MJCF that MuJoCo reads: .*unrecognized element.*line 2"):
    build_scene(str(other))


@pytest.mark.parametrize(
  ("ours", "theirs", "message"),
  [
    ("<freejoint/>", "", "needs <freejoint/> as its first joint, in the body trunk."),
    (
      'qpos="0 0 0.278',
      'qpos="0.278',
      "qpos must have 19 numbers, 7 for the free joint and 1 for each hinge or slide, but",
    ),
    ('qpos="0 0 0.278', 'qpos="0 0 nan', "the keyframe home has a qpos that is not finite."),
    (
      'qpos="0 0 0.278 1 0 0 0 0.1',
      'qpos="0 0 0.278 1 0 0 0 45',
      "the keyframe home turns the joint FR_hip_joint to 45 rad: write positions in rad, not in degrees.",
    ),
    (
      'qpos="0 0 0.278 1 0 0 0',
      'qpos="0 0 0.278 0 0 0 0',
      "the keyframe home has no quaternion (w x y z), but zeros.",
    ),
    (
      "<worldbody>",
      '<worldbody><geom name="ground" type="plane" size="0 0 1"/>',
      "has a ground, the geom ground: remove it, the scene adds one.",
    ),
    ('name="footstand"', 'name="pronk_rough"', "the keyframe pronk_rough is pronk on rough ground: add pronk."),
    ("<sensor>", '<asset><material name="studio/groundplane"/></asset><sensor>', "repeated name 'studio/groundplane'"),
    (
      "<sensor>",
      '<sensor><gyro name="FR_floor_found" site="imu"/>',
      "repeated name 'FR_floor_found' in sensor; rename it",
    ),
    (
      "<sensor>",
      '<asset><hfield name="terrain" nrow="2" ncol="2" size="1 1 1 1"/></asset><sensor>',
      "'terrain' in hfield",
    ),
    ('<geom name="FR"', '<geom conaffinity="0" name="FR"', "FR of env.robot.floor_contacts passes through the floor"),
  ],
)
def test_a_model_that_is_no_robot_or_has_names_of_the_scene(
  ours: str, theirs: str, message: str, tmp_path: Path
) -> None:
  file, text = tmp_path / "mine.xml", find_mjcf("go1").read_text()
  assert ours in text
  file.write_text(text.replace(ours, theirs))
  with pytest.raises(ConfigError, match=r"^env.robot.mjcf=.*mine\.xml") as caught:
    build_scene(str(file), terrain="rough", floor_contacts=["FR"])
  assert message in str(caught.value)


@pytest.mark.parametrize(("typo", "key"), [("pose_weight", "pose_weights"), ("mirorr", "mirror")])
def test_a_misspelt_key_of_a_robot_is_named(typo: str, key: str) -> None:
  check_keys({"mjcf": "go1", "payload": 3}, ("mjcf",), "robot", (key,))
  with pytest.raises(UnknownNameError, match=rf"^env\.robot\.{typo} does not exist\. Did you mean '{key}'\?$"):
    check_keys({"mjcf": "go1", typo: [1]}, ("mjcf",), "robot", (key,))


def test_a_model_without_a_body(tmp_path: Path) -> None:
  (tmp_path / "empty.xml").write_text("<mujoco/>")
  with pytest.raises(ConfigError, match=r"empty\.xml has no body: the robot must be the first body of its <worldbody>"):
    build_scene(str(tmp_path / "empty.xml"))


def test_the_ground_is_found_beside_other_geoms_of_the_world(tmp_path: Path) -> None:
  file, text = tmp_path / "mine.xml", find_mjcf("go1").read_text()
  file.write_text(text.replace("<worldbody>", '<worldbody><geom name="rock" size="0.1" pos="2 0 0"/>', 1))
  assert ground_peak(build_scene(str(file), terrain="rough").compile()) > 0


@pytest.mark.parametrize("terrain", ["flat", "rough", "slope"])
def test_a_model_tells_how_high_the_ground_is_where_robots_start(terrain: str) -> None:
  peak = ground_peak(build_scene("go1", terrain=terrain).compile())
  np.testing.assert_allclose(peak, add_terrain(mujoco.MjSpec(), terrain, {}), atol=1e-6)
  assert (peak > 0) == (terrain == "rough")


def test_a_robot_may_have_a_ground_material_of_its_own(tmp_path: Path) -> None:
  """As those of MuJoCo Menagerie's scenes: texture, material, sky and light have the names that ours had."""
  file = tmp_path / "ball.xml"
  file.write_text(
    '<mujoco><asset><texture name="sky" type="skybox" builtin="flat" width="8" height="8"/>'
    '<texture name="groundplane" type="2d" builtin="checker" width="8" height="8"/>'
    '<material name="groundplane" texture="groundplane" rgba="1 0 0 1"/></asset>'
    '<worldbody><light name="spotlight" pos="0 0 2"/><body name="ball"><freejoint/>'
    '<geom name="skin" size="0.1" material="groundplane"/></body></worldbody></mujoco>'
  )
  for terrain in ("flat", "rough"):
    model = build_scene(str(file), terrain=terrain).compile()
    material = lambda geom, model=model: model.mat(model.geom(geom).matid[0])
    assert (material("skin").name, material("floor").name) == ("groundplane", "studio/groundplane")
    np.testing.assert_allclose(material("skin").rgba, [1, 0, 0, 1])


@pytest.mark.parametrize(
  ("robot", "options", "message"),
  [
    ("go2", {}, "env.robot.mjcf=go2 does not exist: give the path of a file, or <package>/<path> of an installed"),
    ("playground/robots/go1/go2.xml", {}, "does not exist"),
    ("no_such_package/go1.xml", {}, "does not exist"),
    ("__main__/go1.xml", {}, "does not exist"),
    ("go1", {"terrain": "flatt"}, "Did you mean 'flat'?"),
    ("go1", {"collision": "full_selv"}, "Did you mean 'full_self'?"),
    ("go1", {"floor_contacts": ["FX"]}, "env.robot.floor_contacts: 'FX' is unknown"),
  ],
)
def test_unknown_names(robot: str, options: dict, message: str) -> None:
  with pytest.raises(UnknownNameError) as error:
    build_scene(robot, **options)
  assert message in str(error.value)
  assert "\n" not in str(error.value)
