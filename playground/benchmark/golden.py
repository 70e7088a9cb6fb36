"""`playground-bench golden`: checks whole runs for regressions, with a window for each metric."""

import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import yaml

from playground.benchmark.arguments import check_limits
from playground.benchmark.jobs import Measurement, Plan, probe, run_jobs
from playground.benchmark.schema import Table
from playground.config import compose
from playground.config.files import shipped
from playground.errors import ConfigError, lookup
from playground.hardware.options import HardwareConfig

QUANTITY = "golden_metric"
_KEYS = ("run", "metrics", "from")


@dataclasses.dataclass(frozen=True)
class Options(Plan):
  """Trains the runs of a set and fails (exit code 1) where a metric's last value is outside its window."""

  set: Annotated[str, "cpu (2 cores, under 15 minutes) or gpu (one H200, under 30 minutes)"] = "cpu"
  only: Annotated[Sequence[str], "names of runs; none is all runs of the set"] = ()
  rerun: Annotated[bool, "train runs again that the CSV has already; false continues where minutes= ended"] = True
  cache: bool = True
  table: Annotated[str | None, "YAML of the sets; null is benchmarks/golden.yaml"] = None
  out: Annotated[str | None, "CSV that rows are added to; null is results/benchmarks/golden.csv"] = None
  overrides: Annotated[Sequence[str], "of every run's configuration"] = ()


@dataclasses.dataclass(frozen=True)
class Golden:
  """A run and the expected results.

  Attributes:
    name: name of the run.
    overrides: overrides of `playground-run`.
    windows: lowest and highest last value, by column of metrics.csv.
    source: source of the windows.
  """

  name: str
  overrides: tuple[str, ...]
  windows: Mapping[str, tuple[float, float]]
  source: str


class GoldenRun(Measurement):
  """The measurement of a run, which is in the table if all of its metrics are."""

  def left(self, table: Table, device: str) -> Measurement | None:
    del device  # in `columns`
    return None if len(values(table.rows(), self)) == len(self.arguments["metrics"]) else self


def run(options: Options) -> int:
  """Trains the runs and checks their values.

  Returns:
    The exit code: 0 if all are inside, 1 for a failed run or a value outside or missing, 3 if the time was up.

  Raises:
    PlaygroundError: an option is invalid, or the file holds no sets of runs.
  """
  check_limits(options)
  path = Path(options.table).expanduser() if options.table else shipped("benchmarks") / "golden.yaml"
  runs = lookup(read(path), options.set, "set")
  chosen = [lookup(runs, name, "only") for name in options.only] or list(runs.values())
  overrides = [[*each.overrides, *options.overrides] for each in chosen]
  configs = [compose(each) for each in overrides]  # raises for invalid overrides, before anything runs
  table = Table(Path(options.out or "results/benchmarks/golden.csv").expanduser())
  machines: dict[HardwareConfig, tuple[int, dict[str, str]]] = {}  # a run may choose its hardware
  jobs = []
  for each, texts, config in zip(chosen, overrides, configs, strict=True):
    if config.hardware not in machines:
      machines[config.hardware] = devices, machine = probe(texts, options.gpus)
      print(f"{devices} x {machine['device']}; {machine['versions']}")
    jobs.append(measurement(each, texts, config.agent_name, *machines[config.hardware]))
  earlier = len(table.rows())
  code = run_jobs(jobs, table, machines[configs[0].hardware][1], options)
  rows = table.rows(earlier if options.rerun else 0)
  bad = [name for name, job in zip(chosen, jobs, strict=True) if not judge(name, values(rows, job))]
  if bad:
    print(f"error: outside of their windows or not measured: {', '.join(each.name for each in bad)}.", file=sys.stderr)
  return code or (1 if bad else 0)


def judge(golden: Golden, found: Mapping[str, float]) -> bool:
  """Prints a line for each metric; returns whether all were measured and are inside their windows."""
  good = True
  for metric, (least, most) in golden.windows.items():
    inside = metric in found and least <= found[metric] <= most  # NaN is outside
    verdict = "ok" if inside else f"OUTSIDE (window from {golden.source})"
    measured = f"{found[metric]:.4g}, window {least:g} to {most:g}: {verdict}" if metric in found else "not measured"
    print(f"{golden.name}: {metric} {measured}", flush=True)
    good &= inside
  return good


def measurement(
  golden: Golden, overrides: Sequence[str], agent: str, devices: int, machine: Mapping[str, str]
) -> GoldenRun:
  """Returns the measurement of a run with all of its overrides, on the devices that they choose."""
  columns = {"benchmark": "golden", "task": golden.name, "agent": agent, "who": "ours", "setting": ""}
  columns |= {"device": machine["device"], "devices": str(devices)}
  settings = [" ".join((*overrides, f"metric={metric}")) for metric in golden.windows]
  arguments = {"overrides": list(overrides), "metrics": list(golden.windows), "settings": settings}
  return GoldenRun("runs:golden", arguments, columns, {"quantity": QUANTITY})


def values(rows: Sequence[Mapping[str, str]], job: Measurement) -> dict[str, float]:
  """Returns the newest value of each metric of a run on these devices."""
  metrics = dict(zip(job.arguments["settings"], job.arguments["metrics"], strict=True))
  same = {name: job.columns[name] for name in ("benchmark", "task", "device", "devices")} | {"quantity": QUANTITY}
  own = [row for row in rows if row["setting"] in metrics and all(row[key] == text for key, text in same.items())]
  return {metrics[row["setting"]]: float(row["value"]) for row in own}


def read(path: Path) -> dict[str, dict[str, Golden]]:
  """Reads the sets of a file, by name.

  Raises:
    ConfigError: the file is unreadable, or an entry has another form than in benchmarks/golden.yaml.
  """
  try:
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
  except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:  # such as an invalid date
    reason = getattr(error, "strerror", None) or " ".join(str(error).split())
    raise ConfigError(f"table={path} cannot be read: {reason}.") from None
  if (
    not isinstance(content, dict)
    or not content
    or not all(isinstance(runs, dict) and runs for runs in content.values())
  ):
    raise ConfigError(f"table={path} must hold sets of runs, as benchmarks/golden.yaml does.")
  return {
    str(name): {str(run): _golden(f"{path}: {name}.{run}", str(run), entry) for run, entry in runs.items()}
    for name, runs in content.items()
  }


def _golden(place: str, name: str, entry: object) -> Golden:
  if not isinstance(entry, dict) or set(entry) != set(_KEYS):
    raise ConfigError(f"{place} must have the keys {', '.join(_KEYS)}.")
  overrides, metrics = entry["run"], entry["metrics"]
  if not isinstance(overrides, list) or not all(isinstance(text, str) for text in overrides):
    raise ConfigError(f"{place}.run must be a list of overrides such as env=CheetahRun.")
  if not isinstance(metrics, dict) or not metrics:
    raise ConfigError(f"{place}.metrics must name a column of metrics.csv with its window, [least, most].")
  windows = {str(metric): _window(f"{place}.metrics.{metric}", window) for metric, window in metrics.items()}
  return Golden(name, tuple(overrides), windows, str(entry["from"]))


def _window(place: str, window: object) -> tuple[float, float]:
  ends = window if isinstance(window, list) else []
  numbers = all(type(x) in (int, float) and math.isfinite(x) for x in ends)
  if not numbers or len(ends) != 2 or ends[0] > ends[1]:
    raise ConfigError(f"{place}={window} must be two numbers, the least and the most.")
  return float(ends[0]), float(ends[1])
