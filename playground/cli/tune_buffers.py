"""`playground tune-buffers <task>`: what Warp's buffers must hold."""

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from playground.config import compose
from playground.errors import ConfigError
from playground.learning.buffers import ROOM, Act, measure_buffers
from playground.runs.trained import load_trained


def tune_buffers(task: str, overrides: Sequence[str], *, run: str | None, envs: int, steps: int) -> int:
  """Rolls a task out on Warp, prints the most that its steps needed and the sizes advised.

  Args:
    task: its name.
    overrides: as for playground-run.
    run: a run or checkpoint of the task whose policy acts, beside a random one.
    envs: environments.
    steps: decisions of each.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such task or run, or one that does not fit; Warp is not installed.
  """
  if envs < 1 or steps < 1:
    raise ConfigError(f"--envs={envs} and --steps={steps} must be above 0.")
  config = compose([f"env={task}", *overrides])
  policies: dict[str, Act | None] = {"random actions": None}
  if run is not None:
    trained = load_trained(run)
    if trained.task != task:
      raise ConfigError(f"--run={run} is one of {trained.task}, not of {task}.")
    policies[f"policy of {run}"] = trained.act
  table = Table(title=f"{task} on Warp, {envs} environments, {steps} decisions")
  for column in ("", "constraint rows of one environment", "contacts and candidate pairs, mean of all"):
    table.add_column(column, justify="right" if column else "left")
  found = [measure_buffers(config.env, act, envs, steps) for act in policies.values()]
  for name, sizes in zip(policies, found, strict=True):
    table.add_row(name, str(sizes.constraints), f"{sizes.contacts:.2f}")
  advice = [sizes.advised() for sizes in found]
  keys = ("njmax", "naconmax_per_env")
  table.add_row(f"advised, {ROOM:g} x the most", *(f"{key}: {max(sizes[key] for sizes in advice)}" for key in keys))
  table.add_row("configured", *(f"{key}: {config.env[key]}" for key in keys))
  Console().print(table)
  return 0
