"""Checks whether runs can be a population, whose agents learn from each other (`playground.learning.population`)."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from playground.errors import ConfigError, UnknownNameError, nearest
from playground.learning.population import Population
from playground.limits import Limit
from playground.runs.programs import program_of
from playground.settings import settings

if TYPE_CHECKING:
  from playground.config import RunConfig

KEEP = 3  # a run may have saved a step while another still writes the one before, so that its newest is older still


def population_of(configs: "Sequence[RunConfig]", exploit_every: int, explore: Sequence[str]) -> Population | None:
  """Returns the population of the runs, None where `exploit_every` is 0.

  Raises:
    ConfigError: there is only one run, the runs differ in program or task, so that returns are not comparable, they
      keep fewer than `KEEP` checkpoints, have too few evaluations for an exchange, or PPO adapts the learning rate that
      the population would set.
    UnknownNameError: a key of `explore` is not one of the agent's numbers that are arguments of the program.
  """
  if not exploit_every:
    return None
  if len(configs) < 2 or len({program_of(config) for config in configs}) > 1 or program_of(configs[0]) is None:
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
