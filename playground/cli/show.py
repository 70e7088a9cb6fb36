"""`playground show <task>`: prints observations, rewards, terminations, commands, events, hyperparameters."""

import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from playground import registry
from playground.config import RunConfig, compose, format_value, of_task
from playground.console import wide_console
from playground.errors import ConfigError
from playground.mdp.options import MODEL_FIELD, is_model_field
from playground.settings import Plain, Section, nodes
from playground.text import first_docstring_line

if TYPE_CHECKING:
  from playground.envs.base import Env
  from playground.mdp.terms import Term

Row = Section


def show(task: str, overrides: Sequence[str], *, views: str | None = None, num_views: int | None = None) -> int:
  """Prints tables about a task, or writes images of its camera.

  Args:
    task: a task, or `randomization=<name>` alone for its events.
    overrides: as for playground-run.
    views: image file to write instead of the tables: the camera's view on randomised models.
    num_views: models in the image; None is 16.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such task, or an invalid one.
  """
  console = wide_console(180)
  if num_views is not None and not views:
    raise ConfigError(f"--num-views={num_views} needs --views=<file>.")
  if task.startswith("randomization=") and not overrides:
    if views:
      raise ConfigError("--views shows a task: playground show <task> randomization=<name> --views <file>.")
    config = compose([task])
    console.print(_table(task.replace("=", ": "), list(_events(config.env.get("events")))))
    return 0
  config = compose(of_task(task, overrides))
  env = registry.build(config.env)
  if views:
    from playground.rendering.views import save_views

    console.print(f"wrote {save_views(env, config.env.events, views, num_views or 16, config.seed)}")
    return 0
  for part in describe(config, env):
    console.print(part)
  return 0


def describe(config: RunConfig, env: "Env") -> Iterator[RenderableType]:
  """Yields tables: sizes and rates, observations, rewards, terminations, commands, events, hyperparameters."""
  from playground.randomization import Randomizer

  section, choices = config.resolved["env"], config.choices
  # An event without a target raises before the first table.
  Randomizer(env.mj_model, config.env.get("events") or {}, impl=env.impl)
  metrics = env.trace().metrics
  yield _facts(choices["env"], _facts_of(env, section, choices))
  yield _table("observations", list(_observations(env)))
  yield _table("rewards", list(_rewards(env, metrics)))
  yield _table("terminations", [_row(term) for term in _terms(env, "terminations")])
  yield _table("commands", [_row(term) for term in _terms(env, "commands")])
  chosen = choices.get("randomization")
  yield _table(f"events (randomization: {chosen})" if chosen else "events", list(_events(config.env.get("events"))))
  origin = f"tuned/{choices['tuned']}.yaml" if choices.get("tuned") else "defaults, not tuned for this task"
  yield _facts(
    f"{config.agent_name} ({origin})",
    ((k, v) for k, v in nodes(config.resolved["agent"]) if not isinstance(v, Mapping)),
  )


def _facts_of(env: "Env", section: Section, choices: Section) -> Iterator[tuple[str, Plain]]:
  yield "class", section["task"]
  yield "what", inspect.getdoc(type(env.unwrapped)) or ""
  yield "robot", choices.get("robot") or "its own"
  yield "action", f"{env.action_size} in [-1, 1]"
  ctrl = [f"[{low:g}, {high:g}]" for low, high in dict.fromkeys(map(tuple, env.mj_model.actuator_ctrlrange))]
  yield "actuators", f"{env.mj_model.nu}, ctrl in {', '.join(ctrl)}"
  yield "control", f"{1 / env.dt:g} Hz ({env.dt:g} s), each action applied {env.action_repeat} x"
  yield "physics", f"{1 / env.sim_dt:g} Hz ({env.sim_dt:g} s), {env.n_substeps} per control step"
  yield "episode", f"{env.episode_length} control steps ({env.episode_length * env.dt:g} s)"
  renders = section.get("vision", {}).get("enable")
  auto = "auto: warp, to render" if renders else f"auto: jax on CPU, {section['cuda_impl']} on an NVIDIA GPU"
  yield "backend", auto if section["impl"] == "auto" else section["impl"]
  if "reward_total" in section:
    clip = section["reward_clip"] and f", clipped to {format_value(section['reward_clip'])}"
    yield "reward", f"{section['reward_total']} of the terms{clip or ''}"
  if section.get("observation_frames", 1) > 1:
    yield "observation", f"state of {section['observation_frames']} steps, the newest first"
  if section.get("noise_level", 1) != 1:
    yield "noise", f"times {section['noise_level']:g}"


def _terms(env: "Env", kind: str) -> "list[Term]":
  return getattr(getattr(env.unwrapped, kind, None), "terms", [])


def _row(term: "Term") -> dict[str, Plain]:
  """Returns the cells that terms of all kinds share."""
  return {
    "name": term.name,
    "function": function_and_source(term.func, term.name),
    "params": _params(term.params),
    "what": first_docstring_line(term.func),
  }


def _rewards(env: "Env", metrics: Section) -> Iterator[Row]:
  """Lists reward terms; those that a task computes itself have no weight."""
  terms = _terms(env, "rewards")
  own = [name.removeprefix("reward/") for name in metrics if name.startswith("reward/")]
  reward = getattr(type(env.unwrapped), "reward", None)
  for name in (name for name in own if name not in {term.name for term in terms}):
    yield {"name": name, "function": function_and_source(reward) if reward else "the task's own"}
  for term in terms:
    row, what = _row(term), term.options.when
    yield row | {"weight": f"{term.options.weight:g}", "when": _params(what or {}).replace("_", " ")}


def _observations(env: "Env") -> Iterator[Row]:
  """Lists observation terms by group, the whole group first."""
  manager = getattr(env.unwrapped, "observations", None)
  parts = env.observation_parts or {"state": {}}
  sizes = env.observation_size
  for group, names in parts.items():
    size = sizes[group] if isinstance(sizes, Mapping) else (sizes,)
    yield {"group": group, "size": " x ".join(map(str, size))}
    bound = {term.name: term for term in manager.groups.get(group, ())} if manager else {}
    for name, length in names.items():
      yield {"name": name, "size": str(length)} | (_observation(bound[name], group) if name in bound else {})


def _observation(term: "Term", group: str) -> dict[str, Plain]:
  if group != "state" and term.name == "state":
    return {"what": "The group state, as the policy reads it."}
  options = term.options
  return _row(term) | {
    "noise": _params(options.noise or {}),
    "scale": "" if options.scale is None else format_value(options.scale),
    "clip": "" if options.clip is None else format_value(options.clip),
    "delay": "" if options.delay is None else format_value(options.delay),
    "history": "" if options.history == 1 else str(options.history),
  }


def _events(events: Section | None) -> Iterator[Row]:
  """Lists events by mode, in the order in which they apply."""
  from playground.mdp.terms import bind_one

  for name, entry in (events or {}).items():
    if entry is None:
      continue
    term = bind_one("events", f"env.events.{name}", name, entry)
    row = _row(term) | {"mode": term.options.mode, "enabled": "" if term.options.enabled else "no"}
    if is_model_field(name, entry):
      drawn = term().describe()
      what = f"{drawn['field']} {drawn['target']}: {drawn['operation']} {drawn['draw']}"
      source = function_and_source(term.func, term.func.__name__)
      row |= {"params": what, "what": "", "function": f"{MODEL_FIELD} {source}"}
    yield row


def function_and_source(func: Callable[..., object], known: str = "") -> str:
  """Returns a function's name unless it is `known`, and its file and line from the top of its package."""
  target = inspect.unwrap(func)
  path = Path(inspect.getsourcefile(target) or "?")
  depth = target.__module__.count(".") + (2 if path.stem == "__init__" else 1)
  lines = inspect.getsourcelines(sys.modules[target.__module__])[0]
  assigned = (i for i, text in enumerate(lines, 1) if text.startswith(f"{target.__name__} = "))  # `name = helper(...)`
  place = f"{'/'.join(path.parts[-depth:])}:{next(assigned, inspect.getsourcelines(target)[1])}"
  return place if target.__name__ == known else f"{target.__qualname__} {place}"


def _params(params: Section) -> str:
  return ", ".join(f"{name} {format_value(value)}" for name, value in params.items())


_COLUMNS = (
  *("group", "name", "weight", "mode", "enabled", "size", "noise", "scale", "clip", "delay", "history"),
  *("params", "when", "what", "function"),
)


def _table(title: str, rows: Sequence[Row]) -> RenderableType:
  """Builds a table of the columns that any row has; `none` without rows."""
  columns = [name for name in _COLUMNS if any(row.get(name) for row in rows)]
  table = Table(box=None, padding=(0, 2, 0, 0))
  for name in columns:
    table.add_column(name, style="cyan" if name == "name" else None, overflow="fold", no_wrap=name in ("name", "group"))
  for row in rows:
    table.add_row(*(Text(str(row.get(name) or "")) for name in columns))
  return Group(Text(title, style="bold"), table if rows else Text("none"), Text())


def _facts(title: str, rows: Iterable[tuple[str, Plain]]) -> RenderableType:
  """Builds a table of keys and values."""
  table = Table(show_header=False, box=None, padding=(0, 2))
  for key, value in rows:
    table.add_row(Text(key, style="cyan"), Text(format_value(value)))
  return Group(Text(title, style="bold"), table, Text())
