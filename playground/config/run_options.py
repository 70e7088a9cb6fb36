"""Settings of what a run records (metrics, checkpoints, videos, profiles), and of the runs that follow each other."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypedDict

from playground.limits import SHARE, at_least_0, count, positive


@dataclasses.dataclass(frozen=True)
class WandbConfig:
  """Settings of Weights & Biases."""

  enable: Annotated[bool, "whether metrics go to Weights & Biases"] = False
  project: Annotated[str, "the project of the run"] = "playground"
  entity: Annotated[str | None, "the account or team; null is the account's default"] = None
  group: Annotated[str | None, "runs of one group are shown together"] = None
  name: Annotated[str | None, "the run's name; null is that of the run directory"] = None
  tags: Annotated[Sequence[str], "words to find the run by"] = ()
  mode: Annotated[Literal["auto", "online", "offline", "disabled"], "auto is online if logged in, else offline"] = (
    "auto"
  )
  upload: Annotated[bool, "whether the policy, videos and plots are uploaded when the run ends"] = False


@dataclasses.dataclass(frozen=True)
class TrackingConfig:
  """Settings of the trackers; metrics.csv is always written."""

  tensorboard: Annotated[bool, "whether TensorBoard's files are written"] = False
  wandb: Annotated[WandbConfig, "Weights & Biases"] = dataclasses.field(default_factory=WandbConfig)


@dataclasses.dataclass(frozen=True)
class CheckpointConfig:
  """Settings of checkpoints."""

  keep: Annotated[
    int, count(1), "newest checkpoints that are kept, beside the one with the highest return (checkpoints/best)"
  ] = 3


@dataclasses.dataclass(frozen=True)
class VideoConfig:
  """Settings of videos of the policy."""

  enable: Annotated[bool, "whether videos are recorded"] = True
  at_end: Annotated[bool, "whether one is recorded after training"] = True
  every_evals: Annotated[int | None, count(1), "also after every n-th evaluation"] = None
  episodes: Annotated[int, count(1), "episodes of a video"] = 1
  width: Annotated[int, count(1, 8192), "pixels"] = 640
  height: Annotated[int, count(1, 8192), "pixels"] = 480
  camera: Annotated[str | None, "one of the model's; null is a view of the whole scene"] = None
  visuals: Annotated[
    Literal["primitives", "menagerie"],
    "menagerie is the robot's meshes, of the package mujoco-menagerie (with legs)",
  ] = "primitives"


@dataclasses.dataclass(frozen=True)
class NonfiniteConfig:
  """Settings of what happens to numbers that are NaN or infinite."""

  max_fraction: Annotated[
    float, SHARE, "share of environment steps, or of gradient steps, that are NaN or infinite and stop the run"
  ] = 0.01


@dataclasses.dataclass(frozen=True)
class ProfileConfig:
  """Settings of JAX's profiler."""

  enable: Annotated[bool, "whether one evaluation's stretch of training is traced (debug=profile)"] = False


class StageConfig(TypedDict):
  """A stage of a chain."""

  num_timesteps: Annotated[int | None, positive(1e12), "environment steps of the stage; null: the task's own budget"]
  overrides: Annotated[Sequence[Any], "what this stage and the later ones change, as on the command line"]


@dataclasses.dataclass(frozen=True)
class CurriculumConfig:
  """A single run. A chain adds stages, each a run that starts from the last one's weights (docs/curricula.md)."""

  scale: Annotated[
    float, at_least_0(1000), "share of its budget that every stage gets; 0: agent.num_timesteps for each"
  ] = 1.0
  start_at: Annotated[str | None, "a later stage to start at, from the weights that init_from names"] = None
  stages: Annotated[Mapping[str, StageConfig], "by name: num_timesteps and overrides"] = dataclasses.field(
    default_factory=dict
  )
