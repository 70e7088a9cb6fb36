"""Builds the sections of the page from the rows of each benchmark; a section without rows names its command."""

import functools
import re
from collections.abc import Iterable, Mapping, Sequence

from playground.benchmark.report.evidence import Evidence, Figure
from playground.catalog import value_of
from playground.config import compose, options, task_names
from playground.paper import SUITES, paper_table
from playground.reporting import figures
from playground.reporting.page import NOT_MEASURED, Block, Heading, Image, Table, Text, short
from playground.text import millions

TITLES = {"dm_control": "DM Control Suite", "locomotion": "Locomotion", "manipulation": "Manipulation"}
SPEED = "training_steps_per_s"
PARTS = ("physics", "task", "episodes", "pixels", "inference", "storing", "update")
_BUDGET = re.compile(r" ?agent\.num_timesteps=\S+")  # in the setting of a whole run on a topology
_TOPOLOGY = ("hardware.devices=", "hardware.scale_envs=")  # keys that a topology's setting varies
_KEY = re.compile(r"^[\w.]+\.(?=\w+=)")  # the part of an override's key before its last word
_CURVE = re.compile(
  r"(.+?)_((?:ours|peer|ppo|reppo|sac|fast_td3|fast_sac|seed)(?:_.*)?)"
)  # a curve's name: task and run


class Notes:
  """Numbers the conditions of figures, and lists each once below the tables."""

  def __init__(self) -> None:
    self._texts: dict[str, int] = {}

  def number(self, figure: Figure) -> str:
    """Returns the number of the note on a figure's conditions, such as `[2]`."""
    untimed = re.sub(r"[\d.]+ s timed", "timed", figure["conditions"])  # else every seed would have its own note
    commit = figure["commit"] and f"commit {figure['commit']}"
    parts = (figure["precision"], figure["versions"], figure["note"], untimed, commit)
    text = "; ".join(part for part in parts if part)
    return f"[{self._texts.setdefault(text, len(self._texts) + 1)}]"

  def blocks(self) -> Iterable[Block]:
    yield Heading(2, "Conditions")
    yield Table(["note", "conditions"], [[f"[{number}]", text] for text, number in self._texts.items()])


def throughput(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields the paper's tables with our column beside theirs."""
  yield Heading(2, "Training throughput")
  yield Text(
    "Control steps trained on a second, at the paper's hyperparameters. The paper's column: one A100, five seeds, "
    "Brax, steps over wall-clock time of the run. Ours: training alone, compiling and evaluation apart, one device; "
    "± is the 95 % confidence interval over seeds, where there are several. Every repeat of an action counts, as in "
    "Brax; the paper does not say. The hardware is not the same, so a ratio is no comparison of programs: that is the "
    "next section."
  )
  for suite in SUITES:
    for agent in ("ppo", "sac"):
      lines = [row for row in paper_table(f"{suite}_throughput") if row.get(f"{agent}_sps_mean")]
      if lines:
        yield Heading(3, f"{TITLES[suite]}, {agent.upper()}")
        yield _paper_table(evidence, notes, lines, agent)


def _paper_table(evidence: Evidence, notes: Notes, lines: Sequence[dict[str, str]], agent: str) -> Block:
  header = ["task", "paper, 1 x A100", "ours", "ratio", "seeds", "backend", "device", "compile (s)", "note"]
  rows = []
  for line in lines:
    task, paper = line["registry_env"], float(line[f"{agent}_sps_mean"])
    theirs = f"{paper:,.0f} ± {float(line[f'{agent}_sps_ci95']):,.0f}"
    same = {"benchmark": "throughput", "task": task, "agent": agent, "who": "ours", "setting": ""}
    earlier = {**same, "benchmark": "compare"}  # measured beside the peer only
    published = {**same, "agent": f"{agent}_paper"}  # where the paper's set is not our default
    ours = next(filter(None, (evidence.best(**of, quantity=SPEED) for of in (published, same, earlier))), None)
    if ours is None:
      rows.append([task, theirs, NOT_MEASURED, "", "", "", "", "", ""])
      continue
    of_it = {**same, **{name: ours[name] for name in ("agent", "backend", "device", "commit")}}
    compiling = evidence.best(**of_it, quantity="compile_s")
    seeds = str(len(ours.rows)) if ours["seed"] else "1"
    compile_s = f"{compiling.mean:.1f}" if compiling else ""
    figures_of_it = [_with_ci(ours), f"{ours.mean / paper:.2f}", seeds]
    rows.append([task, theirs, *figures_of_it, ours["backend"], ours["device"], compile_s, notes.number(ours)])
  return Table(header, rows)


def compared(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields our figures beside the peer's, from the same call on the same machine."""
  yield Heading(2, "Beside the public package")
  yield Text(
    "Ours and `playground` 0.2.0, in turn on one machine in one call, each in fresh processes; of several turns the "
    "best counts. Start: from the start of the process to the end of the first update, nothing cached."
  )
  names = {"training_steps_per_s": "training steps/s", "start_to_first_update_s": "start (s)"}
  names |= {"peak_memory_gib": "JAX's memory (GiB)", "used_memory_gib": "GPU memory (GiB)"}
  rows = []
  for quantity, label in names.items():
    pick = max if quantity == SPEED else min
    for ours in evidence.find(benchmark="compare", who="ours", quantity=quantity):
      of_it = {name: ours[name] for name in ("task", "source", "device", "commit")}
      for peer in evidence.find(benchmark="compare", quantity=quantity, **of_it):
        if peer["who"] != "ours" and _same_overrides(ours, peer):
          mine, its = (pick(row["value"] for row in figure.rows) for figure in (ours, peer))
          more, less = (mine, its) if quantity == SPEED else (its, mine)
          better = f"{more / less:.2f}" if less else ""  # a GPU's memory in use may be none
          task, who = f"{ours['task']} {ours['setting']}".strip(), f"{peer['who']} {peer['backend']}".strip()
          found = [task, label, short(mine), who, short(its), better]
          rows.append([*found, notes.number(ours), notes.number(peer)])
  if rows:
    yield Table(["task", "", "ours", "peer", "its", "times better", "ours: note", "its: note"], sorted(rows))
  else:
    yield nothing("compare")


def _same_overrides(ours: Figure, peer: Figure) -> bool:
  """Returns whether both are of one command: the peer's setting adds its backend to the overrides of our run."""
  return re.sub(r" ?env\.impl=\S+$", "", peer["setting"]) == ours["setting"]


def startup(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields the times from the command to the first update."""
  yield Heading(2, "From the command to the first update")
  rows = []
  for figure in evidence.find(benchmark="startup", quantity="start_to_first_update_s"):
    kind = figure["setting"].rpartition(" ")[2]
    rows.append([_named(figure, kind), kind, f"{figure.mean:.1f}", figure["device"], notes.number(figure)])
  yield Table(["task", "caches", "seconds", "device", "note"], sorted(rows)) if rows else nothing("startup")


def scaling(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields steps a second and memory over the number of environments."""
  yield Heading(2, "Against the number of environments")
  series: dict[str, dict[float, float]] = {}
  rows = []
  for quantity, label in (("env_steps_per_s", "environment"), ("training_steps_per_s", "training")):
    for figure in evidence.find(benchmark="scaling", who="ours", quantity=quantity):
      count = value_of(figure["setting"], "agent.num_envs")
      task = _named(figure, "agent.num_envs=", "agent.batch_size=")
      line = series.setdefault(f"{task}, {label}, {figure['device']}", {})
      line.setdefault(float(count), figure.mean)  # the newest
      same = {name: figure[name] for name in ("task", "agent", "setting", "seed", "device", "commit")}
      memory = evidence.best(benchmark="scaling", quantity="peak_memory_gib", **same)
      used = f"{memory.mean:.2f}" if memory else ""
      device, note = figure["device"], notes.number(figure)
      rows.append([task, label, count, f"{figure.mean:,.0f}", used, device, note])
  if not rows:
    yield nothing("scaling")
    return
  points = {name: list(line.items()) for name, line in series.items()}
  yield Image("scaling", figures.lines("steps/s", points, "environments", "steps/s"), "Steps a second.")
  order = lambda row: (row[0], row[1], int(row[2]))
  yield Table(["task", "", "environments", "steps/s", "memory (GiB)", "device", "note"], sorted(rows, key=order))


def together(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields the steps a second of several agents in one program beside those of one run."""
  yield Heading(2, "Agents in one program")
  agents = lambda figure: int(value_of(figure["setting"], "num_agents"))
  found = evidence.find(benchmark="together", who="ours", quantity=SPEED)
  rows = []
  for figure in sorted(found, key=agents):
    same = lambda other, figure=figure: all(other[name] == figure[name] for name in ("source", "device", "commit"))
    task, device, note = _named(figure, "num_agents="), figure["device"], notes.number(figure)
    one = [each for each in found if agents(each) == 1 and _named(each, "num_agents=") == task and same(each)]
    times = f"{figure.mean / one[0].mean:.2f}" if one else ""
    rows.append([task, str(agents(figure)), _with_ci(figure), times, device, note])
  columns = ["task", "agents", "steps/s of all", "times one run", "device", "note"]
  yield Table(columns, sorted(rows, key=lambda row: row[0])) if rows else nothing("together")


def topology(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields rates on one and several devices with the time of a budget derived from them, then whole runs."""
  yield Heading(2, "Devices")
  yield Text(
    "The paper prints for LeapCubeReorient about 2080 s on one RTX 4090 and 670 s on eight H100 (IV-D). Times one "
    "device: the rate over that of one device; efficiency: this over the number of devices. The time of a budget is "
    "derived: the task's own number of steps over the rate, so training alone, without compiling and evaluation."
  )
  found = evidence.find(benchmark="topology", who="ours", quantity=SPEED)
  groups: dict[str, dict[str, float]] = {}
  rows = []
  for figure, one in _beside_one(figure for figure in found if not _BUDGET.search(figure["setting"])):
    count, kind, device, note = figure["devices"], _hyperparameters(figure), figure["device"], notes.number(figure)
    times = [f"{figure.mean / one:.2f}", f"{figure.mean / one / int(count):.2f}"] if one else ["", ""]
    task = _named(figure, *_TOPOLOGY)
    groups.setdefault(f"{task}, {count} x {device}", {}).setdefault(kind, figure.mean)  # the newest
    budget = _budget(figure["task"], figure["agent"])
    seconds = f"{budget / figure.mean:,.0f}" if budget else ""
    rows.append([task, count, kind, _with_ci(figure), *times, seconds, device, note])
  if rows:
    yield Image("topology", figures.bars("training steps/s", groups, "steps/s"), "Devices.")
    derived = ["times one device", "efficiency", "its budget takes (s)"]
    yield Table(["task", "devices", "hyperparameters", "steps/s", *derived, "device", "note"], rows)
  else:
    yield nothing("topology")
  yield from _whole_runs(evidence, notes)


def _whole_runs(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields measured wall-clock time and return of runs on each topology, beside the time derived from the rate."""
  yield Text(
    "Whole runs, as measured: the wall-clock time of the control steps with evaluations and saving, without compiling, "
    "and the return of the last evaluation. Times one device: how much faster than on one. Derived: the seconds of the "
    "same steps at the rate above."
  )
  rows = []
  for figure, one in _beside_one(evidence.find(benchmark="topology", who="ours", quantity="wall_clock_s")):
    of_it = {name: figure[name] for name in ("benchmark", "task", "agent", "who", "backend", "devices", "device")}
    same = {**of_it, "setting": figure["setting"], "commit": figure["commit"], "source": figure["source"]}
    steps, score = (evidence.best(**same, quantity=quantity) for quantity in ("steps", "final_return"))
    of_it |= {"setting": _BUDGET.sub("", figure["setting"]), "quantity": SPEED}
    rate = evidence.best(**of_it, commit=figure["commit"]) or evidence.best(**of_it)
    count = f"{steps.mean:,.0f}" if steps else NOT_MEASURED
    times = f"{one / figure.mean:.2f}" if one else ""
    derived = short(steps.mean / rate.mean) if steps and rate else ""
    result = [count, _with_ci(figure), times, derived, _with_ci(score) if score else NOT_MEASURED]
    topology = [_named(figure, *_TOPOLOGY, "agent.num_timesteps="), figure["devices"], _hyperparameters(figure)]
    rows.append([*topology, *result, figure["device"], notes.number(figure)])
  measured = ["steps", "measured (s)", "times one device", "derived (s)", "final return"]
  header = ["task", "devices", "hyperparameters", *measured, "device", "note"]
  yield Table(header, rows) if rows else nothing("topology num_timesteps=<steps>")


def _beside_one(found: Iterable[Figure]) -> list[tuple[Figure, float | None]]:
  """Returns figures by number of devices, each with the value of one device, of the same commit or else the newest."""
  order = lambda figure: (figure["task"], int(figure["devices"]), _hyperparameters(figure))
  single: dict[tuple[str, ...], float] = {}
  pairs = []
  for figure in sorted(found, key=order):  # a task's one device comes first, of several the newest
    same = _of_topology(figure)
    own = (*same, figure["commit"])
    if figure["devices"] == "1":
      single.setdefault(same, figure.mean)
      single.setdefault(own, figure.mean)
    pairs.append((figure, single.get(own, single.get(same))))
  return pairs


def _hyperparameters(figure: Figure) -> str:
  return "scaled" if "hardware.scale_envs=true" in figure["setting"] else "fixed"


def _of_topology(figure: Figure) -> tuple[str, ...]:
  """Returns the columns that are equal for figures that differ only in their devices."""
  setting = (text for text in figure["setting"].split() if not text.startswith(_TOPOLOGY))
  return figure["task"], figure["agent"], figure["device"], " ".join(setting)


@functools.cache
def _budget(task: str, agent: str) -> int | None:
  """Returns the default number of control steps of a task's training; None if task or agent is not installed."""
  if task not in task_names() or agent not in options("agent"):
    return None
  return compose([f"env={task}", f"agent={agent}"]).agent.num_timesteps


def breakdown(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields the time of each part of a control step."""
  yield Heading(2, "Where the time goes")
  yield Text("The loop timed with its parts added one by one; a part is the difference (the paper's method, D.3).")
  bars: dict[str, dict[str, float]] = {}
  rows = []
  found = evidence.find(benchmark="breakdown", quantity="seconds_per_step")
  measured: dict[tuple[str, str], dict[str, Figure]] = {}
  for figure in found:
    parts = measured.setdefault((_named(figure, "part="), figure["device"]), {})
    parts.setdefault(figure["setting"].rpartition("part=")[2], figure)  # the newest
  for (task, device), of_it in measured.items():
    have = [part for part in PARTS if part in of_it]
    if have:  # else the rows are of parts of another version
      times = [of_it[part].mean for part in have]
      shares = {p: max(0.0, t - s) * 1e6 for p, t, s in zip(have, times, [0.0, *times[:-1]], strict=True)}
      bars[f"{task}, {device}"] = {part: share / (times[-1] * 1e6) for part, share in shares.items()}
      cells = [f"{shares[part]:.3g}" if part in shares else "" for part in PARTS]
      rows.append([task, *cells, f"{1 / times[-1]:,.0f}", device, notes.number(of_it[have[-1]])])
  if bars:
    yield Image("breakdown", figures.stacked("share of training time", bars, "share"), "Where the time goes.")
    yield Table(["task", *(f"{part} (µs)" for part in PARTS), "steps/s", "device", "note"], rows)
  else:
    yield nothing("breakdown")


def chains(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields return and time of curricula, stage by stage."""
  yield Heading(2, "Fine-tuning chains")
  rows = []
  for figure in evidence.find(benchmark="chain", quantity="wall_clock_s"):
    same = {name: figure[name] for name in ("task", "setting", "device", "commit")}
    score = evidence.best(benchmark="chain", quantity="final_return", **same)
    stage, seconds = figure["setting"].removeprefix("stage="), f"{figure.mean:,.0f}"
    result = _with_ci(score) if score else NOT_MEASURED
    rows.append([figure["task"], stage, result, seconds, figure["device"], notes.number(figure)])
  yield Table(["chain", "stage", "return", "seconds", "device", "note"], rows) if rows else nothing("chain")


def returns(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Yields learning curves and final returns of all runs."""
  yield Heading(2, "Returns")
  groups: dict[str, dict[str, list[tuple[float, float]]]] = {}
  for name, points in evidence.curves.items():
    parts = _CURVE.fullmatch(name)
    task, run = parts.groups() if parts else (name, name)
    groups.setdefault(task, {})[run] = points
  if groups:
    yield Image("curves", curves_of(groups), "Return of evaluations over control steps.")
  if runs := runs_by_step(evidence):
    yield Image("runs", curves_of(runs), "Return of runs that were measured whole, means over seeds.")
  rows = []
  for figure in evidence.find(quantity="final_return"):
    if figure["benchmark"] != "chain":
      setting = " ".join(filter(None, (figure["experiment"], figure["setting"])))
      who = [figure["task"], figure["agent"], figure["who"], setting]
      each = ", ".join(f"{row['value']:,.1f}" for row in figure.rows)
      result = [each, millions(float(figure["steps"])) if figure["steps"] else "", figure["backend"], figure["device"]]
      rows.append([*who, *result, notes.number(figure)])
  if rows:
    header = ["task", "agent", "who", "setting", "return of each run", "M steps", "backend", "device", "note"]
    yield Table(header, sorted(rows))


def runs_by_step(
  evidence: Evidence, quantity: str = "return", only_ours: bool = False
) -> dict[str, dict[str, list[tuple[float, float]]]]:
  """Returns learning curves by task and run, from the rows of evaluations, whose setting ends in `step=`.

  A run's name holds the words in which it differs from the task's other runs. `quantity` is `return` or `mode_return`.
  `only_ours` leaves out runs of other packages, and the names always have the agent.
  """
  tasks: dict[str, dict[tuple[str, ...], dict[float, float]]] = {}
  for figure in evidence.find(quantity=quantity, **({"who": "ours"} if only_ours else {})):
    setting, by_step, step = figure["setting"].rpartition("step=")
    if by_step:
      run = (figure["who"], figure["agent"], figure["device"], *setting.split())
      tasks.setdefault(figure["task"], {}).setdefault(run, {}).setdefault(float(step), figure.mean)  # the newest counts
  curves = {}
  for task, runs in tasks.items():
    shared = set.intersection(*map(set, runs))
    if only_ours:
      shared -= {agent for _, agent, *_ in runs}
    names = {run: [_KEY.sub("", word) for word in run if word and word not in shared] or [run[0]] for run in runs}
    curves[task] = {" ".join(names[run]): sorted(points.items()) for run, points in sorted(runs.items())}
  return dict(sorted(curves.items()))


def curves_of(groups: Mapping[str, Mapping[str, figures.Points]]) -> str:
  """Draws curves (environment steps, return), by title of the panel and name."""
  in_millions = lambda points: figures.Curve([step / 1e6 for step, _ in points], [value for _, value in points])
  panels = {title: {name: in_millions(points) for name, points in group.items()} for title, group in groups.items()}
  return figures.curves(dict(sorted(panels.items())), "million control steps", "return").decode()


def _named(figure: Figure, *varied: str) -> str:
  """Returns a figure's task, its agent unless PPO, and its setting without the overrides that a section varies."""
  agent = [figure["agent"]] * (figure["agent"] not in ("ppo", ""))
  return " ".join([figure["task"], *agent, *(t for t in figure["setting"].split() if not t.startswith(varied))])


def _with_ci(figure: Figure) -> str:
  digits = 0 if abs(figure.mean) >= 1000 else 1
  return f"{figure.mean:,.{digits}f}" + ("" if figure.ci95 is None else f" ± {figure.ci95:,.{digits}f}")


def nothing(command: str) -> Block:
  """Returns a text that names the command of a missing section."""
  return Text(f"{NOT_MEASURED.capitalize()}: `playground-bench {command}` does.")
