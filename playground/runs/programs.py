"""Which runs have the same compiled program, and so can train together."""

import json
from typing import TYPE_CHECKING

if TYPE_CHECKING:
  from playground.config import RunConfig


def program_of(config: "RunConfig") -> str | None:
  """What a run's compiled program depends on, as text: runs in which it is the same can train together.

  Returns:
    None for a run that trains alone: a chain, one that W&B tracks (it has one run a process), one that is profiled, and
    one on several machines.
  """
  alone = config.stages or config.tracking.wandb.enable or config.profile.enable or config.hardware.distributed.enable
  if alone:
    return None
  resolved = {key: value for key, value in config.resolved.items() if key not in ("seed", "run_dir", "resume")}
  traced = config.agent.traced
  resolved["agent"] = {key: value for key, value in resolved["agent"].items() if key not in traced}
  resolved["init_from"] = config.init_from is not None
  return json.dumps(resolved, sort_keys=True, default=str)
