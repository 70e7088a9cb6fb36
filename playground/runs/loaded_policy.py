"""Loads a trained policy of a run, with its task and networks, on this machine."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
from ml_collections import ConfigDict

from playground import config as configs
from playground import registry
from playground.config import RunConfig
from playground.envs.base import Env, Observation
from playground.errors import CheckpointError
from playground.hardware.options import Platform
from playground.hardware.setup import Hardware, setup, this_machine
from playground.learning.algorithm import Policy
from playground.learning.checkpoints import Checkpoint
from playground.learning.trainer import Trainer
from playground.pretrained import other_meaning
from playground.runs.restore_plan import check_origin, weights_of
from playground.runs.run_dir import RunDirectory


@dataclasses.dataclass(frozen=True)
class LoadedPolicy:
  """A checkpoint's policy, with its run, task and networks.

  Attributes:
    run_dir: the run's directory.
    config: the run's configuration, with overrides of the task.
    checkpoint: the policy's checkpoint.
    env: the task as the run trained it but for overrides, or as `load_task` made it.
    hardware: this machine's devices.
    trainer: the algorithm's trainer, whose `act(policy, obs, key, deterministic)` returns actions.
    policy: networks and normaliser, on the devices.
  """

  run_dir: RunDirectory
  config: RunConfig
  checkpoint: Checkpoint
  env: Env
  hardware: Hardware
  trainer: Trainer
  policy: Policy

  @property
  def task(self) -> str:
    return self.config.choices["env"]

  def act(self, obs: Observation, key: jax.Array, deterministic: bool | None = None) -> jax.Array:
    """Returns actions in [-1, 1], [..., action_size]."""
    return self.trainer.act(self.policy, obs, key, deterministic)

  def at(self, path: Path) -> "LoadedPolicy":
    """Returns the policy of another checkpoint of the run or its chain, with this task and configuration.

    Raises:
      CheckpointError: the checkpoint is missing or damaged, or its arrays have other shapes.
    """
    checkpoint = Checkpoint(path)
    policy = self.trainer.place_policy(checkpoint.restore("policy", self.trainer.policy_shape()))
    return dataclasses.replace(self, run_dir=RunDirectory(path.parents[1]), checkpoint=checkpoint, policy=policy)


def load_policy(
  path: str | Path,
  overrides: Sequence[str] = (),
  *,
  load_task: Callable[[str, ConfigDict], Env] | None = None,
  platform: Platform | None = None,
  precision: str | None = None,
) -> LoadedPolicy:
  """Reads a run's newest checkpoint, or the one at `path`.

  Args:
    path: a run directory, one of its checkpoints, or `pretrained:<task>`.
    overrides: of the task, such as `env.episode_length=500`.
    load_task: builds a task from a name and a configuration; `registry.load` if None.
    platform: device type; if None the run's, if this machine has it.
    precision: of the networks' matrix products; the run's if None.

  Raises:
    PlaygroundError: no such run or checkpoint, one that is damaged or does not fit, or an invalid override.
  """
  checkpoint = weights_of(path)
  run_dir = RunDirectory.open(checkpoint.path.parents[1])
  config = configs.from_saved(run_dir.config)
  check_origin(checkpoint, config)
  if overrides:
    env = configs.override_task(config.resolved["env"], overrides)
    config = configs.from_dict({**config.resolved, "env": env}, config.overrides)
  hardware = setup(this_machine(config.hardware, platform))
  env = (load_task or registry.load)(config.choices["env"], config.env)
  trainer = Trainer(env, config.agent, hardware.mesh, precision or hardware.network_precision)
  try:
    policy = trainer.place_policy(checkpoint.restore("policy", trainer.policy_shape()))
  except CheckpointError:
    meaning = other_meaning(run_dir.config["env"], config.resolved["env"]) if overrides else []
    changed = [key for key in meaning if key.startswith("env.observation")]
    if not changed:
      raise
    raise CheckpointError(
      f"{' '.join(overrides)} does not fit the policy, which was trained with other {changed[0]}: leave it as it was."
    ) from None
  return LoadedPolicy(run_dir, config, checkpoint, env, hardware, trainer, policy)
