"""`playground replay <dump>`: repeats a step that was NaN, infinite or too large, and shows where."""

from pathlib import Path

from rich.console import Console

from playground import config as configs
from playground import registry
from playground.hardware.setup import setup, this_machine
from playground.runs.nonfinite import Dump, nonfinite_fields, nonfinite_results


def replay(file: str) -> int:
  """Prints the values that were NaN, infinite or too large in the dumped step and in its replay here.

  Args:
    file: a run's `nan_dump/step_*.npz`.

  Returns:
    0 if the replay is not finite either, 1 if this machine does not reproduce it.
  """
  console = Console()
  dump = Dump(Path(file))
  run = configs.from_saved(dump.config)
  hardware = setup(this_machine(run.hardware))
  env = registry.load(run.choices["env"], config=run.env)
  before = dump.state(env)
  console.print(f"{run.choices['env']} at physics time {float(before.data.time):.3f} s, action {dump.action.tolist()}")
  console.print(f"physics as recorded: {_listed(nonfinite_fields(dump.after))}")
  bad = nonfinite_results(dump.replay(env))
  console.print(f"replayed on {hardware.machine['device']} with impl={env.impl}: {_listed(bad)}")
  return 0 if bad else 1


def _listed(fields: list[str]) -> str:
  return "NaN, infinite or too large in " + "; ".join(fields) if fields else "all finite"
