"""`playground completion bash|zsh|fish`: completion scripts for shells, and the candidates that they ask for."""

import argparse
import contextlib
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from playground.config import compose, config_roots, task_names
from playground.config.composition import CHOSEN_BY_GROUP
from playground.config.definitions import chosen_names, definition
from playground.config.files import groups, listed_options
from playground.config.run_config import SCALARS, SECTIONS
from playground.errors import PlaygroundError
from playground.settings import Section, select

PROGRAMS = ("playground", "playground-run")
_FLAGS = ("-m", "--multirun", "--cfg", "--help", "--verbose", "--version", "--package")
_OF_TASKS = ("task", "policy", "word", "path")  # positional arguments that may be a task
_SCRIPTS = {
  "bash": """\
_playground() {
  local line=${COMP_LINE:0:COMP_POINT} IFS=$'\\n'
  local word=${line##* } head=
  COMPREPLY=($(playground completion query "$line" 2>/dev/null))
  [[ $word == *[=:]* ]] && head=${word%"${word##*[=:]}"}
  COMPREPLY=("${COMPREPLY[@]#"$head"}")
  [[ ${COMPREPLY[0]} == *[=.] ]] && compopt -o nospace
}
complete -o default -F _playground PROGRAMS
""",
  "zsh": """\
_playground() {
  local -a found
  found=(${(f)"$(playground completion query "${(j: :)words[1,CURRENT]}" 2>/dev/null)"})
  if (( $#found )); then compadd -S '' -- $found; else _files; fi
}
compdef _playground PROGRAMS
""",
  "fish": """\
for program in PROGRAMS
  complete -c $program -a '(playground completion query (commandline -cp | string collect) 2>/dev/null)'
end
""",
}
SHELLS = tuple(_SCRIPTS)


def script(shell: str) -> str:
  """Returns the script that a shell evaluates to complete the commands."""
  return _SCRIPTS[shell].replace("PROGRAMS", " ".join(PROGRAMS))


def candidates(line: str, parser: argparse.ArgumentParser) -> list[str]:
  """Returns the completions of the last word of a command line, sorted.

  Args:
    line: the command line up to the cursor.
    parser: of the program `playground`, with its commands.
  """
  words = _split(line)
  if len(words) + line[-1:].isspace() < 2:
    return []
  program, *words, current = [Path(words[0]).name, *words[1:], *([""] if line[-1:].isspace() else [])]
  if program == "playground" and not words:
    found: Iterable[str] = commands_of(parser)
  elif program == "playground-run" or words[:1] == ["train"]:
    found = _of_run(current, [word for word in words if "=" in word])
  elif program == "playground" and words[0] in commands_of(parser) and words[0] != "bench":
    found = _of_command(commands_of(parser)[words[0]], current, words[1:])
  else:
    found = []
  return sorted({word for word in found if word.startswith(current)})


def _split(line: str) -> list[str]:
  """Splits a line into words; its last quote may still be open."""
  try:
    return shlex.split(line)
  except ValueError:
    return line.split()


def commands_of(parser: argparse.ArgumentParser) -> Mapping[str, argparse.ArgumentParser]:
  """Returns the commands of `playground` by name."""
  (action,) = (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))
  return action.choices


def _of_command(parser: argparse.ArgumentParser, current: str, words: Sequence[str]) -> Iterator[str]:
  """Yields options, values of the previous option, tasks, and overrides where the command takes them."""
  options = {name: action for action in parser._actions for name in action.option_strings}
  before = options.get(words[-1]) if words else None
  if before is not None and before.nargs != 0:
    yield from before.choices or ()
    return
  if current.startswith("-"):
    yield from (name for name, action in options.items() if action.help != argparse.SUPPRESS)
    return
  positional = [action for action in parser._actions if not action.option_strings]
  number = sum(not word.startswith("-") for word in words)
  action = positional[min(number, len(positional) - 1)] if positional else None
  if action is None:
    return
  if action.choices:
    yield from action.choices
  elif action.dest in _OF_TASKS:
    yield from task_names()
  elif action.dest == "prefix":
    yield from (word.rstrip("=") for word in _of_run(current, []))
  elif action.dest == "overrides":
    first = next((word for word in words if not word.startswith("-")), "")
    task = [f"env={first}"] if first in task_names() else []
    yield from _of_run(current, [*task, *(word for word in words if "=" in word)])


def _of_run(current: str, overrides: Sequence[str]) -> Iterator[str]:
  """Yields flags, groups and keys with `=`, and the values of a key in front of a `=`."""
  key, equals, value = current.partition("=")
  roots = config_roots()
  if current.startswith("-"):
    yield from _FLAGS
  elif equals and key in groups(roots):
    done = value.rpartition(",")[0]
    yield from (f"{key}={done},{name}" if done else f"{key}={name}" for name in listed_options(key, roots))
  elif equals:
    yield from (f"{key}={choice}" for choice in _choices(key, overrides))
  elif "." not in current:
    yield from (f"{name}=" for name in (*groups(roots), *SCALARS, "sweep", "terrain") if "/" not in name)
    yield from (f"{name}." for name in SECTIONS)
  else:
    parent = key.rpartition(".")[0]
    node = select(_resolved(overrides), parent)
    for name, inner in node.items() if isinstance(node, Mapping) else ():
      if f"{parent}.{name}" not in CHOSEN_BY_GROUP:
        yield f"{parent}.{name}" + ("." if isinstance(inner, Mapping) and inner else "=")


def _choices(key: str, overrides: Sequence[str]) -> Iterator[str]:
  setting = definition(key, chosen_names(_resolved(overrides)))
  if setting is not None:
    yield from setting.choices or (("true", "false") if isinstance(setting.default, bool) else ())
    yield from ("null",) if setting.nullable else ()


def _resolved(overrides: Sequence[str]) -> Section:
  """Returns the configuration of the words typed so far, or the default one if they do not compose yet."""
  for words in (overrides, [word.partition(",")[0] for word in overrides]):  # a sweep's: the first of several values
    with contextlib.suppress(PlaygroundError):
      return compose(words).resolved
  return compose().resolved
