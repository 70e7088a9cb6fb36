"""`hardware.scale_envs`: as much work for each device as one device alone would have."""

import dataclasses
from typing import TYPE_CHECKING, Any

from playground.config import config_dict
from playground.errors import ConfigError

if TYPE_CHECKING:
  from playground.config import RunConfig

SCALED = ("num_envs", "batch_size")


def scale_envs(config: "RunConfig", devices: int) -> "tuple[RunConfig, str]":
  """Multiplies environments and batch by the devices; a training step then collects that much more.

  What is returned, and saved with the run, holds the sizes that were meant and `scale_envs: false`, so that a run that
  is resumed on other devices keeps them.

  Returns:
    The configuration, its stages' included, and what was done, in a sentence.

  Raises:
    ConfigError: the run is resumed, so its sizes are fixed.
  """
  if config.resume is not None:
    raise ConfigError(f"hardware.scale_envs=true would change the sizes of {config.resume}: they are fixed by now.")
  agents = [stage.agent for stage in config.stages] or [config.agent]
  sizes = [key for key in SCALED if key in agents[0]]
  changes = ", ".join(f"agent.{key} {agents[0][key]} -> {agents[0][key] * devices}" for key in sizes)
  stages = tuple(_scaled(stage, devices) for stage in config.stages)
  notice = f"hardware.scale_envs: {devices} device{'s' * (devices > 1)}, so {changes}."
  return dataclasses.replace(_scaled(config, devices), stages=stages), notice


def describe_division(agent: Any, devices: int) -> str:
  """How environments and batch divide, in a sentence."""
  sizes = [key for key in (*SCALED, "num_eval_envs") if key in agent]
  shares = [f"{agent[key] // devices} of agent.{key}={agent[key]}" for key in sizes]
  return f"On each of {devices} devices: {', '.join(shares)}."


def _scaled(config: "RunConfig", devices: int) -> "RunConfig":
  agent = {key: size * devices if key in SCALED else size for key, size in config.resolved["agent"].items()}
  resolved = {**config.resolved, "agent": agent, "hardware": {**config.resolved["hardware"], "scale_envs": False}}
  sections = {key: config_dict(resolved[key]) for key in ("agent", "hardware")}
  return dataclasses.replace(config, resolved=resolved, **sections)
