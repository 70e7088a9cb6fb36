"""Builds the section on pixels: steps/s and their parts, beside the paper's and other simulators'."""

from collections.abc import Iterable, Mapping

from playground.benchmark.commands import COMPARED_CONDITIONS
from playground.benchmark.report.evidence import Evidence, Figure
from playground.benchmark.report.sections import Notes, nothing
from playground.paper import paper_table
from playground.reporting.page import Block, Heading, Table, Text

SEEN = {"episodes": "state", "pixels": "+ images", "inference": "+ inference", "update": "+ training"}
PARTS = ("physics", "rendering", "inference", "policy update")  # the paper's names of the added parts
MEMORY = "used_memory_gib"
PAPER = ("paper, Madrona", "64", "1024")  # who, width of the images, environments
_SIZES = ("env.vision.width", "env.vision.height", "agent.num_envs")

Group = tuple[str, str, str, str, str]  # task, who, width of the images, environments, device


def pixels(evidence: Evidence, notes: Notes) -> Iterable[Block]:
  """Builds the section of steps/s from pixels, beside the paper's and those that it quotes."""
  yield Heading(2, "From pixels")
  yield Text(
    "Control steps a second with each part added; random actions before inference, an untrained policy after. "
    "The paper's: one RTX 4090, Madrona, the mean of five runs; control steps of 0.04 s and episodes of 3 s for "
    "Cartpole, 0.05 s and 4 s for the Panda, whose appearance is randomised. `playground-bench pixels` sets the same."
  )
  speeds, shares, bars = [], [], []
  for (group, setting), parts in sorted(_ours(evidence).items()):
    task, who, side, count, device = group
    seconds = {part: figure.mean for part, figure in parts.items()}
    cells = [f"{1 / seconds[part]:,.0f}" if part in seconds else "" for part in SEEN]
    memory = f"{parts[MEMORY].mean:.2f}" if MEMORY in parts else ""
    speeds.append([task, who, side, count, *cells, memory, device, setting, notes.number(next(iter(parts.values())))])
    if SEEN.keys() <= seconds.keys():
      shares.append([task, who, side, count, *_shares([seconds[part] for part in SEEN]), device, setting])
    if count == "1024" and "pixels" in seconds:
      conditions = "simulator_comparison" if COMPARED_CONDITIONS[0] in setting.split() else "trainable_env"
      bars.append([who, task, conditions, side, cells[1], device])
  if not speeds:
    yield nothing("pixels")
  for task, measured in _paper().items():
    cells = [f"{speed:,.0f}" for speed in measured.values()]
    speeds.append([task, *PAPER, *cells, "", "1x RTX 4090", "", ""])
    shares.append([task, *PAPER, *_shares([1 / speed for speed in measured.values()]), "1x RTX 4090", ""])
  sizes = ["task", "who", "side", "environments"]
  yield Table([*sizes, *SEEN.values(), "GPU memory (GiB)", "device", "setting", "note"], speeds)
  yield Text("Where the time of a step of one environment goes: microseconds, and the share of a step that trains.")
  yield Table([*sizes, *PARTS, "device", "setting"], shares)
  yield Text(
    "The paper's bars, 1024 environments with images. Simulators are compared in control steps of 1/60 s: "
    "`playground-bench pixels compared=true sizes=80,128,224,256`."
  )
  for r in paper_table("pixel_benchmark_upstream"):
    if (r["component"], r["num_envs"]) == ("env_step+pixels", "1024"):
      speed = f"{float(r['fps_mean']):,.0f}"
      bars.append([r["simulator"], r["env"], r["setting"], r["image_side"], speed, "1x RTX 4090"])
  bars.sort(key=lambda row: (row[2], row[1].removesuffix("Vision"), int(row[3].split(" x ")[0])))
  yield Table(["simulator", "task", "conditions", "side", "steps/s", "device"], bars)


def _ours(evidence: Evidence) -> dict[tuple[Group, str], dict[str, Figure]]:
  """Returns measurements by part (or `MEMORY`), for each group and the rest of its setting."""
  groups: dict[tuple[Group, str], dict[str, Figure]] = {}
  memory = evidence.find(benchmark="pixels", quantity=MEMORY)
  for figure in reversed(evidence.find(benchmark="pixels", quantity="seconds_per_step") + memory):
    setting, _, part = figure["setting"].partition(" part=")
    part = part or MEMORY
    values = {key: value for key, _, value in (text.partition("=") for text in setting.split())}
    width, height, count = (values.get(key, "") for key in _SIZES)
    side = width if width == height else f"{width} x {height}"
    others = " ".join(text for text in setting.split() if text.partition("=")[0] not in _SIZES)
    group = (figure["task"], figure["who"], side, count, figure["device"])
    groups.setdefault((group, others), {})[part] = figure
  return groups


def _paper() -> dict[str, Mapping[str, float]]:
  """Returns the paper's steps/s, by task and component, in the order of `SEEN`."""
  speeds: dict[str, dict[str, float]] = {}
  for row in paper_table("pixel_breakdown"):
    if row["kind"] == "measured":
      speeds.setdefault(row["env"], {})[row["component"]] = float(row["fps"])
  return dict(speeds)


def _shares(seconds: list[float]) -> list[str]:
  """Returns the time that each part adds to a step, and its share of the total, for times as in `SEEN`."""
  added = [max(0.0, time - before) for time, before in zip(seconds, [0.0, *seconds[:-1]], strict=True)]
  return [f"{time * 1e6:.3g} ({time / seconds[-1]:.0%})" for time in added]
