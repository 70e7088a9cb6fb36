"""Hyperparameters of every task and agent against the paper's and those of Playground 0.2.0 (benchmarks/paper)."""

import csv
import dataclasses
import functools
import importlib.metadata
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import yaml

from playground import registry
from playground.config import RunConfig, compose, options
from playground.config.definitions import defined
from playground.config.files import config_roots, lineage
from playground.learning import hyperparameters
from playground.learning.hyperparameters import PPOConfig, config_class
from playground.settings import defaults
from tests.test_limits import leaves

TABLES = Path(__file__).parents[1] / "benchmarks/paper"
SOURCES = {"ppo_paper": "paper", "ppo_v020": "upstream_head", "sac": "paper", "sac_v020": "upstream_head"}

# Columns that say where a row comes from or what follows from it, not what is set.
NOT_SET = {
  *("source", "suite", "env", "filled_from_brax_or_env_default", "env_steps_per_training_step"),
  *("training_steps_per_epoch", "env_steps_run", "unrolls_per_training_step", "gradient_steps"),
}
OF_THE_TASK = ("episode_length", "action_repeat")
OF_THE_NETWORK = (
  *("policy_hidden_layer_sizes", "value_hidden_layer_sizes", "policy_obs_key", "value_obs_key"),
  "q_network_layer_norm",
)

# What we set where the source is silent, and why.
OURS: dict[str, dict[str, Any]] = {
  "ppo_paper": {"num_resets_per_eval": 10},  # the default of the script that the paper was run with
}
# Sets that are no task's own.
FOR_ANY_TASK = ("robust", "sparse_reward", "estimated_state")
# What a source lists and nobody can have used: Brax's SAC has no such argument and refuses it.
UNUSABLE = {"sac": ("num_resets_per_eval",), "sac_v020": ("num_resets_per_eval",)}


def rows(agent: str) -> dict[str, dict[str, str]]:
  """The table's rows of an agent's source, by task."""
  with (TABLES / f"hyperparameters_{agent.partition('_')[0]}.csv").open() as file:
    return {row["env"]: row for row in csv.DictReader(file) if row["source"] == SOURCES[agent]}


def suite() -> list[str]:
  """The tasks of the DM Control suite, for which both agents are tuned."""
  return list(rows("sac"))


def cases() -> Iterator[Any]:
  """Pairs of an agent and a task; `make test` takes every third."""
  pairs = [(agent, task) for agent in SOURCES for task in rows(agent) if task in registry.names()]
  for i, pair in enumerate(pairs):
    yield pytest.param(*pair, id="-".join(pair), marks=[pytest.mark.slow] * (i % 3 != 0))


@functools.cache
def composed(agent: str, task: str) -> RunConfig:
  """The run of a pair; a variant without a set of its own is the agent it is built on, and saves a composition."""
  name, *built_on = lineage("agent", agent, config_roots())
  if built_on and f"{name}/{task}" not in options("tuned"):
    return composed(built_on[0], task)
  return compose([f"agent={agent}", f"env={task}"])


def value(text: str) -> Any:
  """What a cell says: a list such as 32x32, true or false, a number, text, or None."""
  if text in ("", "True", "False"):
    return {"": None, "True": True, "False": False}[text]
  if "x" in text:
    return [int(size) for size in text.split("x")]
  try:
    return float(text)
  except ValueError:
    return text


def test_the_whole_suite_has_a_table_and_is_there():
  assert len(suite()) == 25
  assert set(suite()) <= set(registry.names())
  assert all(set(suite()) <= set(rows(agent)) for agent in SOURCES)


@pytest.mark.parametrize(("agent", "task"), cases())
def test_hyperparameters_are_those_of_the_source(agent: str, task: str):
  row = rows(agent)[task]
  unlisted = (row.get("filled_from_brax_or_env_default") or "").split()
  expected = {key: value(text) for key, text in row.items() if key not in (*NOT_SET, *UNUSABLE.get(agent, ()))}
  expected |= {key: chosen for key, chosen in OURS.get(agent, {}).items() if key in unlisted}

  run = composed(agent, task)
  sections = {"env": OF_THE_TASK, "network": OF_THE_NETWORK}
  of = {key: section for section, keys in sections.items() for key in keys}
  resolved = {**run.resolved, "network": run.resolved["agent"].get("network")}
  assert {key: resolved[of.get(key, "agent")][key] for key in expected} == expected
  own = defaults(config_class(run.agent_name))
  left = {key: value for key, value in run.resolved["agent"].items() if key not in ("name", "network", *row)}
  assert left == {key: own[key] for key in left}, "what the source has not is off"
  task_alone = compose([f"env={task}", f"agent={agent}", "tuned=null"]).resolved["env"]
  assert {**run.resolved["env"], **{key: task_alone[key] for key in OF_THE_TASK}} == task_alone
  assert run.agent_name == agent.partition("_")[0]  # so that checkpoints of all variants go together
  assert run.choices["tuned"] == f"{run.choices['agent']}/{task}"


@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_a_variant_without_a_set_of_its_own_takes_its_agents(agent: str):
  run = compose([f"agent={agent}_v020", "env=PointMass"])
  own = composed(agent, "PointMass")
  assert (run.choices["agent"], run.choices["tuned"]) == (f"{agent}_v020", f"{agent}/PointMass")
  assert (run.resolved["agent"], run.resolved["env"]) == (own.resolved["agent"], own.resolved["env"])
  assert compose(run.overrides).resolved == run.resolved


@pytest.mark.parametrize(
  ("task", "chosen"),
  [
    ("HopperHop", ("ppo/HopperHop", "ppo_paper/HopperHop", "ppo_paper/HopperHop", "sac/HopperHop")),
    ("G1JoystickFlatTerrain", ("ppo/G1JoystickFlatTerrain", "ppo_paper/G1JoystickFlatTerrain", None, None)),
    ("WalkerWalk", ("ppo/WalkerWalk", "ppo/WalkerWalk", "ppo/WalkerWalk", "sac/WalkerWalk")),
  ],
)
def test_a_variant_without_a_set_of_its_own_takes_that_of_the_agent_it_is_built_on(
  task: str, chosen: tuple[str | None]
):
  for agent, expected in zip(("ppo", "ppo_paper", "ppo_v020", "sac"), chosen, strict=True):
    if expected:
      run = compose([f"env={task}", f"agent={agent}"])
      assert run.choices["tuned"] == expected
      assert compose(run.overrides).resolved == run.resolved


@pytest.mark.parametrize("robot", ["G1", "T1"])
@pytest.mark.parametrize("terrain", ["Flat", "Rough"])
def test_ppo_takes_the_set_of_020_for_the_humanoids(robot: str, terrain: str):
  """It makes five times the gradient steps of the paper's at three times the learning rate, and learns to walk."""
  task = f"{robot}Joystick{terrain}Terrain"
  ours, published = (compose([f"env={task}", f"agent={agent}"]).resolved["agent"] for agent in ("ppo", "ppo_v020"))
  assert ours == published
  assert compose([f"env={task}", "agent=ppo_paper"]).agent.learning_rate == 1e-4


def test_defaults_that_are_not_the_papers():
  agent = lambda task: compose([f"env={task}", "agent=ppo"]).agent
  assert agent("BerkeleyHumanoidJoystickFlatTerrain").learning_rate == 3e-4
  whole = (
    "SpotFlatTerrainJoystick",
    "BarkourJoystick",
    "H1JoystickGaitTracking",
    "BerkeleyHumanoidJoystickRoughTerrain",
    "AlohaSinglePegInsertion",
    "AlohaHandOver",
  )
  assert [agent(task).num_resets_per_eval for task in whole] == [1] * 6
  getup = [compose(["env=Go1Getup", f"agent={name}"]).agent for name in ("ppo", "ppo_paper")]
  assert [(each.num_timesteps, each.num_evals, each.num_resets_per_eval) for each in getup] == [
    (100_000_000, 6, 30),
    (50_000_000, 5, 10),
  ]
  hopper = agent("HopperHop")
  assert (hopper.entropy_cost, hopper.init_at_random_ep_len, hopper.reward_scaling) == (1e-3, True, 10.0)
  assert [compose(["env=CheetahRun", f"agent={name}"]).agent.max_grad_norm for name in ("ppo", "ppo_paper")] == [
    1.0,
    None,
  ]


def test_the_panda_sees_with_the_papers_cnn_unpooled_and_020_with_its_small_one():
  of = lambda agent: compose(["env=PandaPickCubeCartesianVision", f"agent={agent}"]).resolved["agent"]["network"]["cnn"]
  keys = ("channels", "max_pool", "global_pool", "normalize_channels")
  assert [of("ppo")[key] for key in keys] == [[32, 64, 64], False, "none", True]
  assert [of("ppo_v020")[key] for key in keys] == [[16, 32], True, "none", False]


def test_a_variant_can_do_without_a_tuned_set():
  untuned = compose(["agent=ppo_v020", "env=CartpoleBalance", "tuned=null"])
  assert untuned.choices["tuned"] is None
  assert untuned.agent.num_timesteps == 50_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class OwnPPOConfig(PPOConfig):
  """Settings of another package's variant of PPO."""

  half_life: int = 100


@pytest.fixture
def own_ppo(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
  """Installs `agent=own_ppo` as another package would."""
  point = EntryPoint("own_ppo", f"{__name__}:OwnPPOConfig", hyperparameters.ENTRY_POINTS)
  monkeypatch.setattr(hyperparameters, "_entry_points", lambda: {"own_ppo": point})
  defined.cache_clear()
  yield
  defined.cache_clear()


@pytest.mark.usefixtures("own_ppo")
def test_a_variant_of_our_algorithm_has_its_tuned_set():
  run = compose(["env=CheetahRun", "agent=own_ppo", "agent.half_life=20"])
  assert (run.choices["tuned"], run.agent.num_timesteps) == ("ppo/CheetahRun", 60_000_000)
  assert run.resolved["agent"]["half_life"] == 20
  assert compose(["env=CheetahRun", "agent=own_ppo", "tuned=null"]).agent.num_timesteps == 50_000_000


def test_an_algorithm_of_another_package_with_a_name_of_ours_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
  points = [EntryPoint(name, f"{__name__}:OwnPPOConfig", hyperparameters.ENTRY_POINTS) for name in ("ppo", "own_ppo")]
  monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
  with pytest.warns(match="^Entry point 'ppo' of playground.agents is not used: give it another name than ours"):
    found = hyperparameters._entry_points.__wrapped__()
  assert list(found) == ["ppo", "own_ppo"] and hyperparameters.config_class("ppo") is PPOConfig


@pytest.mark.parametrize("option", options("tuned"))
def test_a_tuned_set_belongs_to_an_agent_and_a_task(option: str):
  agent, task = option.split("/")
  assert agent in options("agent")
  listed = {name for source in SOURCES for name in rows(source)}  # some are yet to come
  assert task in {*options("env"), *listed, *FOR_ANY_TASK}


def agent_values(option: str) -> Iterator[dict[str, Any]]:
  """The agent's settings by dotted key of the files that a tuned set is built on, then its own."""
  content = yaml.safe_load((config_roots()[0] / "tuned" / f"{option}.yaml").read_text()) or {}
  for base in content.get("defaults", []):
    if base != "_self_":
      yield {key: value for values in agent_values(base.removeprefix("/tuned/")) for key, value in values.items()}
  yield dict(leaves(content.get("agent", {}), ""))


@pytest.mark.parametrize("option", options("tuned"))
def test_a_tuned_set_holds_what_differs(option: str):
  *bases, own = agent_values(option)
  cls = config_class(lineage("agent", option.partition("/")[0], config_roots())[-1])
  below = dict(leaves(defaults(cls), "")) | {key: value for values in bases for key, value in values.items()}
  assert not {key: value for key, value in own.items() if below[key] == value}


def test_the_pandas_experiment_from_pixels_has_a_set_of_its_own_and_the_task_alone_the_papers():
  choices = (["experiment=panda_pick_pixels"], ["env=PandaPickCubeCartesianVision"])
  ours, papers = (compose(choice).agent for choice in choices)
  assert [ours.num_envs, ours.network.estimated_obs_key] == [4096, "state"]
  assert [papers.num_envs, papers.network.estimated_obs_key] == [1024, ""]
  assert compose([*choices[0], "agent=ppo_v020"]).choices["tuned"] == "ppo_v020/PandaPickCubeCartesianVision"
