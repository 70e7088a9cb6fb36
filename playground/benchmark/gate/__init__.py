"""`playground-bench gate`: finds slowdowns by ratios within one run, which hold on any machine.

Each check measures the processor time of a piece of our code and, in turns, that of a reference workload that uses the
machine in the same way without our code. The ratio is compared with the committed one (`benchmarks/gate.csv`).
"""

import csv
import dataclasses
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from playground.benchmark.arguments import check_limits
from playground.config.files import shipped
from playground.errors import ConfigError, UnknownNameError, nearest
from playground.files import need_folder, write_text
from playground.limits import count

if TYPE_CHECKING:
  from playground.benchmark.gate.checks import Pair, Timed


@dataclasses.dataclass(frozen=True)
class Options:
  """Fails (exit code 1) where a quick set of ratios, measured on the CPU, is far above the committed ones."""

  checks: Annotated[Sequence[str], "names of checks; none is those of the table"] = ()
  repeats: Annotated[int, count(1), "turns of ours and the reference; the median of their ratios counts"] = 15
  update: Annotated[bool, "write the ratios measured into the table instead of comparing"] = False
  table: Annotated[str | None, "CSV of check, ratio, tolerance; null is benchmarks/gate.csv"] = None


@dataclasses.dataclass(frozen=True)
class Limit:
  """The limit of a check: the committed ratio, and the factor above which it fails."""

  ratio: float
  tolerance: float

  @property
  def most(self) -> float:
    return self.ratio * self.tolerance


COLUMNS = ["check", "ratio", "tolerance"]
TOLERANCE = 1.5  # two busy cores and other processors move a ratio by up to a third


def run(options: Options) -> int:
  """Measures ratios and compares them, or writes them to the table; returns the exit code."""
  path = Path(options.table).expanduser() if options.table else shipped("benchmarks") / "gate.csv"
  limits = {} if options.update and not path.exists() else _read(path)
  check_limits(options)
  if not (limits or options.update):
    raise ConfigError(f"table={path} holds no check: `playground-bench gate update=true table={path}` adds them.")
  if options.update:
    need_folder(path.parent, f"table={path}")
  from playground.benchmark.gate.checks import CHECKS

  names = options.checks or tuple(CHECKS if options.update else limits)
  for name in names:
    if name not in CHECKS:
      raise UnknownNameError(f"checks={name} does not exist: choose from {', '.join(CHECKS)}.{nearest(name, CHECKS)}")
  if not options.update:
    return judge({name: CHECKS[name] for name in names}, limits, options.repeats)
  for name in names:
    ratio = measure(CHECKS[name](), options.repeats)
    limits[name] = Limit(ratio, limits[name].tolerance if name in limits else TOLERANCE)
    rows = [f"{name},{limit.ratio:.4g},{limit.tolerance:g}" for name, limit in sorted(limits.items())]
    write_text(path, "\n".join([",".join(COLUMNS), *rows]) + "\n")
    print(f"{name}: {ratio:.3g}", flush=True)
  return 0


def judge(checks: "Mapping[str, Callable[[], Pair]]", limits: Mapping[str, Limit], repeats: int) -> int:
  """Compares checks with their limits; a ratio above its limit is measured a second time. Returns the exit code."""
  slow = []
  if new := next((name for name in checks if name not in limits), None):
    raise ConfigError(f"{new} has no committed ratio: `playground-bench gate update=true checks={new}` adds it.")
  for name, build in checks.items():
    pair, limit = build(), limits[name]
    ratio = measure(pair, repeats)
    if ratio > limit.most:
      ratio = min(ratio, measure(pair, 2 * repeats))
    verdict = "slow" if ratio > limit.most else "ok"
    print(f"{name}: {ratio:.3g}, committed {limit.ratio:.3g}, at most {limit.most:.3g}: {verdict}", flush=True)
    slow += [name] * (verdict == "slow")
  if slow:
    print(f"error: slower than committed: {', '.join(slow)}.", file=sys.stderr)
  return 1 if slow else 0


def measure(pair: "Pair", repeats: int) -> float:
  """Returns the ratio of our time to the reference's, the median over turns that measure one after the other."""
  for timed in pair:
    timed()
  return statistics.median(_seconds(pair[0]) / _seconds(pair[1]) for _ in range(repeats))


def _seconds(timed: "Timed") -> float:
  """Returns the processor time of all threads of this process, which other processes hardly affect."""
  begin = time.process_time()
  timed()
  return time.process_time() - begin


def _read(path: Path) -> dict[str, Limit]:
  try:
    with path.open(encoding="utf-8", newline="") as file:
      reader = csv.DictReader(file)
      if list(reader.fieldnames or ()) != COLUMNS:
        raise ConfigError(f"table={path} is not a table of the gate: its columns are {','.join(COLUMNS)}.")
      limits = {row["check"]: Limit(float(row["ratio"]), float(row["tolerance"])) for row in reader}
  except ConfigError:
    raise
  except (OSError, TypeError, ValueError, csv.Error) as error:
    raise ConfigError(f"table={path} cannot be read: {getattr(error, 'strerror', None) or error}.") from None
  for name, limit in limits.items():
    if not (0 < limit.ratio < math.inf and 1 <= limit.tolerance < math.inf):
      values = f"ratio {limit.ratio:g}, tolerance {limit.tolerance:g}"
      raise ConfigError(f"table={path}: {name} has {values}, which must be above 0 and at least 1.")
  return limits
