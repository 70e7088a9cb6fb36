"""`playground tune-buffers <task>`: what Warp's buffers must hold."""

from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from playground.config import compose, format_value
from playground.errors import ConfigError
from playground.learning.buffers import ROOM, Act, BufferSizes, measure_buffers
from playground.runs.trained import load_trained

# By key of a task's config: what it bounds, and how much of that was needed.
_BUFFERS: dict[str, tuple[str, Callable[[BufferSizes], str]]] = {
  "njmax": ("constraint rows of one environment", lambda sizes: str(sizes.constraints)),
  "naconmax_per_env": ("contacts or candidate pairs, mean", lambda sizes: f"{sizes.contacts:.2f}"),
  "naccdmax_per_env": ("of these convex, to a power of 2", lambda sizes: str(sizes.convex)),
}


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
  found = [measure_buffers(config.env, act, envs, steps) for act in policies.values()]
  advice = [sizes.advised() for sizes in found]
  table = Table(title=f"{task} on Warp, {envs} environments, {steps} decisions: the most that was needed")
  table.add_column("buffer")
  for column in (*policies, f"advised, {ROOM:g} x the most", "configured"):
    table.add_column(column, justify="right", overflow="fold")
  for key, (what, needed) in _BUFFERS.items():
    sizes = [str(max(advised[key] for advised in advice)), format_value(config.env[key])]
    table.add_row(f"env.{key}\n  {what}", *map(needed, found), *sizes)
  Console().print(table)
  return 0
