"""Limits of numbers, which a key's definition states: `Annotated` metadata of a dataclass, or a line of a table."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Annotated, Literal

MOST = 1e9  # of any number without a limit of its own: its square fits float32


@dataclasses.dataclass(frozen=True)
class Limit:
  """The numbers that are allowed.

  Attributes:
    low, high: the smallest and the largest number.
    above: whether `low` itself is excluded.
    whole: whether only whole numbers are allowed.
    form: a number, a list of numbers, or either.
    length: of a list; None is any.
    rising: whether a list must not fall, as in [from, to].
  """

  low: float = -MOST
  high: float = MOST
  above: bool = False
  whole: bool = False
  form: Literal["number", "list", "either"] = "number"
  length: int | None = None
  rising: bool = False

  @property
  def each(self) -> "Limit":
    """The same for a number, or for each number of a list that is not empty."""
    return dataclasses.replace(self, form="either")

  def allows(self, value: object) -> bool:
    """Whether a value is within the limit."""
    if not isinstance(value, list | tuple):
      return self.form != "list" and self._allows_number(value)
    return (
      self.form != "number"
      and (self.form == "list" or len(value) > 0)
      and self.length in (None, len(value))
      and all(map(self._allows_number, value))
      and not (self.rising and sorted(value) != list(value))
    )

  def _allows_number(self, value: object) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool) or value != value:
      return False
    if not self.low <= value <= self.high or (self.above and value == self.low):
      return False
    return isinstance(value, int) or not self.whole  # composing makes 1e6 an int where the default is one

  def __str__(self) -> str:
    """What is allowed, to follow 'must be'."""
    one, many = "a whole number" if self.whole else "a number", "whole numbers" if self.whole else "numbers"
    listed = f"{self.length} {many}" if self.length else f"a list of {many}"
    what = {"number": one, "list": listed, "either": f"{one} or {listed}"}[self.form]
    lowest = f"above {_short(self.low)} and at most" if self.above else f"from {_short(self.low)} to"
    return f"{what} {lowest} {_short(self.high)}" + ", the first not above the second" * self.rising


def positive(high: float = MOST) -> Limit:
  return Limit(0, high, above=True)


def at_least_0(high: float = MOST) -> Limit:
  return Limit(0, high)


def count(low: int, high: float = 1e6) -> Limit:
  """A whole number, from `low` on."""
  return Limit(low, high, whole=True)


def counts(low: int, high: float = 1e6) -> Limit:
  """A list of whole numbers, from `low` on."""
  return Limit(low, high, whole=True, form="list")


def span(low: float = 0) -> Limit:
  """A range [from, to]."""
  return Limit(low, form="list", length=2, rising=True)


SHARE = Limit(0, 1)
SEED = count(0, 2**32 - 1)
VECTOR = Limit(form="list", length=3)
SIZES = Limit(1, 65536, whole=True, form="list")  # of layers

# Types of parameters of terms.
Positive = Annotated[float, positive()]
AtLeast0 = Annotated[float, at_least_0()]
Share = Annotated[float, SHARE]
Span = Annotated[Sequence[float], span()]
Vector = Annotated[Sequence[float], VECTOR]


def _short(number: float) -> str:
  exact = f"{number:.0f}" if number == math.floor(number) else f"{number:g}"
  return exact if len(exact) <= 12 else f"{number:g}"
