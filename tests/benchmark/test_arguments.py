"""`key=value` arguments: types, lists, overrides of the run, and what is said about mistakes."""

import dataclasses

import pytest

from playground.benchmark.arguments import help_of, option, parse
from playground.errors import ConfigError, UnknownNameError


@dataclasses.dataclass(frozen=True)
class Some:
  """A command."""

  tasks: tuple[str, ...] = option((), "names")
  counts: tuple[int, ...] = option((1, 2), "numbers")
  seconds: float = option(4.0, "time")
  out: str | None = option(None, "file")
  rerun: bool = option(False, "again")
  overrides: tuple[str, ...] = option((), "of the run")


@dataclasses.dataclass(frozen=True)
class Plain:
  """A command that runs nothing."""

  out: str = option("here", "folder")


def test_types_and_lists():
  given = ["tasks=A,B", "counts=[4, 1e3]", "seconds=2", "rerun=true", "agent.num_envs=64", "hardware=cpu"]
  assert parse("some", Some, given) == Some(
    ("A", "B"), (4, 1000), 2.0, rerun=True, overrides=("agent.num_envs=64", "hardware=cpu")
  )
  assert parse("some", Some, ["out=null"]).out is None
  assert parse("some", Some, ["tasks=A,B,A", "counts=2,2.0"]) == Some(("A", "B"), (2,)), "each once"
  assert parse("some", Some, []) == Some()


@pytest.mark.parametrize(
  ("argument", "message"),
  [
    ("task=A", "Did you mean 'tasks'?"),
    ("tasks", "write key=value"),
    ("seconds=soon", "seconds=soon must be a number."),
    ("counts=1.5", "must be a whole number"),
    ("rerun=1", "must be true or false"),
    ("overrides=x", "no key"),
  ],
)
def test_a_mistake_is_a_sentence(argument: str, message: str):
  with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
    parse("some", Some, [argument])


def test_keys_are_given_once_and_overrides_only_where_something_runs():
  with pytest.raises(ConfigError, match="twice"):
    parse("some", Some, ["seconds=1", "seconds=2"])
  with pytest.raises(UnknownNameError):
    parse("plain", Plain, ["agent.num_envs=64"])


def test_help_shows_defaults():
  assert help_of(Plain) == ["  out=here  folder"]
