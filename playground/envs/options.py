"""Settings of `env` that every task has, and those of several tasks that are texts or may be null.

The file of a task (configs/env/<TaskName>.yaml) adds the settings of its class and may change the defaults of these.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from playground.limits import MOST, SHARE, Limit, at_least_0, count, positive, span

TERMS = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class VisionConfig:
  """Settings of what a camera sees as the observation pixels/<camera> (docs/vision.md)."""

  enable: Annotated[bool, "whether the task observes pixels"] = False
  camera: Annotated[str | None, "name of one of the model's cameras"] = None
  image: Annotated[Literal["rgb", "gray", "depth", "segmentation"], "segmentation: geom id + 1, 0 is nothing"] = "rgb"
  width: Annotated[int, count(1, 4096), "pixels"] = 64
  height: Annotated[int, count(1, 4096), "pixels"] = 64
  frames: Annotated[int, count(1, 1000), "this image and the ones before it, newest last"] = 1
  brightness: Annotated[Sequence[float], span(), "factor on all pixels, drawn for every episode"] = (1.0, 1.0)
  farthest: Annotated[float, positive(), "distance at which a depth image is white, m"] = 5.0
  shadows: Annotated[bool, "whether shadows are drawn"] = False
  textures: Annotated[bool, "whether textures are drawn"] = False


@dataclasses.dataclass(frozen=True)
class EnvConfig:
  """Settings that every task has."""

  episode_length: Annotated[int, count(1, 2**24), "control steps"] = 1000
  action_repeat: Annotated[int, count(1, 1000), "control steps that take the same action"] = 1
  impl: Annotated[Literal["auto", "jax", "warp"], "physics; auto: cuda_impl on an NVIDIA GPU, else jax"] = "auto"
  cuda_impl: Annotated[str, "what auto is on an NVIDIA GPU: the faster backend as measured"] = "jax"
  naconmax_per_env: Annotated[int, count(0), "Warp: contacts of one environment, on average over the batch"] = 0
  naccdmax_per_env: Annotated[int | None, count(0), "Warp: of these, by convex collision; null: as many"] = None
  njmax: Annotated[int, count(0), "Warp: constraint rows of one environment"] = 0
  rewards: Annotated[TERMS, "reward terms by name (docs/add-a-reward.md)"] = dataclasses.field(default_factory=dict)
  terminations: Annotated[TERMS, "termination terms by name"] = dataclasses.field(default_factory=dict)
  events: Annotated[TERMS, "event terms by name"] = dataclasses.field(default_factory=dict)
  vision: Annotated[VisionConfig, "observations of pixels"] = dataclasses.field(default_factory=VisionConfig)


@dataclasses.dataclass(frozen=True)
class TermsConfig:
  """Settings of tasks that are made of terms (they have `env.observations`), beside the terms."""

  commands: Annotated[TERMS, "command terms by name"] = dataclasses.field(default_factory=dict)
  noise_level: Annotated[float, at_least_0(), "factor on all noise of observations"] = 1.0
  observation_frames: Annotated[int, count(1, 1000), "the group state is that of so many steps, newest first"] = 1
  observation_order: Annotated[
    Mapping[str, Sequence[str]], "by group: terms that come first in its vector; the others follow as they are listed"
  ] = dataclasses.field(default_factory=dict)
  reward_total: Annotated[Literal["sum", "product"], "product: sum of gains * exp(0.2 * sum of costs)"] = "sum"
  reward_clip: Annotated[Sequence[float] | None, span(-1e9), "range of a step's reward; null is any"] = None


@dataclasses.dataclass(frozen=True)
class RobotKeys:
  """Settings of `env.robot` that are texts or may be null."""

  mjcf: Annotated[str, "file of the robot's MJCF"]
  foot_pos: Annotated[Sequence[str], "names of the sensors of the feet's positions"]
  foot_contact: Annotated[Sequence[Sequence[str]], "names of the sensors of each foot's contacts"]
  pd: Annotated[Mapping[str, Any] | None, "gains of the position actuators; null keeps those of the MJCF"]


@dataclasses.dataclass(frozen=True)
class TaskKeys:
  """Settings of some tasks that are texts or may be null."""

  robot: RobotKeys


# Limits of the numbers of tasks' own keys, by name: the first that matches.
NUMBERS = {
  "links": count(3, 1000),
  "success_steps": count(0),
  "gripper_delay": count(0, 1000),
  "action_delay observation_delay": Limit(0, 1000, whole=True, form="list", length=2, rising=True),
  "*probability pose_noise.injection": SHARE,
  "ema_alpha": positive(1),
  "ctrl_dt sim_dt": positive(100),
  "robot.restricted_range.*": span(-MOST),
  "action_scale": positive().each,
  "hinge_damping max_torque robot.cube.half_size robot.cube.mass stuck_after target_radius": positive(),
  "success_angle success_distance success_threshold": positive(),
  "curriculum.angle curriculum.distance robot.pd.* robot.pose_weights": at_least_0().each,
  "goal.min_turn margin move_speed pose_noise.* sensor_noise.* settle_s": at_least_0(),
  "scene.terrain_params.* success_wait success_reward termination_reward": Limit(),
  "robot.cube.start robot.gaits.* robot.target_range.*": Limit().each,
}


def sees(env: Mapping[str, Any]) -> bool:
  """Whether a task of this `env` config sees through a camera."""
  return "vision" in env and env["vision"]["enable"]


def impl_on_gpu(env: Mapping[str, Any]) -> str:
  """The backend that an `env` config chooses on an NVIDIA GPU."""
  return auto_impl(env["cuda_impl"], sees(env), on_gpu=True) if env["impl"] == "auto" else env["impl"]


def auto_impl(cuda_impl: str, renders: bool, on_gpu: bool) -> str:
  """What `impl: auto` means: the backend that was measured faster, or the one that renders."""
  return "warp" if renders else cuda_impl if on_gpu else "jax"
