"""Terms on lights, cameras and materials."""

from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import pytest
import yaml

from playground.errors import ConfigError, UnknownNameError
from playground.randomization import Randomizer
from playground.robots.tabletop import build_tabletop
from tests.test_randomization import events

EVENTS = yaml.safe_load((Path(__file__).parents[1] / "configs/randomization/panda_vision.yaml").read_text())
COUNT = 64
LIMITS = {"cam_quat": 10.0, "light_dir": 20.0}  # degrees


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
  return build_tabletop("panda_single_cube_pixels").compile()


@pytest.fixture(scope="module")
def batch(model: mujoco.MjModel) -> dict[str, np.ndarray]:
  drawn = jax.jit(Randomizer(model, EVENTS).sample_batch)(jax.random.split(jax.random.PRNGKey(0), COUNT))
  return {name: np.asarray(value) for name, value in drawn.items()}


def test_colours_are_those_of_what_is_named(model: mujoco.MjModel, batch: dict[str, np.ndarray]) -> None:
  colour = lambda geom: batch["geom_rgba"][:, model.geom(geom).id]
  box, strip, floor = map(colour, ("box", "init_space", "floor"))
  assert (box[:, 0] >= 0.5).all() and np.ptp(box[:, 0]) > 0.3 and (box[:, 1:] == [0, 0, 1]).all()
  for grey, low, high in ((strip, 0.8, 1.0), (floor, 0.0, 0.25)):
    assert (grey[:, 0] == grey[:, 1]).all() and (grey[:, 0] == grey[:, 2]).all() and (grey[:, 3] == 1).all()
    assert low <= grey[:, 0].min() and grey[:, 0].max() <= high and np.ptp(grey[:, 0]) > 0.1
  changed = (batch["mat_rgba"] != model.mat_rgba.astype(np.float32)).any(axis=(0, 2))
  assert [model.mat(i).name for i in np.nonzero(changed)[0]] == ["white", "off_white"]


def test_turns_keep_lengths_and_stay_within_their_angle(model: mujoco.MjModel, batch: dict[str, np.ndarray]) -> None:
  for field, limit in LIMITS.items():
    turned, nominal = batch[field][:, 0], getattr(model, field)[0]
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1, rtol=1e-5)
    angle = np.rad2deg(np.arccos(np.clip(turned @ nominal, -1, 1))) * (2 if field == "cam_quat" else 1)
    assert 0.6 * limit < angle.max() < limit + 0.1
    assert (np.std(turned - nominal, axis=0) > 0.005).all()  # about axes of all directions


def test_the_start_of_the_hand_stays_in_sight(model: mujoco.MjModel, batch: dict[str, np.ndarray]) -> None:
  half = np.tan(np.deg2rad(model.cam_fovy[0] / 2))
  for quat, position in zip(batch["cam_quat"][:, 0], batch["cam_pos"][:, 0], strict=True):
    frame = np.zeros(9)
    mujoco.mju_quat2Mat(frame, quat)
    right, up, back = frame.reshape(3, 3).T @ (np.array([0.661, 0, 0.179]) - position)  # of its tip
    assert abs(right) < -back * half and abs(up) < -back * half


def test_an_axis_may_be_narrowed(model: mujoco.MjModel) -> None:
  term = {
    "field": "light_dir",
    "target": "top",
    "operation": "rotate",
    "range": [0.3, 0.3],
    "axis": [[0, 0], [1, 2], [0, 0]],
  }
  turned = Randomizer(model, events(term)).sample(jax.random.PRNGKey(0))["light_dir"][0]
  x, y, z = model.light_dir[0]
  c, s = np.cos(0.3), np.sin(0.3)
  np.testing.assert_allclose(turned, [c * x + s * z, y, c * z - s * x], atol=1e-6)


def test_shadows_are_switched(batch: dict[str, np.ndarray]) -> None:
  shadows = batch["light_castshadow"]
  assert shadows.dtype == bool and 0.5 < shadows.mean() < 0.95


@pytest.mark.parametrize(
  ("term", "message"),
  [
    ({"field": "light_castshadow", "range": [0, 1]}, "is a switch: it needs operation set, distribution bernoulli"),
    ({"field": "light_diffuse", "distribution": "bernoulli", "mean": 0.5}, "'light_diffuse' is no switch"),
    ({"field": "light_castshadow", "distribution": "bernoulli", "mean": 1.5}, "mean=1.5 is no probability"),
    ({"field": "cam_fovy", "target": "front", "operation": "rotate", "range": [0, 1]}, "directions or quaternions"),
    ({"field": "light_diffuse", "operation": "rotate", "range": [0, 1]}, "directions or quaternions"),
    ({"field": "light_dir", "range": [0, 1], "axis": [[0, 1]] * 3}, "operation 'set' has no key 'axis'"),
    *(
      ({"field": "light_dir", "operation": "rotate", "range": [0, 1], "axis": axis}, "not three pairs")
      for axis in ([[0, 1]] * 2, [[0, 1], [1, 0], [0, 1]], [[0, 0]] * 3, 1, [0, 1, 0])
    ),
  ],
)
def test_what_does_not_go_together(model: mujoco.MjModel, term: dict[str, Any], message: str) -> None:
  with pytest.raises(ConfigError, match=message):
    Randomizer(model, events({"target": "top", "operation": "set", **term}))


def test_a_light_that_is_not_there(model: mujoco.MjModel) -> None:
  term = {"field": "light_dir", "target": "topp", "operation": "rotate", "range": [0.0, 0.1]}
  with pytest.raises(UnknownNameError, match=r"'topp' is no light of the model. Did you mean 'top'"):
    Randomizer(model, events(term))
