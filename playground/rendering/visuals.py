"""Chooses the visuals of a robot in videos: primitives, or the meshes of its model in MuJoCo Menagerie."""

from pathlib import Path
from typing import Any

import mujoco

from playground.envs.base import Env
from playground.errors import ConfigError, HardwareError, lookup

# Folder of `playground/robots` -> (robot of Menagerie, its file): bodies have the same names and frames in both.
MENAGERIE = {
  "apollo": ("apptronik_apollo", "apptronik_apollo"),
  "barkour": ("google_barkour_vb", "barkour_vb"),
  "berkeley_humanoid": ("berkeley_humanoid", "berkeley_humanoid"),
  "g1": ("unitree_g1", "g1"),
  "go1": ("unitree_go1", "go1"),
  "h1": ("unitree_h1", "h1"),
  "op3": ("robotis_op3", "op3"),
  "spot": ("boston_dynamics_spot", "spot"),
  "t1": ("booster_t1", "t1"),
}
_DRAWN = 3  # geoms of lower groups are drawn


def drawn_model(env: Env, visuals: str) -> mujoco.MjModel:
  """Returns the model for rendering a task's `qpos`.

  Args:
    env: the task.
    visuals: `primitives`, the task's own model, or `menagerie`, that model with the robot's meshes (downloaded once by
      the package mujoco-menagerie). The simulation does not change.

  Raises:
    UnknownNameError: no such visuals.
    ConfigError: the task's robot is not in Menagerie, or the package is not installed.
    HardwareError: the meshes are not in the package's cache, and the download failed.
  """
  return lookup({"primitives": lambda env: env.mj_model, "menagerie": _with_meshes}, visuals, "video.visuals")(env)


def _with_meshes(env: Env) -> mujoco.MjModel:
  robot = env.config.robot.get("name") if env.spec is not None and "robot" in env.config else None
  if robot not in MENAGERIE or env.spec is None:
    known = ", ".join(MENAGERIE)
    raise ConfigError(f"video.visuals=menagerie: only {known} have meshes; set video.visuals=primitives.")
  spec = env.spec.copy()
  dress(spec, _menagerie_spec(robot))
  return spec.compile()


def _menagerie_spec(robot: str) -> mujoco.MjSpec:
  try:
    import mujoco_menagerie
  except ImportError:
    remedy = "pip install mujoco-menagerie, or set video.visuals=primitives"
    raise ConfigError(f"video.visuals=menagerie needs a package that is not installed: {remedy}.") from None
  name, entry = MENAGERIE[robot]
  try:
    return mujoco_menagerie.get(name).spec(entry)
  except (mujoco_menagerie.MenagerieError, OSError) as error:
    remedy = f"run `mujoco-menagerie prefetch {name}` where there is a network, or set video.visuals=primitives"
    raise HardwareError(f"video.visuals=menagerie: the meshes are not available ({error}): {remedy}.") from None


def dress(spec: mujoco.MjSpec, source: mujoco.MjSpec) -> None:
  """Draws the bodies of `spec` with the mesh geoms that the bodies of the same names have in `source`.

  The visual geoms of these bodies are removed; colliding geoms, and bodies without a namesake, stay.

  Raises:
    ConfigError: no body has a namesake with meshes.
  """
  folder = Path(source.modelfiledir) / source.meshdir
  meshes = {mesh.name or Path(mesh.file).stem: mesh for mesh in source.meshes}
  materials = {material.name: material for material in source.materials}
  added: set[str] = set()
  for body in source.bodies:
    drawn = [geom for geom in body.geoms if geom.type == mujoco.mjtGeom.mjGEOM_MESH and geom.group < _DRAWN]
    own = spec.body(body.name)
    if own is None or not drawn:
      continue
    for geom in own.geoms:
      if geom.group < _DRAWN and not geom.contype and not geom.conaffinity:
        spec.delete(geom)
    for geom in drawn:
      name = f"menagerie_{geom.meshname}"
      if name not in added:
        added.add(name)
        mesh = meshes[geom.meshname]
        shell = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # an open surface has no volume, and needs none
        spec.add_mesh(name=name, file=str(folder / mesh.file), scale=mesh.scale, inertia=shell)
      material: Any = materials.get(geom.material)
      rgba = geom.rgba if material is None else material.rgba
      own.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        pos=geom.pos,
        quat=geom.quat,
        rgba=rgba,
        group=2,
        contype=0,
        conaffinity=0,
        mass=0,
      )
  if not added:
    raise ConfigError("video.visuals=menagerie: no body of the robot has the name of one with meshes in Menagerie.")
