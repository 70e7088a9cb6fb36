"""The ground: a plane, or one height field, whose shape does not change the cost of collisions in either MJX backend.

A terrain is a function of `TERRAINS`. It adds the geom `floor` to a scene and returns how high the ground rises where
robots start (m, at most; the flat ground's height is 0). Its keyword arguments are its parameters, in metres.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import mujoco
import numpy as np

from playground.errors import ConfigError, lookup
from playground.limits import SEED, Positive, count
from playground.mdp.terms import check_params

HALF_EXTENT = 10.0  # m, of the square
POINTS = 256  # a side: 0.078 m apart
START = 1.0  # m: feet touch the ground first within this half-extent of the origin
_BASE = 1.0  # m of solid ground below the lowest point
Seed = Annotated[int, SEED]
Octaves = Annotated[int, count(1, 16)]


def flat(spec: mujoco.MjSpec) -> float:
  """An infinite plane."""
  _add_floor(spec, "floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.01])
  return 0.0


def rough(
  spec: mujoco.MjSpec, *, seed: Seed = 0, elevation: Positive = 0.05, wavelength: Positive = 0.5, octaves: Octaves = 3
) -> float:
  """Perlin noise (paper: appendix "Locomotion", rough terrain).

  `elevation` is from the lowest point to the highest, `wavelength` that of the broadest bumps. Each of the `octaves`
  has half the wavelength and half the height of the one before. Raises ConfigError where the last is finer than the
  height field's points.
  """
  rng = np.random.default_rng(seed)
  cells = 2 * HALF_EXTENT / wavelength
  if cells * 2 ** (octaves - 1) > POINTS:
    raise ConfigError(
      f"env.scene.terrain_params: octaves={octaves} from wavelength={wavelength:g} m on are finer than the "
      f"{POINTS} points of the height field: choose fewer octaves or a longer wavelength."
    )
  noise = sum(0.5**i * _perlin(rng, max(1, round(cells * 2**i))) for i in range(octaves))
  return _add_height_field(spec, _stretch(np.asarray(noise), elevation))


def white_noise(spec: mujoco.MjSpec, *, seed: Seed = 0, elevation: Positive = 0.05) -> float:
  """Independent heights of 256 levels: what Playground 0.2.0 takes for rough terrain, from a file that has no name."""
  levels = np.random.default_rng(seed).integers(0, 256, (POINTS, POINTS))
  return _add_height_field(spec, _stretch(levels, elevation))


def stairs(
  spec: mujoco.MjSpec, *, step_height: float = 0.1, step_width: Positive = 0.4, platform: Positive = 2.0
) -> float:
  """Square rings of steps about a platform in the middle, risers 0.08 m deep; a negative `step_height` leads down."""
  steps = np.ceil(np.maximum(_distance() - platform / 2, 0) / step_width)
  return _add_height_field(spec, step_height * steps)


def slope(spec: mujoco.MjSpec, *, gradient: float = 0.2, platform: Positive = 2.0) -> float:
  """Four ramps about a platform in the middle; a negative `gradient` (rise over run) leads down."""
  return _add_height_field(spec, gradient * np.maximum(_distance() - platform / 2, 0))


TERRAINS: dict[str, Callable[..., float]] = {f.__name__: f for f in (flat, rough, white_noise, stairs, slope)}


def add_terrain(spec: mujoco.MjSpec, name: str, parameters: Mapping[str, Any]) -> float:
  """Calls a terrain of `TERRAINS` with its parameters checked; raises ConfigError."""
  terrain = lookup(TERRAINS, name, "env.scene.terrain")
  return terrain(spec, **check_params(terrain, parameters, "env.scene.terrain_params"))


def _add_floor(spec: mujoco.MjSpec, *classes: str, **shape: Any) -> None:
  """Adds the ground's geom, with the first of the default classes that the robot's file has."""
  default = next((d for d in map(spec.find_default, classes) if d), spec.default)
  spec.worldbody.add_geom(default, name="floor", **shape)


def _add_height_field(spec: mujoco.MjSpec, heights: np.ndarray) -> float:
  """Adds heights (m, shape [rows along y, columns along x]); returns the highest where robots start."""
  low, high = float(heights.min()), float(heights.max())
  if not high > low:
    raise ConfigError("This terrain has no heights: choose terrain=flat for flat ground.")
  spec.add_hfield(
    name="terrain",
    nrow=POINTS,
    ncol=POINTS,
    size=[HALF_EXTENT, HALF_EXTENT, high - low, _BASE],
    userdata=((heights - low) / (high - low)).ravel(),
  )
  _add_floor(spec, "floor_rough", "floor", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="terrain", pos=[0, 0, low])
  return float(heights[_distance() <= START].max())


def ground_peak(mj_model: mujoco.MjModel) -> float:
  """Returns the height of the highest ground where robots start, m; the ground is the geom `floor`."""
  floor = mj_model.geom("floor")
  if floor.type[0] != mujoco.mjtGeom.mjGEOM_HFIELD:
    return 0.0
  field = mj_model.hfield(floor.dataid[0])
  return float(floor.pos[2] + field.size[2] * field.data[_distance() <= START].max())


def _distance() -> np.ndarray:
  """Distance of every point from the middle, m, the greater of its two coordinates."""
  axis = np.abs(np.linspace(-HALF_EXTENT, HALF_EXTENT, POINTS))
  return np.maximum(axis[:, None], axis)


def _stretch(noise: np.ndarray, elevation: float) -> np.ndarray:
  return elevation * (noise - noise.min()) / np.ptp(noise)


def _perlin(rng: np.random.Generator, cells: int) -> np.ndarray:
  """One layer of gradient noise: a random slope at each corner of a grid of cells, blended smoothly in between."""
  angle = rng.uniform(0, 2 * np.pi, (cells + 1, cells + 1))
  slopes = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
  place = np.linspace(0, cells, POINTS)
  corner = np.minimum(place.astype(int), cells - 1)
  inside = place - corner  # in [0, 1]
  blend = inside**3 * (inside * (6 * inside - 15) + 10)

  def seen_from(i: int, j: int) -> np.ndarray:
    """Height of the corner's slope at every point, times the corner's weight there."""
    slope = slopes[np.ix_(corner + i, corner + j)]
    height = slope[..., 0] * (inside - i)[:, None] + slope[..., 1] * (inside - j)
    return height * np.abs(1 - i - blend)[:, None] * np.abs(1 - j - blend)

  return seen_from(0, 0) + seen_from(0, 1) + seen_from(1, 0) + seen_from(1, 1)
