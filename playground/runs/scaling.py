"""Scales a run by the number of devices, so that each has the work of a single-device run (`hardware.scale_envs`)."""

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING

from playground.errors import ConfigError
from playground.learning.hyperparameters import AgentConfig

if TYPE_CHECKING:
  from playground.config import RunConfig

SCALED = ("num_envs", "batch_size")


def scale_envs(config: "RunConfig", devices: int) -> "tuple[RunConfig, str]":
  """Multiplies environments and batch, and so the environment steps of a training step, by the number of devices.

  The result, which is saved with the run, has the scaled sizes and `scale_envs: false`, so a run that is resumed on
  other devices keeps its sizes.

  Returns:
    The configuration, its stages' included, and a sentence about the change.

  Raises:
    ConfigError: the run is resumed, so its sizes are fixed.
  """
  if config.resume is not None:
    raise ConfigError(f"hardware.scale_envs=true would change the sizes of {config.resume}: they are fixed by now.")
  agent = (config.stages or [config])[0].agent
  changes = ", ".join(f"agent.{key} {size} -> {size * devices}" for key, size in _sizes(agent, SCALED).items())
  stages = tuple(_scaled(stage, devices) for stage in config.stages)
  notice = f"hardware.scale_envs: {devices} device{'s' * (devices > 1)}, so {changes}."
  return dataclasses.replace(_scaled(config, devices), stages=stages), notice


def describe_division(agent: AgentConfig, devices: int) -> str:
  """Returns a sentence on how environments and batch divide over devices."""
  sizes = _sizes(agent, (*SCALED, "num_eval_envs"))
  shares = [f"{size // devices} of agent.{key}={size}" for key, size in sizes.items()]
  return f"On each of {devices} devices: {', '.join(shares)}."


def _sizes(agent: AgentConfig, keys: Iterable[str]) -> dict[str, int]:
  """Returns the sizes that the algorithm has, by key."""
  return {key: getattr(agent, key) for key in keys if hasattr(agent, key)}


def _scaled(config: "RunConfig", devices: int) -> "RunConfig":
  sizes = {key: size * devices for key, size in _sizes(config.agent, SCALED).items()}
  sections = {"agent": sizes, "hardware": {"scale_envs": False}}
  resolved = {**config.resolved, **{key: {**config.resolved[key], **changes} for key, changes in sections.items()}}
  changed = {key: dataclasses.replace(getattr(config, key), **changes) for key, changes in sections.items()}
  return dataclasses.replace(config, resolved=resolved, **changed)
