"""Identifies runs with the same compiled program: they can train together, as a population, too, or load it later."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from playground import fingerprint
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.hardware.distributed import is_multiprocess
from playground.hardware.setup import Hardware
from playground.learning.population import Population
from playground.learning.stored_program import StoredProgram
from playground.learning.trainer import Trainer
from playground.limits import Limit
from playground.mdp.options import is_model_field
from playground.registry import task_class
from playground.settings import Plain, below, settings

if TYPE_CHECKING:
  from playground.config import RunConfig

KEEP = 3  # a run may have saved a step while another still writes the one before, so that its newest is older still


def program_of(config: "RunConfig") -> str | None:
  """Returns the settings that a run's compiled program depends on, as text; runs with equal texts can train together.

  Returns:
    None for a run that trains alone: a chain, a run that W&B tracks (one run a process), a profiled run, a run on
    several machines, and one with `hardware.scale_envs`.
  """
  hardware = config.hardware
  sized = hardware.distributed.enable or hardware.scale_envs  # by the devices of this start
  if config.stages or config.tracking.wandb.enable or config.profile.enable or sized:
    return None
  names = [name for name in config.resolved if name not in ("seed", "run_dir", "resume", "init_from")]
  try:
    return _structure(config, names, config.init_from is not None)
  except ConfigError:  # the run reports its invalid term when it starts
    return None


def share_program(configs: Sequence["RunConfig"]) -> bool:
  """Returns whether runs can train together."""
  first, *others = {program_of(config) for config in configs}
  return first is not None and not others


def population_of(configs: Sequence["RunConfig"], exploit_every: int, explore: Sequence[str]) -> Population | None:
  """Returns the population of the runs, None where `exploit_every` is 0.

  Raises:
    ConfigError: there is only one run, the runs differ in program or task, so that returns are not comparable, they
      keep fewer than `KEEP` checkpoints, have too few evaluations for an exchange, or PPO adapts the learning rate that
      the population would set.
    UnknownNameError: a key of `explore` is not one of the agent's numbers that are arguments of the program.
  """
  if not exploit_every:
    return None
  if len(configs) < 2 or not share_program(configs):
    raise ConfigError(
      f"launcher.exploit_every={exploit_every} needs two or more jobs that train in one program: these are "
      f"{len(configs)} that differ in more than seeds and numbers (docs/sweeps.md)."
      if len(configs) > 1
      else f"launcher.exploit_every={exploit_every} needs two or more jobs, such as 'seed=range(8)'."
    )
  if any(config.resolved["env"] != configs[0].resolved["env"] for config in configs):
    raise ConfigError(
      f"launcher.exploit_every={exploit_every} compares returns, so all jobs need the same env: vary seed and agent."
    )
  if (keep := min(config.checkpoint.keep for config in configs)) < KEEP:
    raise ConfigError(
      f"checkpoint.keep={keep} must be {KEEP} or more with launcher.exploit_every: after a kill the jobs go on from a "
      "step that all have, and their newest checkpoints may be two apart."
    )
  if (evals := min(config.agent.num_evals for config in configs)) < exploit_every + 2:
    raise ConfigError(
      f"agent.num_evals={evals} must be {exploit_every + 2} or more with launcher.exploit_every={exploit_every}: the "
      "evaluations before and after training change nothing."
    )
  agent, known = configs[0].agent, [f"agent.{name}" for name in configs[0].agent.traced]
  for key in explore:
    if key not in known:
      raise UnknownNameError(f"launcher.explore={key} must be one of {', '.join(known)}.{nearest(key, known)}")
  rate = "agent.learning_rate"
  if rate in explore and getattr(agent, "desired_kl", None) is not None:
    raise ConfigError(
      f"launcher.explore={rate} has no effect with agent.desired_kl, which adapts the rate: name other keys, or set "
      "agent.desired_kl=null."
    )
  limits = {key: settings(type(agent))[key.removeprefix("agent.")].limit or Limit() for key in explore}
  return Population(exploit_every, limits, configs[0].seed)


def stored_program(
  config: "RunConfig", trainer: Trainer, hardware: Hardware, *, from_policy: bool, resets: bool, num_recorded: int
) -> StoredProgram | None:
  """Returns the file of a run's compiled functions, named by the hash of everything that determines them.

  The hash covers the sections of the configuration that `train.prepare` builds from, without the schedule and the
  numbers that are arguments; the task's values and arrays; the code, the versions and the machine (`fingerprint`).

  Args:
    config: of the run.
    trainer: of the run.
    hardware: of the process.
    from_policy: whether the initial state is made from a policy.
    resets: whether the schedule resets all environments.
    num_recorded: recorded episodes of an evaluation, on each device.

  Returns:
    None where functions are not stored: without JAX's compilation cache, on several machines, on Warp (its functions
    hold addresses of this process), and for a task from a notebook.
  """
  env, cache = trainer.env.unwrapped, hardware.machine["compilation_cache"]
  if not cache or "://" in str(cache) or is_multiprocess() or env.impl == "warp":
    return None
  placeholders = {name: np.ones_like(value) for name, value in trainer.settings.items()}
  task = env.with_settings(below("env", placeholders))
  numbers = [env.config, *(getattr(env, name) for name in env.managers)]  # methods bound to `env` refer to these
  # A subclass says for itself that its functions read none of these.
  schedule = [f"agent.{name}" for name in vars(type(config.agent)).get("schedule", ())]
  try:
    parts = {
      "settings": _structure(config, ["env", "agent", "hardware"], from_policy, schedule),
      "resets": resets,
      "recorded": num_recorded,
      "task": fingerprint.of_values(task, without=numbers),
      "arguments": [(name, value.shape) for name, value in placeholders.items()],
      "agents": trainer.num_agents,
      "code": fingerprint.of_code(),
      **fingerprint.of_machine(trainer.mesh),
    }
  except fingerprint.NoFingerprintError:
    return None
  return StoredProgram(Path(str(cache), "programs", f"{fingerprint.digest(parts)}.program"))


def _structure(config: "RunConfig", sections: list[str], from_policy: bool, left_out: Iterable[str] = ()) -> str:
  """Returns sections of a configuration as text, without some keys and the numbers that are arguments of the program.

  Raises:
    ConfigError: a term's number is invalid.
  """
  numbers = task_class(config.resolved["env"]["task"]).settings_of(config.env)
  traced = [*left_out, *(f"agent.{name}" for name in config.agent.traced), *(f"env.{name}" for name in numbers)]
  resolved = without({name: config.resolved[name] for name in sections}, [*traced, *_startup_ranges(config)])
  resolved |= {"init_from": from_policy, "shapes": {name: np.shape(value) for name, value in numbers.items()}}
  return json.dumps(resolved, sort_keys=True, default=str)


def without(values: dict[str, Plain], keys: Iterable[str]) -> dict[str, Plain]:
  """Returns nested values without the given dotted keys."""
  heads: dict[str, list[str]] = {}
  for key in keys:
    head, _, rest = key.partition(".")
    heads.setdefault(head, []).append(rest)
  kept = {name: value for name, value in values.items() if heads.get(name) != [""]}
  return {name: without(value, heads[name]) if name in heads else value for name, value in kept.items()}


def _startup_ranges(config: "RunConfig") -> list[str]:
  """Returns the keys of startup ranges: models are drawn outside the program, for each run."""
  events = {name: entry for name, entry in config.env.events.items() if entry is not None}
  drawn = [name for name, entry in events.items() if is_model_field(name, entry) and entry.get("mode") == "startup"]
  return [f"env.events.{name}.params.{key}" for name in drawn for key in ("range", "mean", "std")]
