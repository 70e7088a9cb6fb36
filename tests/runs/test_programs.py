"""Where a run's lowered functions are stored: what shapes them names the file, what does not leaves it."""

from pathlib import Path
from typing import Any

import pytest

from playground import fingerprint
from playground.config import compose
from playground.hardware.mesh import make_mesh
from playground.hardware.setup import Hardware
from playground.runs.programs import stored_program
from playground.runs.restore_plan import RestorePlan
from playground.runs.train import prepare

pytestmark = pytest.mark.stored_programs
FAST = ("env=CartpoleBalance", "debug=fast", "hardware=cpu", "tuned=null")


def stored(cache: str | None, *overrides: str, from_policy: bool = False, **parts: Any) -> Path | None:
  """The file of a run's program; `parts` are attributes of its task."""
  config = compose([*FAST, *overrides])
  hardware = Hardware(make_mesh(1), None, {"compilation_cache": cache})
  training = prepare([config], [RestorePlan()], hardware)
  if not parts and not from_policy:
    return training.stored and training.stored.path
  for name, value in parts.items():
    setattr(training.env.unwrapped, name, value)
  program = stored_program(config, training.trainer, hardware, from_policy=from_policy, resets=False, num_recorded=0)
  return program and program.path


@pytest.fixture(scope="module")
def known() -> Path | None:
  return stored("/cache")


def test_it_lies_beside_jax_programs(known: Path):
  assert known is not None and known.parent == Path("/cache/programs")
  assert stored("/cache") == known


def test_a_reward_weight_is_an_argument():
  robot = ("env=Go1JoystickFlatTerrain",)
  one = stored("/cache", *robot)
  assert one == stored("/cache", *robot, "env.rewards.action_rate_l2.weight=2.0")
  assert one != stored("/cache", *robot, "env.rewards.action_rate_l2.weight=0")


@pytest.mark.parametrize(
  "override",
  [
    "seed=2",
    "agent.learning_rate=1e-5",
    "agent.num_timesteps=3000",
    "agent.num_evals=3",
    "agent.num_resets_per_eval=1",  # the last of which is the end
    "video.width=320",
    "tracking=csv",
    "checkpoint.keep=3",
  ],
)
def test_what_is_no_constant_of_the_program_leaves_it(known: Path, override: str):
  assert stored("/cache", override) == known


@pytest.mark.parametrize(
  "override",
  [
    "env.episode_length=30",
    "agent.num_envs=16",
    "agent.network.policy_hidden_layer_sizes=[8]",
    "agent.num_resets_per_eval=2",
    "video.enable=true",
  ],
)
def test_what_shapes_the_program_names_another(known: Path, override: str):
  assert stored("/cache", override) not in (known, None)


def test_code_weights_and_what_the_task_holds_name_another(known: Path, monkeypatch: pytest.MonkeyPatch):
  assert stored("/cache", loaded_data=[1.0]) != known
  assert stored("/cache", from_policy=True) != known
  monkeypatch.setattr(fingerprint, "of_code", lambda: "edited")
  assert stored("/cache") != known


def test_nothing_is_stored_where_it_could_not_be_found_again(monkeypatch: pytest.MonkeyPatch):
  assert stored(None) is None
  assert stored("gs://bucket") is None
  assert stored("/cache", impl="warp") is None

  def refuse() -> str:
    raise fingerprint.NoFingerprintError

  monkeypatch.setattr(fingerprint, "of_code", refuse)
  assert stored("/cache") is None
