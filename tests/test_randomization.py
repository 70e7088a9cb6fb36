"""Domain randomisation terms: what they draw, where it goes, and what they refuse."""

import re
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mujoco import mjx
from omegaconf import OmegaConf

from playground.config import config_dict
from playground.errors import ConfigError, PlaygroundError, UnknownNameError
from playground.randomization import Randomizer, domain_randomizer, model_fields
from playground.robots.scene import build_scene
from playground.robots.tabletop import build_tabletop
from tests.robots.figures import HANDS, in_hand_scene

CONFIGS = Path(__file__).parents[1] / "configs/randomization"


def shipped(name: str) -> dict[str, Any]:
  """The events of a file of configs/randomization, over those of the file that it starts from."""
  own = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())
  base, _ = own.pop("defaults", [None, "_self_"])
  return cast(dict[str, Any], OmegaConf.to_object(OmegaConf.merge(shipped(base), own))) if base else own


def events(*terms: Any, mode: str = "startup") -> dict[str, Any]:
  """Events that draw model fields, of these parameters."""
  return {f"term_{i}": {"mode": mode, "func": "model_field", "params": term} for i, term in enumerate(terms)}


GO1 = shipped("go1")
SMALL = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="base"><freejoint/><geom name="hull" size="0.1"/>
      <body name="arm"><joint name="shoulder" type="ball"/><geom name="upper" size="0.1" pos="0 0 1"/>
        <body name="hand"><joint name="wrist"/><geom name="palm" size="0.1" pos="0 0 1"/></body>
      </body>
    </body>
  </worldbody>
  <contact><pair name="touch" geom1="floor" geom2="palm"/></contact>
  <actuator><position name="turn" joint="wrist" kp="20"/><position name="hold" joint="wrist" kp="10"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def go1() -> mujoco.MjModel:
  return build_scene("go1").compile()


@pytest.fixture(scope="module")
def small() -> mujoco.MjModel:
  return mujoco.MjModel.from_xml_string(SMALL)


def keys(count: int, seed: int = 0) -> jax.Array:
  return jax.random.split(jax.random.PRNGKey(seed), count)


def test_go1_changes_only_what_it_names_within_range(go1: mujoco.MjModel) -> None:
  randomizer = Randomizer(go1, GO1)
  fields = {"geom_friction", "dof_frictionloss", "dof_armature", "body_ipos", "body_mass", "qpos0", "body_subtreemass"}
  batch = {k: np.array(v) for k, v in jax.jit(randomizer.sample_batch)(keys(64)).items()}
  assert set(batch) == set(randomizer.fields) == fields
  nominal = {k: getattr(go1, k) for k in fields}
  assert all(batch[k].shape == (64, *nominal[k].shape) for k in fields)

  friction = batch["geom_friction"]
  assert (friction[:, 0, 0] >= 0.4).all() and (friction[:, 0, 0] <= 1).all() and np.ptp(friction[:, 0, 0]) > 0.3
  friction[:, 0, 0] = nominal["geom_friction"][0, 0]
  np.testing.assert_allclose(friction, np.broadcast_to(nominal["geom_friction"], friction.shape), rtol=1e-6)

  for field, low, high in (("dof_frictionloss", 0.9, 1.1), ("dof_armature", 1.0, 1.05)):
    assert not batch[field][:, :6].any()
    ratio = batch[field][:, 6:] / nominal[field][6:]
    assert (ratio > low - 1e-5).all() and (ratio < high + 1e-5).all()
    assert (ratio.std(axis=0) > 0).all() and (ratio.std(axis=1) > 0).all()

  shift = batch["body_ipos"] - nominal["body_ipos"]
  np.testing.assert_allclose(np.delete(shift, 1, axis=1), 0, atol=1e-7)
  assert (np.abs(shift[:, 1]) <= 0.05 + 1e-6).all() and (shift[:, 1].std(axis=1) > 0).all()

  ratio = batch["body_mass"][:, 2:] / nominal["body_mass"][2:]
  assert (ratio > 0.9 - 1e-5).all() and (ratio < 1.1 + 1e-5).all()
  assert (batch["body_mass"][:, 0] == 0).all()
  assert np.abs(batch["body_mass"][:, 1] / go1.body_mass[1] - 1).max() > 0.1  # scaled, then a payload added

  offset = batch["qpos0"] - nominal["qpos0"]
  np.testing.assert_allclose(offset[:, :7], 0, atol=1e-7)
  assert (np.abs(offset[:, 7:]) <= 0.05 + 1e-6).all() and (offset[:, 7:].std(axis=0) > 0).all()


def test_go1_draws_in_the_order_of_playground(go1: mujoco.MjModel) -> None:
  """Written out from the published list: split, then one uniform draw, per term."""

  def draw(low: float, high: float, shape: tuple[int, ...] = ()) -> jax.Array:
    nonlocal rng
    rng, key = jax.random.split(rng)
    return jax.random.uniform(key, shape, minval=low, maxval=high)

  rng = jax.random.PRNGKey(7)
  sample = Randomizer(go1, GO1).sample(rng)
  model = mjx.put_model(go1)
  expected = {
    "geom_friction": model.geom_friction.at[0, 0].set(draw(0.4, 1.0)),
    "dof_frictionloss": model.dof_frictionloss.at[6:].set(model.dof_frictionloss[6:] * draw(0.9, 1.1, (12,))),
    "dof_armature": model.dof_armature.at[6:].set(model.dof_armature[6:] * draw(1.0, 1.05, (12,))),
    "body_ipos": model.body_ipos.at[1].set(model.body_ipos[1] + draw(-0.05, 0.05, (3,))),
    "body_mass": (model.body_mass * draw(0.9, 1.1, (14,))).at[1].add(draw(-1.0, 1.0)),
    "qpos0": model.qpos0.at[7:].set(model.qpos0[7:] + draw(-0.05, 0.05, (12,))),
  }
  for field, value in expected.items():
    np.testing.assert_array_equal(sample[field], value, err_msg=field)


# Values drawn by each term, in order, as in Playground 0.2.0.
DRAWN = {
  "go1": [1, 12, 12, 3, 14, 1, 12],
  "berkeley_humanoid": [1, 12, 12, 14, 1, 12],
  "g1": [1, 29, 29, 31, 1, 29],
  "t1": [1, 23, 23, 25, 1, 23, 23, 4],
}
# The same, wider, then the joints' damping, the centre of mass and gains that these do not draw.
DRAWN |= {
  "go1_strong": [*DRAWN["go1"], 12, 12],
  "berkeley_humanoid_strong": [*DRAWN["berkeley_humanoid"], 12, 3, 12],
  "g1_strong": [*DRAWN["g1"], 29, 3, 29],
  "t1_strong": [*DRAWN["t1"], 23, 3],
}
# Hands: their terms are 0.2.0's, but each has a key of its own.
DRAWN |= {
  "leap_hand": [1, 1, 3, 16, 16, 16, 17, 16, 16],
  "aero_hand": [1, 1, 1, 3, 16, 16, 16, 21, 7, 16],
}


DRAWN |= {"panda_vision": [1, 1, 1, 1, 1, 3, 1, 1, 3, 1]}


def model_of(robot: str) -> mujoco.MjModel:
  if robot == "panda_vision":
    return build_tabletop("panda_single_cube_pixels").compile()
  build = in_hand_scene if robot in HANDS else build_scene
  return build(robot.removesuffix("_strong")).compile()


def values_drawn(randomizer: Randomizer) -> list[int]:
  return [draw.count for draw in randomizer._draws.values()]


def test_every_robots_terms_bind_to_its_model() -> None:
  assert set(DRAWN) == {path.stem for path in CONFIGS.glob("*.yaml")} - {"none"}
  for robot, drawn in DRAWN.items():
    assert values_drawn(Randomizer(model_of(robot), shipped(robot))) == drawn, robot


@pytest.mark.parametrize("robot", ["go1", "berkeley_humanoid", "g1", "t1"])
def test_strong_draws_go_beyond_the_others(robot: str) -> None:
  """Every term of <robot>.yaml is in <robot>_strong.yaml, on the same entries, at least as wide."""
  usual, strong = (model_fields(shipped(name)).values() for name in (robot, f"{robot}_strong"))
  for term in usual:
    same = [t for t in strong if (t.field, t.target, t.operation) == (term.field, term.target, term.operation)]
    assert len(same) == 1, term
    assert same[0].parameters[0] <= term.parameters[0] and same[0].parameters[1] >= term.parameters[1], term


def test_g1s_feet_slide_alike_in_both_directions() -> None:
  model = build_scene("g1").compile()
  first = dict(list(shipped("g1").items())[:1])
  friction = np.array(Randomizer(model, first).sample(keys(1)[0])["pair_friction"])
  feet = [model.pair(f"{side}_foot_floor").id for side in ("left", "right")]
  assert len(set(friction[feet][:, :2].ravel())) == 1 and 0.4 <= friction[feet[0], 0] <= 1.0
  others = np.delete(np.arange(model.npair), feet)
  np.testing.assert_array_equal(friction[others], model.pair_friction[others].astype(np.float32))
  np.testing.assert_array_equal(friction[feet][:, 2:], model.pair_friction[feet][:, 2:].astype(np.float32))


def test_terms_apply_in_order(small: mujoco.MjModel) -> None:
  fixed = {"field": "body_mass", "target": "hand"}
  set_then_scale = [fixed | {"operation": "set", "range": [2, 2]}, fixed | {"operation": "scale", "range": [3, 3]}]
  hand = small.body("hand").id
  key = jax.random.PRNGKey(0)
  assert Randomizer(small, events(*set_then_scale)).sample(key)["body_mass"][hand] == pytest.approx(6)
  assert Randomizer(small, events(*set_then_scale[::-1])).sample(key)["body_mass"][hand] == pytest.approx(2)


@pytest.mark.parametrize(
  ("change", "message"),
  [
    ({"operation": "set", "range": [-2, 1]}, "range=[-2.0, 1.0]: set gives body_mass -2, but it is never negative."),
    ({"operation": "scale", "range": [-1, 1]}, "scale gives body_mass -"),
    ({"operation": "add", "range": [-99, 1]}, "add gives body_mass -"),
  ],
)
def test_a_mass_is_never_negative(change: dict[str, Any], message: str, small: mujoco.MjModel) -> None:
  term = {"field": "body_mass", "target": "hand"}
  with pytest.raises(ConfigError, match=re.escape(message)):
    Randomizer(small, events(term | change))
  heavy = term | {"operation": "set", "range": [100, 200]}
  Randomizer(small, events(heavy, term | {"operation": "add", "range": [-99, 1]}))
  with pytest.raises(ConfigError, match=re.escape("term_1.params.range=[-101.0, 1.0]: add gives body_mass -1")):
    Randomizer(small, events(heavy, term | {"operation": "add", "range": [-101, 1]}))
  with pytest.raises(ConfigError, match=re.escape("term_1.params.mean=-101.0: add gives body_mass -1")):
    normal = {"operation": "add", "distribution": "normal", "mean": -101.0, "std": 1.0}
    Randomizer(small, events(heavy, term | normal))


STATIC = {"field": "geom_pos", "target": "floor", "operation": "add", "range": [0.0, 0.1]}


@pytest.mark.parametrize(
  ("change", "refused"),
  [
    ({}, True),
    ({"target": "palm"}, False),
    ({"target": "all"}, True),
    ({"field": "body_quat", "target": "hand"}, False),
    ({"field": "geom_friction"}, False),
  ],
)
def test_warp_moves_nothing_that_is_fixed_to_the_world(
  change: dict[str, Any], refused: bool, small: mujoco.MjModel
) -> None:
  Randomizer(small, events(STATIC | change), impl="jax")
  if not refused:
    Randomizer(small, events(STATIC | change), impl="warp")
    return
  with pytest.raises(ConfigError, match=r"^env\.events\.term_0: MuJoCo-Warp does not move what is fixed"):
    Randomizer(small, events(STATIC | change), impl="warp")


@pytest.mark.parametrize(
  ("change", "impls", "message"),
  [
    ({"field": "jnt_range", "target": "wrist"}, ("jax", "warp"), "jnt_range acts on nothing, since jnt_limited is off"),
    ({"field": "actuator_forcerange", "target": "all"}, ("jax", "warp"), "since actuator_forcelimited is off"),
    ({"field": "body_gravcomp", "target": "hand"}, ("jax", "warp"), "body_gravcomp acts on nothing"),
    ({"field": "geom_size", "target": "all"}, ("jax", "warp"), "geom_size acts on spheres, capsules, "),
    ({"field": "body_pos", "target": "all"}, ("jax", "warp"), "body_pos would move the world"),
    ({"field": "dof_frictionloss", "target": "joints"}, ("jax",), "MJX on JAX leaves out friction that is 0"),
    ({"field": "dof_frictionloss", "target": "joints", "operation": "scale"}, (), ""),
  ],
)
def test_what_the_simulator_ignores_is_refused(
  change: dict[str, Any], impls: tuple[str, ...], message: str, small: mujoco.MjModel
) -> None:
  section = events({"operation": "add", "range": [0.0, 0.1]} | change)
  for impl in ("jax", "warp"):
    if impl in impls:
      with pytest.raises(ConfigError, match=rf"^env\.events\.term_0: .*{re.escape(message)}"):
        Randomizer(small, section, impl=impl)
    else:
      Randomizer(small, section, impl=impl)
    if impls != ("jax", "warp"):  # C MuJoCo plays policies of the other backend
      Randomizer(small, section, impl=impl, in_c=True)


KINDS = {"sphere": ".1", "capsule": ".1 .2", "ellipsoid": ".1 .2 .3", "cylinder": ".1 .3", "box": ".1 .2 .3"}


@pytest.mark.parametrize("impl", ["jax", "warp"])
def test_what_sensors_and_contacts_read_follows_masses_and_sizes(impl: str) -> None:
  geoms = "".join(f'<body><geom name="{kind}" type="{kind}" size="{size}"/></body>' for kind, size in KINDS.items())
  mjcf = f'<mujoco><worldbody><geom type="plane" size="1 1 1"/><body><freejoint/>{geoms}</body></worldbody></mujoco>'
  larger = mujoco.MjSpec.from_string(mjcf)
  for geom in larger.geoms[1:]:
    geom.size, geom.density = 2 * geom.size, 1000 / 8  # of the same masses
  compiled, nominal = larger.compile(), mujoco.MjModel.from_xml_string(mjcf)
  twice = {"operation": "scale", "range": [2, 2]}
  section = events(
    {"field": "geom_size", "target": list(KINDS), **twice}, {"field": "body_mass", "target": "all", **twice}
  )
  drawn = Randomizer(nominal, section, impl=impl).sample(jax.random.PRNGKey(0))
  np.testing.assert_allclose(drawn["geom_rbound"], compiled.geom_rbound, rtol=1e-6)
  np.testing.assert_allclose(np.reshape(drawn["geom_aabb"], compiled.geom_aabb.shape), compiled.geom_aabb, rtol=1e-6)
  np.testing.assert_allclose(drawn["body_subtreemass"], 2 * compiled.body_subtreemass, rtol=1e-6)
  assert drawn["geom_aabb"].shape == mjx.put_model(nominal, impl=impl).geom_aabb.shape


def test_nothing_to_randomise(small: mujoco.MjModel) -> None:
  randomizer = Randomizer(small, shipped("none") | events(GOOD, mode="reset") | {"gone": None})
  assert randomizer.fields == () and randomizer.sample_batch(keys(3)) == {} and values_drawn(randomizer) == []


def test_shared_draw_and_columns(small: mujoco.MjModel) -> None:
  """Friction of a contact pair: both tangential directions get one value, and no other column changes."""
  term = {"field": "pair_friction", "target": "all", "column": [0, 1], "operation": "set", "range": [0.4, 1.0]}
  shared = np.asarray(Randomizer(small, events(term | {"shared": True})).sample_batch(keys(8))["pair_friction"])
  assert (shared[:, 0, 0] == shared[:, 0, 1]).all() and np.ptp(shared[:, 0, 0]) > 0
  np.testing.assert_allclose(shared[:, 0, 2:], np.tile(small.pair_friction[0, 2:], (8, 1)), rtol=1e-6)
  separate = np.asarray(Randomizer(small, events(term)).sample_batch(keys(8))["pair_friction"])
  assert (separate[:, 0, 0] != separate[:, 0, 1]).all()


def test_position_gain_moves_gain_and_bias(small: mujoco.MjModel) -> None:
  for operation, bounds in (("scale", [0.9, 1.1]), ("add", [-2, 2]), ("set", [15, 25])):
    term = {"field": "actuator_kp", "target": "all", "operation": operation, "range": bounds}
    sample = Randomizer(small, events(term)).sample(jax.random.PRNGKey(1))
    gain, bias = sample["actuator_gainprm"], sample["actuator_biasprm"]
    np.testing.assert_allclose(gain[:, 0], -bias[:, 1], rtol=1e-6)
    assert (gain[:, 0] != small.actuator_gainprm[:, 0]).all()
    np.testing.assert_allclose(bias[:, 2], small.actuator_biasprm[:, 2])


def test_density_moves_mass_and_inertia_in_proportion(small: mujoco.MjModel) -> None:
  term = {"field": "body_density", "target": ["hand", "base"], "operation": "scale", "range": [0.5, 2.0]}
  sample = Randomizer(small, events(term)).sample(jax.random.PRNGKey(1))
  ratio = np.asarray(sample["body_mass"])[1:] / small.body_mass[1:]
  np.testing.assert_allclose(sample["body_inertia"][1:], small.body_inertia[1:] * ratio[:, None], rtol=1e-6)
  assert ratio[small.body("arm").id - 1] == pytest.approx(1) and len(np.unique(ratio)) == 3


@pytest.mark.parametrize("hand", HANDS)
def test_a_hands_terms_change_what_the_paper_lists(hand: str) -> None:
  """Friction of the fingertips, cube's mass and centre, joints' calibration, friction and inertia, links, gains."""
  model = model_of(hand)
  randomizer = Randomizer(model, shipped(hand))
  batch = {name: np.asarray(value) for name, value in jax.jit(randomizer.sample_batch)(keys(32)).items()}
  nominal = {name: getattr(model, name) for name in batch}
  tips = [model.geom(i).id for i in range(model.ngeom) if model.geom(i).name.endswith("_tip")]
  friction = batch["geom_friction"][:, tips, 0]
  assert (friction == friction[:, :1]).all() and friction.min() >= 0.5 and friction.max() <= 1.0

  cube, links = model.body("cube").id, slice(2, model.body("cube").id)  # after world and mount
  for bodies, low, high in (([cube], 0.8, 1.2), (links, 0.9, 1.1)):
    ratio = batch["body_mass"][:, bodies] / nominal["body_mass"][bodies]
    assert low - 1e-5 <= ratio.min() < ratio.max() <= high + 1e-5 and (ratio.std(axis=0) > 0).all()
    inertia = batch["body_inertia"][:, bodies] / nominal["body_inertia"][bodies]
    np.testing.assert_allclose(inertia, np.repeat(ratio[..., None], 3, axis=2), rtol=1e-4)
  np.testing.assert_allclose(batch["body_mass"][:, -1], nominal["body_mass"][-1], rtol=1e-6)  # the goal's
  assert np.abs(batch["body_ipos"][:, cube] - nominal["body_ipos"][cube]).max() <= 0.005 + 1e-6

  for field, low, high in (("dof_frictionloss", 0.5, 2.0), ("dof_armature", 1.0, 1.05), ("dof_damping", 0.8, 1.2)):
    ratio = batch[field][:, :16] / nominal[field][:16]
    assert low - 1e-5 <= ratio.min() < ratio.max() <= high + 1e-5 and (ratio.std(axis=0) > 0).all()
    np.testing.assert_array_equal(batch[field][:, 16:], np.zeros((32, 6)))  # the cube's free joint
  offset = batch["qpos0"] - nominal["qpos0"]
  assert np.abs(offset[:, :16]).max() <= 0.05 + 1e-6 and (offset[:, :16].std(axis=0) > 0).all()
  np.testing.assert_allclose(offset[:, 16:], 0, atol=1e-6)
  kp = batch["actuator_gainprm"][:, :, 0] / nominal["actuator_gainprm"][:, 0]
  np.testing.assert_allclose(batch["actuator_biasprm"][:, :, 1], -batch["actuator_gainprm"][:, :, 0], rtol=1e-6)
  assert 0.8 - 1e-5 <= kp.min() < kp.max() <= 1.2 + 1e-5


@pytest.mark.parametrize(
  ("field", "target", "rows"),
  [
    ("dof_armature", "joints", [6, 7, 8, 9]),
    ("dof_armature", "shoulder", [6, 7, 8]),
    ("dof_armature", ["wrist", "shoulder"], [9, 6, 7, 8]),
    ("qpos0", "joints", [7, 8, 9, 10, 11]),
    ("qpos0", "wrist", [11]),
    ("jnt_stiffness", "joints", [1, 2]),
    ("dof_armature", "all", list(range(10))),
    ("body_mass", ["hand", "base"], [3, 1]),
  ],
)
def test_targets(small: mujoco.MjModel, field: str, target: Any, rows: list[int]) -> None:
  term = {"field": field, "target": target, "operation": "add", "range": [1, 2]}
  change = np.asarray(Randomizer(small, events(term)).sample(jax.random.PRNGKey(0))[field]) - getattr(small, field)
  assert set(np.flatnonzero(np.abs(change) > 0.5)) == set(rows)


def test_distributions(small: mujoco.MjModel) -> None:
  base = {"field": "dof_damping", "target": "wrist", "operation": "set"}
  log = Randomizer(small, events(base | {"distribution": "log_uniform", "range": [0.01, 100]})).sample_batch(keys(2000))
  log = np.log10(np.asarray(log["dof_damping"][:, 9]))
  assert abs(log.mean()) < 0.1 and -2.01 < log.min() < -1.9 and 1.9 < log.max() < 2.01
  normal = Randomizer(small, events(base | {"distribution": "normal", "mean": 5, "std": 2})).sample_batch(keys(2000))
  normal = np.asarray(normal["dof_damping"][:, 9])
  assert abs(normal.mean() - 5) < 0.2 and abs(normal.std() - 2) < 0.15


@settings(max_examples=15, deadline=None)
@given(
  low=st.floats(-10, 10), width=st.floats(0, 5), operation=st.sampled_from(["set", "scale", "add"]),
  target=st.sampled_from(["all", "base", "hand"]), seed=st.integers(0, 2**31 - 1),
)  # fmt: skip
def test_ranges_hold(low: float, width: float, operation: str, target: str, seed: int) -> None:
  model = mujoco.MjModel.from_xml_string(SMALL.replace('"base"', '"base" gravcomp="1"'))
  model.body_gravcomp[:] = model.body_mass  # a field that may be negative
  term = {"field": "body_gravcomp", "target": target, "operation": operation, "range": [low, low + width]}
  sample = np.asarray(Randomizer(model, events(term)).sample(jax.random.PRNGKey(seed))["body_gravcomp"])
  rows = slice(None) if target == "all" else [model.body(target).id]
  ends = [np.full(4, low), np.full(4, low + width)]
  if operation != "set":
    ends = [model.body_gravcomp * e if operation == "scale" else model.body_gravcomp + e for e in ends]
  ends = np.sort(ends, axis=0)[:, rows]
  assert (sample[rows] >= ends[0] - 1e-3).all() and (sample[rows] <= ends[1] + 1e-3).all()
  untouched = np.ones(4, bool)
  untouched[rows] = False
  np.testing.assert_allclose(sample[untouched], model.body_gravcomp[untouched], rtol=1e-6)


def test_old_randomizer_drives_a_vmapped_model(small: mujoco.MjModel) -> None:
  """Playground 0.2.0's callable: its output is what vmap needs, and reset poses differ between environments."""
  term = {"field": "body_mass", "target": "all", "operation": "scale", "range": [0.5, 2]}
  model = mjx.put_model(small)
  batched, in_axes = domain_randomizer(small, events(term))(model, keys(4))
  assert batched.body_mass.shape == (4, small.nbody)
  assert in_axes.body_mass == 0 and in_axes.body_ipos is None
  total = jax.vmap(lambda m: jnp.sum(m.body_mass) + jnp.sum(m.qpos0), in_axes=[in_axes])(batched)
  assert len(np.unique(total)) == 4


def test_terms_may_be_config_dicts(go1: mujoco.MjModel) -> None:
  config: Any = config_dict(GO1)
  assert Randomizer(go1, config).fields == Randomizer(go1, GO1).fields


def test_describe(go1: mujoco.MjModel) -> None:
  assert values_drawn(Randomizer(go1, GO1)) == [1, 12, 12, 3, 14, 1, 12]
  assert next(iter(model_fields(GO1).values())).describe() == {
    "field": "geom_friction[:, 0]", "target": "floor", "operation": "set", "draw": "uniform(0.4, 1)",
  }  # fmt: skip


def test_a_range_without_the_nominal_value_is_said(go1: mujoco.MjModel) -> None:
  assert Randomizer(go1, GO1).without_nominal() == []
  assert Randomizer(model_of("aero_hand"), shipped("aero_hand")).without_nominal() == [
    "env.events.fingertip_friction draws 0.5 to 1, and the nominal model has 0.2."
  ]


GOOD = {"field": "body_mass", "target": "hand", "operation": "scale", "range": [0.9, 1.1]}


@pytest.mark.parametrize(
  ("change", "kind", "message"),
  [
    ({"field": "body_mas"}, UnknownNameError, "Did you mean 'body_mass'?"),
    ({"field": "body_parentid"}, UnknownNameError, "no field of the model that can be randomised"),
    ({"target": "hnd"}, UnknownNameError, "target 'hnd' is no body of the model. Did you mean 'hand'?"),
    ({"target": ["hand", "arn"]}, UnknownNameError, "Did you mean 'arm'?"),
    ({"target": "joints"}, ConfigError, "needs a field of joints"),
    ({"target": 3}, ConfigError, "must be text or a list of texts"),
    ({"field": "tendon_range", "target": "all"}, ConfigError, "names nothing"),
    ({"operation": "multiply"}, UnknownNameError, "choose from set, scale, add"),
    ({"distribution": "unifrom"}, UnknownNameError, "Did you mean 'uniform'?"),
    ({"distribution": "normal"}, ConfigError, "'normal' has no key 'range'"),
    ({"distribution": "log_uniform", "range": [0, 1]}, ConfigError, "must be above 0"),
    ({"range": None}, ConfigError, "'uniform' needs key 'range'"),
    ({"range": [1.1, 0.9]}, ConfigError, "the first not above the second"),
    ({"range": [0.9]}, ConfigError, "must be 2 numbers"),
    ({"range": [0, float("nan")]}, ConfigError, "must be 2 numbers"),
    ({"column": 0}, ConfigError, "has no columns"),
    ({"column": True}, ConfigError, "column=true must be a whole number or a list of whole numbers"),
    ({"distribution": "bernoulli", "range": None, "mean": True}, ConfigError, "mean=true must be a number"),
    ({"field": "body_density", "operation": "set"}, ConfigError, "field 'body_density' can only be scaled"),
    ({"field": "body_ipos", "column": 3}, ConfigError, "has columns 0 to 2"),
    ({"rnage": [1, 2]}, UnknownNameError, "Did you mean 'range'?"),
  ],
)
def test_errors_say_what_is_wrong_in_one_sentence(
  small: mujoco.MjModel, change: dict[str, Any], kind: type[PlaygroundError], message: str
) -> None:
  with pytest.raises(kind) as error:
    Randomizer(small, events(GOOD, GOOD | change))
  assert message in str(error.value)
  assert str(error.value).startswith("env.events.term_1.params") and "\n" not in str(error.value)


def test_a_servos_gain_is_not_a_motors() -> None:
  mjcf = '<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody>{}</mujoco>'
  model = mujoco.MjModel.from_xml_string(mjcf.format('<actuator><motor joint="hinge"/></actuator>'))
  with pytest.raises(ConfigError, match="field 'actuator_kp' is of position servos"):
    Randomizer(model, events({"field": "actuator_kp", "target": "all", "operation": "scale", "range": [1, 2]}))


@pytest.mark.parametrize("missing", ["field", "target", "operation"])
def test_missing_keys(small: mujoco.MjModel, missing: str) -> None:
  with pytest.raises(ConfigError, match=f"{missing} is missing"):
    Randomizer(small, events({k: v for k, v in GOOD.items() if k != missing}))


@pytest.mark.parametrize(
  ("change", "message"),
  [
    ({"params": "body_mass"}, "is no mapping of parameters"),
    ({"mode": "interval"}, r"env\.events\.term_0\.mode=interval must be startup or reset"),
    ({"weight": 1}, "weight does not exist"),
  ],
)
def test_an_event_that_is_none(small: mujoco.MjModel, change: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    Randomizer(small, {"term_0": events(GOOD)["term_0"] | change})


def test_a_disabled_event_draws_nothing(small: mujoco.MjModel) -> None:
  assert Randomizer(small, {"term_0": events(GOOD)["term_0"] | {"enabled": False}}).fields == ()
