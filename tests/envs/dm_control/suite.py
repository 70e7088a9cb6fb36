"""The suite's domains and tasks as the figures of Playground's models list them."""

import copy
from pathlib import Path
from typing import Any

import playground.envs.dm_control
from tests.robots.figures import TESTS, figures

_DOMAINS = Path(playground.envs.dm_control.__file__).parent
FIGURES = {
  path.stem: next((TESTS / "figures").glob(f"{path.stem}*.json")).stem
  for path in sorted(_DOMAINS.glob("*.xml"))
  if path.stem != "looks"
}  # domain to file
# `make test-slow` compiles their physics.
COSTLY = ("ball_in_cup", "cheetah", "finger", "fish", "hopper", "humanoid", "swimmer", "walker")
DOMAIN = {env["name"]: domain for domain, file in FIGURES.items() for env in figures(file)["envs"]}  # of every task


def facts_of(task: str) -> dict[str, Any]:
  """The figures of a task's model: those of its domain's first task, with what differs here."""
  facts = copy.deepcopy(figures(FIGURES[DOMAIN[task]]))
  for change in facts["variants"]:
    if change["env"] != task:
      continue
    section = facts[change["section"]]
    if "name" in change:
      section = next(thing for thing in section if thing["name"] == change["name"])
    if "field" in change:
      section[change["field"]] = change["value"]
    else:
      facts[change["section"]] = change["value"]
  return facts
