"""Multiruns: what a sweep file and a glob stand for, and what is refused in which words."""

import csv
import re
from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from playground.config import (
  combinations,
  compose_all,
  compose_settings,
  expand,
  listed_jobs,
  options,
  sweeps,
  task_names,
  varying,
  with_listed,
)
from playground.config.sweep_options import LAUNCHERS, SEARCHES
from playground.errors import ConfigError, UnknownNameError
from tests.aliases import LAUGHS


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
  """A folder of sweep files in place of ours."""
  monkeypatch.setattr(sweeps, "shipped", lambda name: tmp_path)
  (tmp_path / "mine.yaml").write_text("params: {env: [CartpoleBalance, glob(Go1*)], agent: ppo, seed: range(2)}\n")
  return tmp_path


def jobs(overrides: list[str]) -> list[list[str]]:
  """The runs that overrides stand for, which are those that Hydra's sweeper makes of them."""
  (batch,) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(overrides), None)
  found = combinations(overrides)
  assert found == batch
  return found


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


def test_manipulation_is_10_tasks_with_5_seeds():
  handled = {name for name in task_names() if re.match("(Aero|Aloha|Leap|Panda)(?!.*Vision)", name)}
  expected = {(f"env={task}", "agent=ppo", f"seed={seed}") for task in handled for seed in range(5)}
  found = jobs(expand(["sweep=manipulation_ppo"]))
  assert len(found) == 10 * 5
  assert set(map(tuple, found)) == expected


def test_every_sweep_we_ship_starts():
  for name in sweeps.sweep_names():
    compose_all(combinations(expand([f"sweep={name}", "debug=fast"]))[:1])


def test_a_file_spelt_out(folder: Path):
  env = ",".join(["CartpoleBalance", *(name for name in task_names() if name.startswith("Go1"))])
  assert expand(["sweep=mine"]) == [f"env={env}", "agent=ppo", "seed=range(2)"]
  assert combinations(expand(["sweep=mine"]))[0] == ["env=CartpoleBalance", "agent=ppo", "seed=0"]


def test_a_file_may_use_anchors(folder: Path):
  (folder / "two.yaml").write_text("params: {seed: &few [1, 2], agent.num_envs: *few}")
  assert expand(["sweep=two"]) == ["seed=1,2", "agent.num_envs=1,2"]


def test_the_command_line_replaces_what_the_file_says(folder: Path):
  lines = expand(["seed=7", "sweep=mine", "env=CartpoleSwingup", "agent.num_envs=1,2", "hydra.verbose=true"])
  assert lines == ["agent=ppo", "seed=7", "env=CartpoleSwingup", "agent.num_envs=1,2", "hydra.verbose=true"]


def test_a_list_in_a_file_is_its_values_one_by_one(folder: Path):
  (folder / "sizes.yaml").write_text(
    "params: {agent.network.value_hidden_layer_sizes: [[8], [8, 8]], agent.max_grad_norm: [null, 1.0],\n"
    "  tracking.wandb.project: [\"'a,b'\", c]}\n"
  )
  assert expand(["sweep=sizes"]) == [
    *("agent.network.value_hidden_layer_sizes=[8],[8, 8]", "agent.max_grad_norm=null,1.0"),
    "tracking.wandb.project='a,b',c",
  ]
  assert len(jobs(expand(["sweep=sizes"]))) == 8


@pytest.mark.parametrize(
  ("glob", "names"),
  {
    "env=glob(*)": task_names(),  # neither parts such as _cartpole nor generic tasks such as joystick
    "env=glob(Cartpole*)": [name for name in task_names() if name.startswith("Cartpole")],
    "env=glob(Cartpole*,exclude=*Sparse)": ["CartpoleBalance", "CartpoleBalanceVision", "CartpoleSwingup"],
    "env=glob([*lanceSparse,CartpoleS*])": ["CartpoleBalanceSparse", "CartpoleSwingup", "CartpoleSwingupSparse"],
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
    "sweep=mne": "sweep=mne does not exist: choose from mine, or give the path of a .yaml file. Did you mean 'mine'?",
    "sweep=no/mine.yaml": "sweep=no/mine.yaml does not exist, or is not a file.",
    "sweep=mine,mine": "sweep=mine,mine: one sweep at a time.",
    "sweep=mine sweep=mine": "sweep=mine sweep=mine: one sweep at a time.",
    "env=glob(Zebra*)": "env=glob(Zebra*) matches no option of env.",
    "env=glob(cartpolebal*)": "env=glob(cartpolebal*) matches no option of env. Did you mean 'CartpoleBalance'?",
    "seed=glob(*)": "seed=glob(*): seed has no options that a glob could stand for.",
    "env=CartpoleBalance,CartpoleSwngup": "env=CartpoleSwngup does not exist",
    "env=[1": "'env=[1' is not an override",
    "seed=range(0,2,0)": "seed=range(0,2,0) has no values: range() arg 3 must not be zero.",
    "seed=range(2),5": "seed=range(2),5: a range stands alone, so list its values among the others.",
    "seed=1,2 seed=3,4": "seed=1,2 seed=3,4: give all values of seed in one list.",
    "seed=0,1 seed=2": "seed=0,1 seed=2: give all values of seed in one list.",
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
    "": "sweep=bad: its file must hold `params:` or `jobs:` or both, and nothing else.",
    "- seed": "sweep=bad: its file must hold `params:`",
    "parms: {seed: 1}": "sweep=bad: its file must hold `params:`",
    "params: {seed: 1}\nagent: ppo": "sweep=bad: its file must hold `params:`",
    "params: {}": "sweep=bad: `params:` must be a mapping from keys to values.",
    "jobs: seed=1": "sweep=bad: `jobs:` must be a list of command lines.",
    "jobs: [seed=1, {seed: 1}]": "sweep=bad: `jobs:` must be a list of command lines.",
    "jobs: ['seed=1 sed']": "'sed' is not an override",
    "jobs: ['env=CartpoleBalanc']": "env=CartpoleBalanc does not exist",
    "jobs: ['seed=1 launcher.mps=true']": "sweep=bad: launcher.mps=true in its job 'seed=1 launcher.mps=true' is of",
    "jobs: ['seed=1 run_dir=x']": "run_dir=x cannot be given with -m",
    "params: {seed: []}": "sweep=bad: params.seed=[] must be a value or a list of values.",
    "params: {agent: {num_envs: 1}}": "sweep=bad: params.agent={num_envs: 1} must be a value or a list of values.",
    "params: {run_dir: ['a,b', c]}": "sweep=bad: 'a,b' in params.run_dir is not one value: write \"'a,b'\".",
    "params: {tracking.wandb.project: ['a=b']}": "sweep=bad: 'a=b' in params.tracking.wandb.project is not one value",
    "params: {env: CartpoleBalanc}": "env=CartpoleBalanc does not exist",
    "jobs: ['seed=\"1']": "sweep=bad: its job 'seed=\"1' cannot be read: No closing quotation.",
    "params: &a {seed: *a}": "sweep=bad: its file cannot be read: ",
    LAUGHS: "sweep=bad: its file cannot be read: its aliases stand for more than 10,000 values.",
    "params: {seed: é}": "sweep=bad: its file cannot be read: ",
  }.items(),
)
def test_files_that_are_no_sweep(folder: Path, text: str, message: str):
  (folder / "bad.yaml").write_text(text, encoding="latin-1")
  with pytest.raises(ConfigError) as caught:
    expand(["sweep=bad"])
    listed_jobs(["sweep=bad"])
  assert str(caught.value).startswith(message)
  assert "\n" not in str(caught.value)


def test_listed_jobs_are_combined_with_what_all_have(folder: Path):
  (folder / "these.yaml").write_text(
    "params: {seed: range(2), agent.num_envs: 64}\n"
    "jobs:\n- env=CartpoleBalance\n- env=CheetahRun,WalkerRun agent=sac agent.num_envs=128\n- seed=7 agent.num_envs=8\n"
  )

  def sets(*given: str) -> list[list[str]]:
    return with_listed(expand(["sweep=these", *given]), listed_jobs(["sweep=these", *given]))

  assert sets() == [
    ["seed=range(2)", "agent.num_envs=64", "env=CartpoleBalance"],
    ["seed=range(2)", "env=CheetahRun,WalkerRun", "agent=sac", "agent.num_envs=128"],
    ["seed=7", "agent.num_envs=8"],
  ]
  assert [len(combinations(lines)) for lines in sets()] == [2, 4, 1]
  assert varying(*sets()) == ["seed", "agent.num_envs", "env", "agent"]
  assert varying(*sets("seed=3", "agent.num_envs=8")) == ["env", "agent"]  # the command line's word is the last
  assert [lines[0] for lines in sets("seed=3")] == ["agent.num_envs=64", "seed=3", "seed=3"]
  assert with_listed(["seed=1"], []) == [["seed=1"]] and listed_jobs(["seed=1"]) == []


@pytest.mark.parametrize("key", ["terrain", "env.scene.terrain"])
def test_a_short_key_is_the_key_that_it_stands_for(folder: Path, key: str) -> None:
  text = (
    "params: {env: Go1JoystickFlatTerrain, terrain: slope}\njobs: [terrain=rough, env.scene.terrain=slope, seed=2]\n"
  )
  (folder / "terrains.yaml").write_text(text)
  given = ["sweep=terrains", f"{key}=stairs"]
  jobs = with_listed(expand(given), listed_jobs(given))
  assert jobs == [["env=Go1JoystickFlatTerrain", f"{key}=stairs"]] * 2 + [
    ["env=Go1JoystickFlatTerrain", f"{key}=stairs", "seed=2"]
  ]
  with pytest.raises(
    ConfigError, match=r"terrain=rough,slope .*terrain=stairs: give all values of .*terrain in one list"
  ):
    expand(["env=Go1JoystickFlatTerrain", "terrain=rough,slope", "env.scene.terrain=stairs"])


def test_every_job_is_checked_and_named(folder: Path):
  (folder / "typo.yaml").write_text("params: {env: CartpoleBalance, agent.learning_rat: [1, 2]}\n")
  with pytest.raises(UnknownNameError, match=r"Did you mean 'agent\.learning_rate'\?"):
    compose_all(combinations(expand(["sweep=typo"])))
  with pytest.raises(ConfigError, match=r"^Job env=PointMass agent\.num_envs=7: agent\.num_envs=7 does not"):
    compose_all(combinations(["env=CartpoleBalance,PointMass", "agent.num_envs=256,7"])[2:])


@pytest.mark.parametrize(
  ("lines", "count", "keys"),
  [
    ("seed=range(3) env=CartpoleBalance,CheetahRun", 6, ["seed", "env"]),
    ("agent.learning_rate=choice(0.1,0.2) seed=1", 2, ["agent.learning_rate"]),
    ("seed=1,1", 1, ["seed"]),
    ("tuned=null", 1, []),
    ("tuned=null,ppo/CheetahRun", 2, ["tuned"]),
    ("experiment=go1_joystick,spot_joystick env.rewards.joint_power_l1.weight=-0.001", 2, ["experiment"]),
    ("agent.network.policy_hidden_layer_sizes=[8],[8,8]", 2, ["agent.network.policy_hidden_layer_sizes"]),
  ],
)
def test_combinations(lines: str, count: int, keys: list[str]):
  overrides = expand(lines.split())
  assert (len(combinations(overrides)), varying(overrides)) == (count, keys)
  compose_all(combinations(overrides))


@pytest.mark.parametrize(("lines", "count"), [(["seed=range(1e6)"], "1,000,000"), (["seed=range(999)"] * 2, "998,001")])
def test_too_many_jobs(lines: list[str], count: str):
  with pytest.raises(ConfigError, match=f"^This sweep has {count} jobs, more than 10,000: list fewer values"):
    combinations(lines)


@pytest.mark.parametrize(
  ("line", "message"),
  {
    "run_dir=x": "run_dir=x cannot be given with -m",
    "resume=x": "resume=x cannot be given with -m",
    "hydra.sweep.dir=x": "hydra.sweep.dir=x: -m does not use Hydra's",
    "hydra/launcher=joblib": "hydra/launcher=joblib: -m does not use Hydra's",
    "on_error=stop,continue": "on_error=stop,continue: give one value, which applies to all jobs of the sweep.",
    "launcher=local,slurm": "launcher=local,slurm: give one value,",
  }.items(),
)
def test_keys_that_jobs_cannot_have(line: str, message: str):
  with pytest.raises(ConfigError) as caught:
    sweeps.split(["seed=1", line])
  assert str(caught.value).startswith(message)


@pytest.mark.parametrize(
  ("line", "message"),
  {
    "launcher=slrm": "launcher=slrm does not exist: choose from local, ray, slurm, together. Did you mean 'slurm'?",
    "launcher.timeot=3": "launcher.timeot does not exist: launcher has name, ",
    "launcher.exploit_every=1": "launcher.exploit_every does not exist for launcher=local, only for launcher=together.",
    "search.trials=5": "search.trials does not exist for search=grid, only for search=optuna.",
    "launcher.timeout=-3": "launcher.timeout=-3 must be a number above 0 and at most 1000000000.",
    "launcher.slots_per_gpu=many": "launcher.slots_per_gpu=many has the wrong type",
    "on_error=halt": "on_error=halt is unknown: choose from continue, stop.",
    "launcher=local,slurm": "launcher=local,slurm names several values",
  }.items(),
)
def test_settings_are_checked(line: str, message: str):
  with pytest.raises(ConfigError) as caught:
    compose_settings([line])
  assert str(caught.value).startswith(message)


@pytest.mark.parametrize("launcher", options("launcher"))
@pytest.mark.parametrize("search", options("search"))
def test_settings(launcher: str, search: str):
  settings = compose_settings([f"launcher={launcher}", f"search={search}", "launcher.timeout=90", "sweep_dir=x"])
  assert (type(settings.launcher), type(settings.search)) == (LAUNCHERS[launcher], SEARCHES[search])
  assert (settings.launcher.timeout, settings.sweep_dir, settings.on_error) == (90, "x", "continue")
