"""What tasks of ALOHA's two arms share: scene, actions, episodes that end out of bounds, and a normalised reward."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from playground.envs.base import State
from playground.envs.manipulation.episodes import first_state
from playground.envs.manipulation.tabletop import TabletopTask, Terms, logged, total
from playground.envs.physics import PhysicsData, mjx
from playground.robots.bimanual import build_aloha_scene
from playground.robots.tabletop import contact_addresses


class Bimanual(TabletopTask):
  """Two arms at a table; an action adds to the targets of the servos of all joints and of both grippers.

  A task says how an episode starts, what is observed and which terms its reward has; the terms' weighted mean is the
  potential that it pays, or pays for raising. The model is that of Playground 0.2.0, its slip included: capsules
  `right_finger_bottom` lie across the palm instead of along the finger.

  The defaults differ from Playground 0.2.0 as follows; `env.parity=true` has its ways:
  - the first observation is of the start (0.2.0 computes no forward pass: poses and sensors are 0).
  """

  derived = ("sensordata", "xpos", "xmat", "site_xpos", "site_xmat")
  summaries: ClassVar[Mapping[str, str]] = {"success": "last", "position_error_cm": "last"}

  def __init__(self, config: Any, scene: str):
    """Builds the scene.

    Args:
      config: the task's ConfigDict, see `configs/env/_aloha.yaml`.
      scene: a task of `playground.robots.bimanual`.
    """
    super().__init__(config, build_aloha_scene(scene))
    self._success_distance: float = config.success_distance
    self._table = contact_addresses(self.mj_model, "table")
    names = [self.mj_model.joint(i).name for i in range(self.mj_model.njnt)]
    self._fingers = np.array([i for i, name in enumerate(names) if name.endswith("_finger")])
    arm = [i for i, name in enumerate(names) if name and i not in self._fingers]
    self._arms = {side: np.array([i for i in arm if names[i].startswith(side)]) for side in ("left", "right")}

  @abc.abstractmethod
  def _start(self, rng: jax.Array) -> tuple[jax.Array, dict[str, jax.Array], dict[str, Any]]:
    """Draws an episode's start: the next random key, state fields by name, and entries of `info`."""

  @abc.abstractmethod
  def _observe(self, data: PhysicsData) -> jax.Array:
    """The observation, one vector."""

  @abc.abstractmethod
  def _terms(self, data: PhysicsData) -> Terms:
    """The reward's terms, each within [0, 1] or nearly so."""

  def reset(self, rng: jax.Array, model: mjx.Model | None = None) -> State:
    rng, fields, info = self._start(rng)
    data = self._placed(fields, model)
    return first_state(self, data, self._observe(data), {"rng": rng, **info})

  def _weighted(self, data: PhysicsData) -> tuple[jax.Array, Terms]:
    """The terms' weighted mean, and each term times its weight as it is logged."""
    rewards = self._weigh(self._terms(data))
    return total(rewards) / sum(self._scales.values()), logged(rewards)

  def _no_table_collision(self, data: PhysicsData) -> jax.Array:
    """1 while no finger touches the table."""
    return 1 - (data.sensordata[self._table] > 0).any().astype(jnp.float32)
