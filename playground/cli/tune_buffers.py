"""`playground tune-buffers <task>`: measures the sizes that Warp's buffers need."""

from collections.abc import Callable, Sequence

from rich.console import Console
from rich.table import Table

from playground import registry
from playground.config import compose, config_dict, format_value, of_task
from playground.envs.wrappers import wrap_for_training
from playground.errors import ConfigError
from playground.physics.warp_buffer_sizes import ROOM, Act, BufferSizes, measure_buffers
from playground.runs.loaded_policy import load_policy
from playground.runs.progress import Progress

# Key of a task's config -> content of the buffer, and its largest use as text.
_BUFFERS: dict[str, tuple[str, Callable[[BufferSizes], str]]] = {
  "njmax": ("constraint rows of one environment", lambda sizes: str(sizes.constraints)),
  "naconmax_per_env": ("contacts or candidate pairs, mean of the environments", lambda sizes: f"{sizes.contacts:.2f}"),
  "naccdmax_per_env": ("convex ones of these, rounded up to a power of 2", lambda sizes: str(sizes.convex)),
}


def tune_buffers(task: str, overrides: Sequence[str], *, run: str | None, envs: int, steps: int) -> int:
  """Rolls a task out on Warp, and prints the largest use of each buffer and the advised size.

  Args:
    task: its name.
    overrides: as for playground-run.
    run: a run or checkpoint of the task whose policy acts, beside random actions; without overrides, the task has the
      run's configuration.
    envs: number of environments.
    steps: policy steps in each environment.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such task or run, or one that does not fit; Warp is not installed.
  """
  composed = compose(of_task(task, overrides))
  task, config = composed.choices["env"], composed.env
  policies: dict[str, Act | None] = {"random": None}
  if run is not None:
    trained = load_policy(run)
    if trained.task != task:
      raise ConfigError(f"--run={run} is one of {trained.task}, not of {task}.")
    policies["trained"] = trained.act
    config = config if overrides else trained.config.env
  build = lambda sizes: wrap_for_training(registry.build(config_dict({**config.to_dict(), **sizes})))
  found = []
  with Progress(envs * steps, activity="rollout", console=Console(stderr=True)) as progress:
    for name, act in policies.items():
      compiles = lambda sizes, name=name: progress.phase(f"{name} policy: compiling with {sizes}")
      done = lambda count: progress.update(envs * count)
      found.append(measure_buffers(build, config.njmax, act, envs, steps, on_try=compiles, on_steps=done))
  console = Console()
  advice = [sizes.advised() for sizes in found]
  table = Table(title=f"{task} on Warp, {envs} environments, {steps} policy steps")
  table.add_column("most needed", no_wrap=True)
  for column in (*policies, f"advised (x {ROOM:g})", "configured"):
    table.add_column(column, justify="right")
  for key, (_, needed) in _BUFFERS.items():
    sizes = [str(max(advised[key] for advised in advice)), format_value(config[key])]
    table.add_row(f"env.{key}", *map(needed, found), *sizes)
  console.print(table)
  for key, (what, _) in _BUFFERS.items():
    console.print(f"{key}: {what}")
  return 0
