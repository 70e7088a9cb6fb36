"""What tasks of ALOHA's two arms share: scene, actions, and a reward that is a weighted mean."""

from collections.abc import Mapping
from typing import ClassVar

import jax

from playground.envs.manipulation.tabletop import TabletopTask


class Bimanual(TabletopTask):
  """Two arms at a table; an action adds to the targets of the servos of all joints and of both grippers.

  The terms' weighted mean is the potential that a task pays, or pays for raising. The model is that of Playground
  0.2.0, its upstream bug included: capsules `right_finger_bottom` lie across the palm instead of along the finger.
  """

  arm_joints = r"(left|right)/(?!.*_finger).*"
  summaries: ClassVar[Mapping[str, str]] = {"success": "last", "position_error_cm": "last"}

  def total(self, rewards: Mapping[str, jax.Array]) -> jax.Array:
    return super().total(rewards) / sum(term.options.weight for term in self.rewards.terms)
