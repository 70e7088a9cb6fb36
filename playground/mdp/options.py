"""Keys of a term in a config besides `func` and `params`, for each kind of terms.

This module imports no JAX: the composition of a configuration checks keys with it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from playground.limits import MOST, Limit, count, span

# How an observation term's vector mirrors: each entry keeps its sign (`same`) or changes it (`opposite`); vectors in
# space (`polar`) or of rotation (`axial`); forward, left and turn (`command`); w, x, y, z (`quaternion`); an entry for
# each joint (`joints`) or foot (`feet`), or a vector in space for each foot (`feet_polar`). Longer vectors repeat it.
MirrorKind = Literal["same", "opposite", "polar", "axial", "command", "quaternion", "joints", "feet", "feet_polar"]
_Function = TypeVar("_Function", bound=Callable[..., Any])
_STEPS = Limit(0, 1000, whole=True, form="list", length=2, rising=True)


def mirrors_as(kind: MirrorKind) -> Callable[[_Function], _Function]:
  """Declares how the vector of an observation term's function mirrors (`playground.envs.symmetry`)."""

  def declare(function: _Function) -> _Function:
    function.mirror = kind  # pyright: ignore[reportFunctionMemberAccess]
    return function

  return declare


class RewardOptions(NamedTuple):
  """Keys of a reward term.

  Attributes:
    weight: factor on the function's value; a term of weight 0 is left out.
    when: `{command_above: x}` or `{command_below: x}`, of the norm of the command; otherwise the term is 0.
  """

  weight: float
  when: Mapping[str, float] | None = None


class TerminationOptions(NamedTuple):
  """Keys of a termination term.

  Attributes:
    success: the term ends the episode because the task is done: the metric `fall` does not count it.
    time_out: the term cuts the episode as the time limit does (a truncation): neither the metric `fall` nor the reward
      `is_terminated` counts it.
  """

  success: bool = False
  time_out: bool = False


class CommandOptions(NamedTuple):
  """A command term has no keys besides `func` and `params`."""


class ObservationOptions(NamedTuple):
  """Keys of an observation term, applied in this order.

  Attributes:
    noise: `{uniform: a}` adds U[-a, a), `{gaussian: s}` adds N(0, s²): one number, or one for each element (a shorter
      list repeats). `{same_as: <term>}` adds the noise of another term of the group, of which this one is computed.
    clip: [low, high].
    scale: a factor, or one for each element (a shorter list repeats).
    delay: [low, high]: the value is that of so many steps ago, drawn in every step, both ends included.
    history: the newest value and those before it, newest first; 0 before the episode began, with a `delay` its
      first value.
  """

  noise: Mapping[str, Any] | None = None
  clip: Annotated[Sequence[float], span(-MOST)] | None = None
  scale: Annotated[float, Limit().each] | None = None
  delay: Annotated[Sequence[int], _STEPS] | None = None
  history: Annotated[int, count(1, 1000)] = 1


class EventOptions(NamedTuple):
  """Keys of an event term.

  Attributes:
    mode: `startup` (a model field, drawn once an environment), `reset` (in each episode) or `interval`.
    enabled: false switches the event off; an interval event still writes its entries of `info`.
  """

  mode: str
  enabled: bool = True


MODEL_FIELD = "model_field"  # the func of events that draw a field of the model


def is_model_field(name: str, entry: Any) -> bool:
  """Whether an entry of `env.events` draws a field of the model."""
  return hasattr(entry, "get") and (entry.get("func") or name) == MODEL_FIELD


OPTIONS: dict[str, type] = {
  "rewards": RewardOptions,
  "observations": ObservationOptions,
  "terminations": TerminationOptions,
  "commands": CommandOptions,
  "events": EventOptions,
}


def keys(kind: str) -> tuple[str, ...]:
  """Keys that an entry of a kind (`rewards`, ...) may have."""
  return ("func", "params", *OPTIONS[kind]._fields)  # pyright: ignore[reportAttributeAccessIssue]
