"""Stand on some of the feet, handstand and footstand: one task for all robots, composed by config."""

import re
from collections.abc import Iterable
from typing import Any

import mujoco

from playground.envs.locomotion.legged import LeggedTask
from playground.errors import lookup
from playground.mdp.legged import LeggedRobot
from playground.robots.scene import add_floor_contacts


class Stand(LeggedTask):
  """Rears up onto the feet of `support`: the front ones for a handstand, the hind ones for a footstand.

  The other legs should be in the air, in their default pose: the joint group `lifted_legs`. The scene has a contact
  sensor for each part of a supporting leg but its foot, which the termination `leg_contact` reads. (Paper: appendix
  "Locomotion".) What differs from Playground 0.2.0 is in docs/differences.md.

  Attributes:
    leg_geoms: names of the geoms that have such a sensor.
    lifted_joints: names of the joints of the other legs.
  """

  def scene(self, config: Any) -> mujoco.MjSpec:
    spec = super().scene(config)
    feet = {name: name for name in config.robot.feet}
    support = [lookup(feet, name, "env.support") for name in config.support]
    soles = set(config.robot.floor_contacts)
    geoms = [geom for body in _legs(spec, self.watched_feet(config)) for geom in body.geoms]
    geoms = [geom for geom in geoms if geom.contype or geom.conaffinity]
    self.leg_geoms = [geom.name for geom in geoms if geom.name not in soles]
    add_floor_contacts(spec, self.leg_geoms)
    lifted = [name for name in feet if name not in support]
    self.lifted_joints = [joint.name for body in _legs(spec, lifted) for joint in body.joints]
    return spec

  def watched_feet(self, config: Any) -> list[str]:
    """Returns the feet whose legs must touch the floor with nothing but the foot."""
    return list(config.support)

  def make_robot(self, mj_model: mujoco.MjModel, config: Any) -> LeggedRobot:
    robot = super().make_robot(mj_model, config)
    robot.joint_groups["lifted_legs"] = [re.escape(joint) for joint in self.lifted_joints]
    robot.add_contact_group("leg_contact", [f"{geom}_floor_found" for geom in self.leg_geoms])
    return robot


def _legs(spec: mujoco.MjSpec, feet: Iterable[str]) -> list[mujoco.MjsBody]:
  """The bodies between the robot's first one and the foot sites; raises UnknownNameError."""
  root, bodies = spec.worldbody.first_body().name, []
  sites = {site.name: site for site in spec.sites}
  for foot in feet:
    body = lookup(sites, foot, "env.robot.feet").parent
    while body.name != root:
      bodies.append(body)
      body = body.parent
  return bodies
