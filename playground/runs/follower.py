"""What the other processes of a training do with what their loop reports: nothing but stop when process 0 does."""

from typing import TYPE_CHECKING, Any

from playground.envs.base import Env
from playground.learning.loop import Metrics
from playground.learning.rollout import Step
from playground.runs.interrupts import Interrupts
from playground.runs.job import check_fraction, check_updates

if TYPE_CHECKING:
  from playground.config import RunConfig


class Follower:
  """The loop's callbacks of a process that writes nothing (`learning.loop.Callbacks`)."""

  def __init__(self, config: "RunConfig", env: Env, interrupts: Interrupts, step: int | None):
    self._allowed = config.on_nonfinite.max_fraction
    self._action_repeat = env.action_repeat
    self._interrupts = interrupts
    self._step = step or 0

  def on_metrics(self, step: int, metrics: Metrics, captured: Step | None, recording: Any) -> None:
    taken, self._step = step - self._step, step
    bad = metrics.get("training/nonfinite", 0.0)
    check_fraction(bad * self._action_repeat / max(taken, 1), self._allowed, step)
    check_updates(metrics, self._allowed, step)

  def on_save(self, update: int, step: int, state: Any, final: bool) -> None:
    """Process 0 saves."""

  def should_stop(self) -> bool:
    return self._interrupts.signum is not None
