"""Which runs have the same compiled program, and so can train together."""

import json
from collections.abc import Iterable
from typing import TYPE_CHECKING

from playground.errors import ConfigError
from playground.mdp.options import is_model_field
from playground.registry import task_class
from playground.settings import Plain

if TYPE_CHECKING:
  from playground.config import RunConfig


def program_of(config: "RunConfig") -> str | None:
  """What a run's compiled program depends on, as text: runs in which it is the same can train together.

  Returns:
    None for a run that trains alone: a chain, one that W&B tracks (it has one run a process), one that is profiled, and
    one on several machines.
  """
  alone = config.stages or config.tracking.wandb.enable or config.profile.enable or config.hardware.distributed.enable
  if alone:
    return None
  try:
    traced = [f"agent.{name}" for name in config.agent.traced]
    traced += [f"env.{name}" for name in task_class(config.resolved["env"]["task"]).settings_of(config.env)]
  except ConfigError:  # which the run itself says, and nobody else's does
    return None
  resolved = without(config.resolved, ["seed", "run_dir", "resume", *traced, *_startup_ranges(config)])
  resolved["init_from"] = config.init_from is not None
  return json.dumps(resolved, sort_keys=True, default=str)


def without(values: dict[str, Plain], keys: Iterable[str]) -> dict[str, Plain]:
  """Returns nested values without those at dotted keys."""
  heads: dict[str, list[str]] = {}
  for key in keys:
    head, _, rest = key.partition(".")
    heads.setdefault(head, []).append(rest)
  kept = {name: value for name, value in values.items() if heads.get(name) != [""]}
  return {name: without(value, heads[name]) if name in heads else value for name, value in kept.items()}


def _startup_ranges(config: "RunConfig") -> list[str]:
  """Keys of what randomised models are drawn from, which is done outside the program for each run."""
  events = {name: entry for name, entry in config.env.events.items() if entry is not None}
  drawn = [name for name, entry in events.items() if is_model_field(name, entry) and entry.get("mode") == "startup"]
  return [f"env.events.{name}.params.{key}" for name in drawn for key in ("range", "mean", "std")]
