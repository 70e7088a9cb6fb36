"""A swimmer of several links that brings its nose to a target (DM Control Suite)."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco

from playground.envs.dm_control.suite import SuiteTask, Terms
from playground.mdp.tolerance import tolerance
from playground.physics.backend import PhysicsData

_ROOT = 3  # x, y and heading come before the joints
_PLANAR = jnp.array([0, 1, 5])  # of a link's velocimeter and gyro: forward, sideways, turning


class Swimmer(SuiteTask):
  """Brings a swimmer's nose to a target in the plane; one motor a joint, actions in [-1, 1].

  Observation [4 links + 1]: joint angles rad, nose to target in the head's frame (x, y) m, velocities of each link,
  head to tail, in its own frame (x, y m/s, z rad/s). The reward is 1 in the target, 0.1 half a metre from its edge.
  """

  domain = "swimmer"
  derived = ("sensordata",)

  def scene(self, config: Any) -> mujoco.MjSpec:
    """The head with a chain of `links - 1` segments behind it, which together can just close to a circle."""
    links = config.links
    spec = super().scene(config)
    visual, inertial, link = (spec.find_default(name) for name in ("visual", "inertial", "link"))
    body = spec.body("head")
    for i in range(links - 1):
      body = body.add_body(name=f"segment_{i}", pos=[0, 0.1, 0])
      body.add_geom(visual, name=f"visual_{i}")
      body.add_geom(inertial, name=f"inertial_{i}")
      body.add_joint(link, name=f"joint_{i}", range=[-360 / links, 360 / links])
      body.add_site(name=f"site_{i}")
      spec.add_actuator(link, name=f"motor_{i}", target=f"joint_{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
      for kind in ("velocimeter", "gyro"):
        sensor = getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
        spec.add_sensor(name=f"{kind}_{i}", type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"site_{i}")
    for camera in ("tracking1", "tracking2"):
      spec.camera(camera).pos *= links / 6
    return spec

  def initial(self, rng: jax.Array) -> dict[str, jax.Array]:
    _, heading_key, joints_key, near_key, target_key = jax.random.split(rng, 5)
    reach = jnp.where(jax.random.bernoulli(near_key, 0.2), 0.3, 2.0)  # a target in five is near
    target = jax.random.uniform(target_key, (2,), minval=-reach, maxval=reach)
    height = self.mj_model.body("target").pos[2]
    return {"qpos": self.draw_planar_pose(heading_key, joints_key), "mocap_pos": jnp.append(target, height)[None]}

  def parts(self, data: PhysicsData) -> dict[str, jax.Array]:
    first = int(self.mj_model.sensor("head_vel").adr[0])  # from here on, six numbers a link
    velocities = data.sensordata[first:].reshape(-1, 6)[:, _PLANAR]
    return {"joints": data.qpos[_ROOT:], "to_target": self._nose_to_target(data), "body_velocities": velocities}

  def reward(self, data: PhysicsData, action: jax.Array) -> tuple[jax.Array, Terms]:
    distance = jnp.linalg.norm(self._nose_to_target(data))
    radius = self.mj_model.geom("target").size[0]
    return tolerance(distance, (0, radius), margin=5 * radius, sigmoid="long_tail"), {}

  def _nose_to_target(self, data: PhysicsData) -> jax.Array:
    offset = self.sensor(data, "target_pos") - self.sensor(data, "nose_pos")
    return jnp.stack([offset @ self.sensor(data, "head_xaxis"), offset @ self.sensor(data, "head_yaxis")])
