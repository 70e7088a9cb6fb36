"""`key=value` arguments: types, lists, overrides of the run, and what is said about mistakes."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated, Any

import pytest

from playground.benchmark.arguments import check_limits, help_of, parse
from playground.errors import ConfigError, UnknownNameError
from playground.limits import counts, positive


@dataclasses.dataclass(frozen=True)
class Some:
  """A command."""

  tasks: Annotated[Sequence[str], "names"] = ()
  sizes: Annotated[Sequence[int], counts(1), "numbers"] = (1, 2)
  seconds: Annotated[float, positive(), "time"] = 4.0
  out: Annotated[str | None, "file"] = None
  rerun: Annotated[bool, "again"] = False
  overrides: Annotated[Sequence[str], "of the run"] = ()


@dataclasses.dataclass(frozen=True)
class Plain:
  """A command that runs nothing."""

  out: Annotated[str, "folder"] = "here"


def test_types_and_lists():
  given = ["tasks=A,B", "sizes=[4, 1e3]", "seconds=2", "rerun=true", "agent.num_envs=64", "++hardware=cpu"]
  assert parse("some", Some, given) == Some(
    ("A", "B"), (4, 1000), 2.0, rerun=True, overrides=("agent.num_envs=64", "++hardware=cpu")
  )
  assert parse("some", Some, ["out=null"]).out is None and parse("some", Some, ["rerun=True"]).rerun
  assert parse("some", Some, ["tasks=A,B,A", "sizes=2,2.0"]) == Some(("A", "B"), (2,)), "each once"
  assert parse("some", Some, ["tasks=['A', \"B\"]"]).tasks == ("A", "B"), "as Hydra reads quotes"
  assert parse("some", Some, []) == Some()


@pytest.mark.parametrize(
  ("argument", "message"),
  [
    ("task=A", "Did you mean 'tasks'?"),
    ("tasks", "write key=value"),
    ("seconds=soon", "seconds=soon must be a number above 0"),
    ("seconds=1,2", "seconds=1,2 must be a number above 0"),
    ("sizes=1.5", "sizes=1.5 must be a list of whole numbers from 1"),
    ("rerun=1", "must be true or false"),
    ("overrides=x", "no key"),
  ],
)
def test_a_mistake_is_a_sentence(argument: str, message: str):
  with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
    parse("some", Some, [argument])


@pytest.mark.parametrize(
  ("changes", "message"),
  [
    ({"seconds": float("nan")}, "seconds=nan must be a number above 0"),
    ({"sizes": (1, 0)}, r"sizes=\[1, 0\] must be a list of whole numbers from 1"),
    ({"sizes": ()}, "sizes= is empty: name at least one"),
  ],
)
def test_what_is_not_within_its_limits_is_a_sentence(changes: dict[str, Any], message: str):
  check_limits(Some())
  with pytest.raises(ConfigError, match=message):
    check_limits(Some(**changes))


def test_keys_are_given_once_and_overrides_only_where_something_runs():
  with pytest.raises(ConfigError, match="twice"):
    parse("some", Some, ["seconds=1", "seconds=2"])
  with pytest.raises(UnknownNameError):
    parse("plain", Plain, ["agent.num_envs=64"])


def test_help_shows_defaults():
  assert help_of(Plain) == ["  out=here  folder"]
