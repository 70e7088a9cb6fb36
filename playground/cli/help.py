"""`playground-run --help`: usage, examples, groups with their options, keys and flags."""

from collections.abc import Iterator

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from playground.config import config_roots
from playground.config.definitions import RunSettings
from playground.config.files import listed_options
from playground.config.run_config import SCALARS
from playground.settings import settings

_USAGE = "playground-run [-m] [group=option ...] [key=value ...] [--cfg job] [--verbose]"
_EXAMPLES = {
  "playground-run": "train CartpoleBalance on this machine",
  "playground-run experiment=go1_joystick": "a task by its experiment",
  "playground-run env=WalkerWalk agent=sac seed=2": "a task and an algorithm, with the hyperparameters tuned for both",
  "playground-run env=Go1JoystickFlatTerrain env.rewards.joint_power_l1.weight=-0.002": "change any key",
  "playground-run resume=results/go1_joystick/<date_time>": "continue a run",
  "playground-run -m env=CartpoleBalance,WalkerWalk 'seed=range(3)'": "a sweep: six runs",
}
# Groups on the page, with their help.
_GROUPS = {
  "env": "the task; `playground list` shows all",
  "experiment": "a task with its training settings",
  "agent": "the algorithm",
  "robot": "the robot of a task that takes several",
  "randomization": "domain randomisation",
  "curriculum": "stages of fine-tuning",
  "hardware": "devices and precision",
  "tracking": "where metrics go",
  "debug": "short runs to try things",
  "launcher": "where a sweep's jobs run",
  "search": "how a sweep chooses values",
}
_MANY = 20  # groups of which only the number of options is shown
_FLAGS = {
  "-m, --multirun": "run a sweep: `key=a,b`, `seed=range(3)`, sweep=<name or file.yaml>",
  "--cfg job": "print the configuration and do not train; --package KEY prints a part of it",
  "--help KEY": "explain a key or section: --help agent, --help env.rewards env=Go1Getup",
  "--verbose": "print the whole configuration before training",
  "--version": "print the version",
}


def print_help() -> None:
  """Prints the help page, as wide as the terminal."""
  console = Console(highlight=False)
  console.print(Text("Train a policy. `playground train` is the same.", style="bold"))
  console.print(f"  {_USAGE}\n", markup=False, soft_wrap=True)
  console.print(Text("Examples", style="bold"))
  for line, what in _EXAMPLES.items():
    console.print(Text.assemble("  ", (line, "cyan"), f"\n      {what}"), soft_wrap=True)
  console.print()
  for title, rows in _parts():
    console.print(Text(title, style="bold"))
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for row in rows:
      table.add_row(*(Text(cell, style="" if i else "cyan") for i, cell in enumerate(row)))
    console.print(Padding(table, (0, 0, 1, 2)))
  console.print("playground keys agent (or --help agent) explains every key of a section.", soft_wrap=True)


def _parts() -> Iterator[tuple[str, list[tuple[str, ...]]]]:
  yield "Groups", [(group, f"{what}: {_options(group)}") for group, what in _GROUPS.items()]
  fields = [setting for setting in settings(RunSettings).values() if setting.name in SCALARS]
  yield "Keys of a run", [(setting.name, setting.help) for setting in fields]
  yield "Flags", list(_FLAGS.items())


def _options(group: str) -> str:
  """Lists the options of a group; for more than `_MANY`, their number and a few examples."""
  names = [name for name in listed_options(group, config_roots()) if "/" not in name and not name.startswith("_")]
  if len(names) <= _MANY:
    return ", ".join(names)
  return f"{len(names)}, such as {', '.join(names[:: len(names) // 5][:5])}"
