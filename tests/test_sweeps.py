"""Multiruns: what a sweep file and a glob stand for, and what is refused in which words."""

import csv
import re
from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from playground.config import compose, expand, first_job, options, sweeps, task_names
from playground.errors import ConfigError, UnknownNameError


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
  """A folder of sweep files in place of ours."""
  monkeypatch.setattr(sweeps, "shipped", lambda name: tmp_path)
  (tmp_path / "mine.yaml").write_text("params: {env: [CartpoleBalance, glob(Go1*)], agent: ppo, seed: range(2)}\n")
  return tmp_path


def jobs(overrides: list[str]) -> list[list[str]]:
  """The runs that Hydra's sweeper makes of overrides."""
  (batch,) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(overrides), None)
  return batch


@pytest.mark.parametrize("agent", ["ppo", "sac"])
def test_the_suite_is_25_tasks_with_5_seeds(agent: str):
  path = Path(__file__).parents[1] / "benchmarks/paper/hyperparameters_sac.csv"
  with path.open() as file:
    suite = {row["env"] for row in csv.DictReader(file)}
  expected = {(f"env={task}", f"agent={agent}", f"seed={seed}") for task in suite for seed in range(5)}
  found = jobs(expand([f"sweep=dm_control_{agent}"]))
  assert len(found) == 125
  assert set(map(tuple, found)) == expected


def test_locomotion_is_19_tasks_with_5_seeds():
  legged = {name for name in task_names() if re.search("Joystick|Getup|Handstand|Footstand|Gait", name)}
  expected = {(f"env={task}", "agent=ppo", f"seed={seed}") for task in legged for seed in range(5)}
  found = jobs(expand(["sweep=locomotion_ppo"]))
  assert len(found) == 19 * 5
  assert set(map(tuple, found)) == expected


def test_every_sweep_we_ship_starts():
  for name in sweeps.sweep_names():
    compose(first_job(expand([f"sweep={name}", "debug=fast"])))


def test_a_file_spelt_out(folder: Path):
  env = ",".join(["CartpoleBalance", *(name for name in task_names() if name.startswith("Go1"))])
  assert expand(["sweep=mine"]) == [f"env={env}", "agent=ppo", "seed=range(2)"]
  assert first_job(expand(["sweep=mine"])) == ["env=CartpoleBalance", "agent=ppo", "seed=0"]


def test_the_command_line_replaces_what_the_file_says(folder: Path):
  lines = expand(["seed=7", "sweep=mine", "env=CartpoleSwingup", "agent.num_envs=1,2", "hydra.verbose=true"])
  assert lines == ["agent=ppo", "seed=7", "env=CartpoleSwingup", "agent.num_envs=1,2", "hydra.verbose=true"]


def test_a_list_in_a_file_is_its_values_one_by_one(folder: Path):
  (folder / "sizes.yaml").write_text(
    "params: {agent.network.value_hidden_layer_sizes: [[8], [8, 8]], agent.max_grad_norm: [null, 1.0]}\n"
  )
  assert expand(["sweep=sizes"]) == [
    *("agent.network.value_hidden_layer_sizes=[8],[8, 8]", "agent.max_grad_norm=null,1.0"),
  ]
  assert len(jobs(expand(["sweep=sizes"]))) == 4


@pytest.mark.parametrize(
  ("glob", "names"),
  {
    "env=glob(*)": task_names(),  # neither parts such as _cartpole nor generic tasks such as joystick
    "env=glob(Cartpole*)": [name for name in task_names() if name.startswith("Cartpole")],
    "env=glob(Cartpole*,exclude=*Sparse)": ["CartpoleBalance", "CartpoleSwingup"],
    "env=glob([*lanceSparse,CartpoleB*])": ["CartpoleBalance", "CartpoleBalanceSparse"],
    "env=CartpoleSwingup,glob(CartpoleS*)": ["CartpoleSwingup", "CartpoleSwingupSparse"],
    "hardware=glob(*pu)": ["cpu", "gpu"],
    "tuned=glob(ppo/*)": [name for name in options("tuned") if name.startswith("ppo/")],
  }.items(),
)
def test_globs(glob: str, names: list[str]):
  assert expand([glob]) == [f"{glob.split('=')[0]}={','.join(names)}"]


@pytest.mark.parametrize(
  ("line", "message"),
  {
    "sweep=mne": "sweep=mne does not exist: choose from mine. Did you mean 'mine'?",
    "sweep=mine,mine": "sweep=mine,mine: one sweep at a time.",
    "sweep=mine sweep=mine": "sweep=mine sweep=mine: one sweep at a time.",
    "env=glob(Zebra*)": "env=glob(Zebra*) matches no option of env.",
    "env=glob(cartpolebal*)": "env=glob(cartpolebal*) matches no option of env. Did you mean 'CartpoleBalance'?",
    "seed=glob(*)": "seed=glob(*): seed has no options that a glob could stand for.",
    "env=CartpoleBalance,CartpoleSwngup": "env=CartpoleSwngup does not exist",
    "env=[1": "'env=[1' is not an override",
  }.items(),
)
def test_what_is_refused(folder: Path, line: str, message: str):
  with pytest.raises(ConfigError) as caught:
    expand(line.split())
  assert str(caught.value).startswith(message)
  assert isinstance(caught.value, UnknownNameError) == ("does not exist" in message or "matches no" in message)


@pytest.mark.parametrize(
  ("text", "message"),
  {
    "params: [": "sweep=bad: its file cannot be read: ",
    "": "sweep=bad: its file must hold `params:`, a mapping from keys to values, and nothing else.",
    "- seed": "sweep=bad: its file must hold `params:`",
    "parms: {seed: 1}": "sweep=bad: its file must hold `params:`",
    "params: {seed: 1}\nagent: ppo": "sweep=bad: its file must hold `params:`",
    "params: {}": "sweep=bad: its file must hold `params:`",
    "params: {seed: []}": "sweep=bad: params.seed=[] must be a value or a list of values.",
    "params: {agent: {num_envs: 1}}": "sweep=bad: params.agent={num_envs: 1} must be a value or a list of values.",
    "params: {env: CartpoleBalanc}": "env=CartpoleBalanc does not exist",
  }.items(),
)
def test_files_that_are_no_sweep(folder: Path, text: str, message: str):
  (folder / "bad.yaml").write_text(text)
  with pytest.raises(ConfigError) as caught:
    expand(["sweep=bad"])
  assert str(caught.value).startswith(message)
  assert "\n" not in str(caught.value)


def test_a_key_that_does_not_exist_is_found_in_the_first_job(folder: Path):
  (folder / "typo.yaml").write_text("params: {env: CartpoleBalance, agent.learning_rat: [1, 2]}\n")
  with pytest.raises(UnknownNameError, match=r"Did you mean 'agent\.learning_rate'\?"):
    compose(first_job(expand(["sweep=typo"])))
