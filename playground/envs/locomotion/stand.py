"""Stand on some of the feet, handstand and footstand: one task for all robots, composed by config."""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from playground.envs.base import State
from playground.envs.locomotion.legged import LeggedTask
from playground.envs.physics import mjx
from playground.mdp.keys import split_keys
from playground.mdp.legged import Context
from playground.mdp.lookup import lookup
from playground.robots.scene import add_floor_contacts, configured_scene


class Stand(LeggedTask):
  """Rears up onto the feet of `support`: the front ones for a handstand, the hind ones for a footstand.

  The other legs should be in the air, in their default pose. An episode also ends when a part of a supporting leg other
  than its foot touches the floor. Actions move the targets on from where they were. (Paper: appendix "Locomotion".)

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - what ends an episode are the legs that the robot should stand on (0.2.0 watches the front ones in a footstand, too);
  - what costs contact are the feet that should be in the air (in 0.2.0 all, so that standing costs as much).

  Attributes:
    leg_geoms: names of the geoms that end an episode when they touch the floor.
  """

  def __init__(self, config: Any):
    super().__init__(config)
    self._crouch_probability: float = config.reset.crouch_probability
    keyframe = config.reset.crouch_keyframe  # of the robots that have one
    self._crouch_qpos = self.robot.keyframe(keyframe) if self._crouch_probability > 0 else self.robot.init_qpos

  def _scene(self, config: Any) -> mujoco.MjSpec:
    spec = configured_scene(config)
    feet = {name: name for name in config.robot.feet}
    support = [lookup(feet, name, "env.support") for name in config.support]
    lifted = [name for name in feet if name not in support]
    watched = list(feet)[:2] if config.parity else support  # the first two are the front ones of 0.2.0's only robot
    soles = set(config.robot.floor_contacts)
    geoms = [geom for body in _legs(spec, watched) for geom in body.geoms if geom.contype or geom.conaffinity]
    self.leg_geoms = [geom.name for geom in geoms if geom.name not in soles]
    add_floor_contacts(spec, self.leg_geoms)
    names = {joint.name for body in _legs(spec, lifted) for joint in body.joints}
    self._facts = {
      "pose_weights": [float(name in names) for name in config.robot.joints],
      "lifted_feet": np.array([i for i, name in enumerate(feet) if config.parity or name in lifted], int),
    }
    return spec

  def _reward_facts(self) -> dict[str, Any]:
    return self._facts

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    model = self.mjx_model if model is None else model
    rng, keys = split_keys(rng, ("crouch", *self._spread_draws))
    crouched = jax.random.bernoulli(keys["crouch"], self._crouch_probability)
    qpos, qvel = self._spread_start(keys, jnp.where(crouched, self._crouch_qpos, self.robot.init_qpos))
    return self._first_state(self._start(model, qpos, jnp.where(crouched, 0.0, qvel)), {"rng": rng})

  def _terminated(self, now: Context) -> jax.Array:
    addresses = np.array([self.mj_model.sensor(f"{geom}_floor_found").adr[0] for geom in self.leg_geoms], int)
    return super()._terminated(now) | (now.data.sensordata[addresses] > 0).any()


def _legs(spec: mujoco.MjSpec, feet: Iterable[str]) -> list[mujoco.MjsBody]:
  """The bodies between the robot's first one and the foot sites."""
  root, bodies = spec.worldbody.first_body().name, []
  for foot in feet:
    body = spec.site(foot).parent
    while body.name != root:
      bodies.append(body)
      body = body.parent
  return bodies
