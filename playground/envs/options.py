"""Settings of `env`: type, limit and meaning of every key.

`EnvConfig` and `TermsConfig` have defaults, which the file of a task (configs/env/<TaskName>.yaml) may change. The keys
of `TaskKeys` have none: a task has those that its file or family file sets.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from playground.limits import MOST, SHARE, VECTOR, Limit, at_least_0, count, positive, span

TERMS = dict[str, Any]
# Keys of `env`, of which a task may lack some, that define the numbers that a policy reads and what its actions do.
MEANING = ("observations", "observation_order", "observation_frames", "ctrl_dt", "action_repeat")
MEANING += ("action_base", "action_scale", "clip_targets", "ema_alpha", "max_torque")
_NUMBERS = Limit(form="list")
_DELAY = Limit(0, 1000, whole=True, form="list", length=2, rising=True)


@dataclasses.dataclass(frozen=True)
class VisionConfig:
  """Settings of the images of a camera, the observation pixels/<camera> (docs/vision.md)."""

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
  cuda_impl: Annotated[Literal["jax", "warp"], "what auto is on an NVIDIA GPU: the faster backend as measured"] = "jax"
  naconmax_per_env: Annotated[int, count(0), "Warp: contacts of one environment, on average over the batch"] = 0
  naccdmax_per_env: Annotated[int | None, count(0), "Warp: of these, by convex collision; null: as many"] = None
  njmax: Annotated[int, count(0), "Warp: constraint rows of one environment"] = 0
  rewards: Annotated[TERMS, "reward terms by name (docs/add-a-reward.md)"] = dataclasses.field(default_factory=dict)
  terminations: Annotated[TERMS, "termination terms by name"] = dataclasses.field(default_factory=dict)
  events: Annotated[TERMS, "event terms by name"] = dataclasses.field(default_factory=dict)
  vision: Annotated[VisionConfig, "observations of pixels"] = dataclasses.field(default_factory=VisionConfig)


@dataclasses.dataclass(frozen=True)
class TermsConfig:
  """Settings of tasks that are made of terms (they have `env.observations`)."""

  commands: Annotated[TERMS, "command terms by name"] = dataclasses.field(default_factory=dict)
  noise_level: Annotated[float, at_least_0(), "factor on all noise of observations"] = 1.0
  observation_frames: Annotated[int, count(1, 1000), "the group state is that of so many steps, newest first"] = 1
  observation_order: Annotated[
    Mapping[str, Sequence[str]], "by group: terms that come first in its vector; the others follow as they are listed"
  ] = dataclasses.field(default_factory=dict)
  reward_total: Annotated[Literal["sum", "product"], "product: sum of gains * exp(0.2 * sum of costs)"] = "sum"
  reward_clip: Annotated[Sequence[float] | None, span(-1e9), "range of a step's reward; null is any"] = None


@dataclasses.dataclass(frozen=True)
class PdKeys:
  """Keys of `env.robot.pd`; null leaves the MJCF's own, which may differ between joints."""

  kp: Annotated[float | None, at_least_0(), "position gain of every servo, N m/rad"] = None
  kv: Annotated[float | None, at_least_0(), "velocity gain of every servo, N m s/rad"] = None
  damping: Annotated[float | None, at_least_0(), "damping of every joint, N m s/rad"] = None


@dataclasses.dataclass(frozen=True)
class CubeKeys:
  """Keys of `env.robot.cube`, the cube in a hand."""

  half_size: Annotated[float, positive(), "half the length of the cube's edge, m"]
  mass: Annotated[float, positive(), "kg"]
  start: Annotated[Sequence[float], VECTOR, "position of the cube in keyframe home, m"]


@dataclasses.dataclass(frozen=True)
class SensorKeys:
  """Keys of `env.robot.sensors`: the name that terms read, and the sensor of the MJCF, or a list of sensors."""

  linvel: Annotated[str, "sensor of the base's linear velocity, base frame, m/s"]
  gyro: Annotated[str, "sensor of the base's angular velocity, base frame, rad/s"]
  accelerometer: Annotated[str, "sensor of the base's acceleration, base frame, m/s^2"]
  upvector: Annotated[str, "sensor of the base's z axis, world frame"]
  global_linvel: Annotated[str, "sensor of the base's linear velocity, world frame, m/s"]
  global_angvel: Annotated[str, "sensor of the base's angular velocity, world frame, rad/s"]
  torso_linvel: Annotated[str, "sensor of the torso's linear velocity, world frame, m/s"]
  torso_angvel: Annotated[str, "sensor of the torso's angular velocity, world frame, rad/s"]
  fingertip_pos: Annotated[Sequence[str], "sensors of the fingertips' positions, palm frame, m"]
  tendon_length: Annotated[Sequence[str], "sensors of the lengths of the tendons that motors pull, m"]
  joint_sensors: Annotated[Sequence[str], "sensors of the joints that have one, rad"]


@dataclasses.dataclass(frozen=True)
class TargetRangeKeys:
  """Keys of `env.robot.target_range`."""

  lower: Annotated[Sequence[float], _NUMBERS, "lowest target of each joint, rad"]
  upper: Annotated[Sequence[float], _NUMBERS, "highest target of each joint, rad"]


@dataclasses.dataclass(frozen=True)
class RobotKeys:
  """Keys of `env.robot` (docs/add-a-robot.md). Lists over feet follow the order of `feet`."""

  name: Annotated[str, "option of the group robot"]
  mjcf: Annotated[str, "file of the robot's MJCF"]
  root: Annotated[str, "body that is pushed, and that carries the payload"]
  base_site: Annotated[str, "site whose frame is the base's, as its IMU's"]
  feet: Annotated[Sequence[str], "names of the feet's sites"]
  keyframe: Annotated[str, "keyframe of the default pose"]
  mirror: Annotated[Mapping[str, str], "left: right, what names of parts begin or end with"]
  joints: Annotated[Sequence[str], "joints in the order of qpos[7:], qvel[6:] and the actuators"]
  pd: Annotated[PdKeys | None, "gains of the position servos; null keeps those of the MJCF"]
  hips: Annotated[Sequence[str], "hip joints that do not swing the leg, which terms keep near the default pose"]
  hip_rolls: Annotated[Sequence[str], "hip joints that move the leg sideways"]
  knees: Annotated[Sequence[str], "knee joints"]
  pose_weights: Annotated[Sequence[float], Limit(0, form="list"), "weight of each joint in rewards of the pose"]
  gaits: Annotated[Mapping[str, Sequence[float]], _NUMBERS, "first phase of each foot, rad: -pi lifts off, 0 is up"]
  restricted_range: Annotated[
    Mapping[str, Sequence[float]], span(-MOST), "with env.restricted_joint_range: limits, rad"
  ]
  target_range: Annotated[TargetRangeKeys, "limits of the targets with env.clip_targets; without: the servos'"]
  sensors: Annotated[SensorKeys, "sensors by the name that terms read"]
  foot_linvel: Annotated[Sequence[str], "sensors of the feet's linear velocities, world frame, m/s"]
  foot_pos: Annotated[Sequence[str], "sensors of the feet's positions, base frame, m; [] where no term reads them"]
  foot_force: Annotated[Sequence[str], "force sensors of the feet, frame of the foot's site, N"]
  foot_contact: Annotated[Sequence[Sequence[str]], "contact sensors of each foot: it touches if any is above 0"]
  floor_contacts: Annotated[Sequence[str], "geoms that get a sensor <geom>_floor_found, in the order of the sensors"]
  self_contact: Annotated[Sequence[str], "sensors of contacts between the robot's parts that a reward may punish"]
  fatal_contact: Annotated[Sequence[str], "sensors of contacts between the robot's parts that end an episode"]
  cube: Annotated[CubeKeys, "the cube in the hand"]


@dataclasses.dataclass(frozen=True)
class SceneKeys:
  """Keys of `env.scene` of robots on legs."""

  terrain: Annotated[str, "ground: flat, rough, stairs, slope, white_noise (playground/robots/terrain.py)"]
  terrain_params: Annotated[Mapping[str, float], Limit(), "parameters of the terrain's function"]
  collision: Annotated[str, "contacts: feet (feet and floor), full_floor (all parts and floor), full_self (all parts)"]


@dataclasses.dataclass(frozen=True)
class PoseNoiseKeys:
  """Keys of `env.pose_noise`, the noise of the tracked cube."""

  pos: Annotated[float, at_least_0(), "error of the position, uniform in +- noise_level * pos, m"]
  angle: Annotated[float, at_least_0(), "largest error of the orientation, rad"]
  injection: Annotated[float, SHARE, "probability that the tracked pose is random"]


@dataclasses.dataclass(frozen=True)
class GoalKeys:
  """Keys of `env.goal`."""

  min_turn: Annotated[float, at_least_0(), "smallest turn from one goal to the next, rad"]


@dataclasses.dataclass(frozen=True)
class GoalLevels:
  """Keys of `env.curriculum`: the goals of each level."""

  distance: Annotated[Sequence[float], at_least_0().each, "by level: largest distance of a goal from the middle, m"]
  angle: Annotated[Sequence[float], at_least_0().each, "by level: largest turn of a goal from the block's, rad"]


@dataclasses.dataclass(frozen=True)
class TaskKeys:
  """Keys of `env` that only some tasks have. The file of a task sets them; they have no defaults."""

  task: Annotated[str, "class of the task, module:class"]
  ctrl_dt: Annotated[float, positive(100), "control step, s"]
  sim_dt: Annotated[float, positive(100), "physics step, s"]
  robot: RobotKeys
  scene: Annotated[SceneKeys | str, "ground and contacts; of arms, a scene of playground/robots/tabletop.py"]
  keyframe: Annotated[str, "keyframe of the scene that episodes start from, before reset events"]
  action_base: Annotated[str, "what an action is added to: default_pose, joint_pos, last_target; hands: home"]
  action_scale: Annotated[
    float | Sequence[float], positive().each, "target's change by an action of 1, rad (slides: m)"
  ]
  clip_targets: Annotated[bool, "whether targets are clipped to the servos' ranges (the torque is bounded anyway)"]
  restricted_joint_range: Annotated[bool, "whether the joints' limits are env.robot.restricted_range"]
  settle_s: Annotated[float, at_least_0(), "physics before an episode starts, s"]
  support: Annotated[Sequence[str], "feet to stand on"]
  torque_limits: Annotated[bool, "whether the hand's motors have the torque limits of the hardware"]
  ema_alpha: Annotated[float, positive(1), "share of the new target: target = ema_alpha * new + (1 - ema_alpha) * last"]
  pose_noise: Annotated[PoseNoiseKeys, "noise of the tracked cube, which sensed_cube_* read; a file's {} is none"]
  goal: GoalKeys
  object: Annotated[str, "body to bring to the goal"]
  gripper: Annotated[str, "site at the tip of the gripper"]
  gripper_delay: Annotated[int, count(0, 1000), "longest delay of the fingers, drawn in every control step, steps"]
  guide_probability: Annotated[float, SHARE, "probability that an episode starts with the cube in the hand"]
  max_torque: Annotated[float, positive(), "largest torque of the arm's motors, N m"]
  action_delay: Annotated[Sequence[int], _DELAY, "delay of actions, drawn in every control step, steps"]
  observation_delay: Annotated[Sequence[int], _DELAY, "delay of the group state, drawn in every control step, steps"]
  curriculum: GoalLevels
  success_distance: Annotated[float, positive(), "largest distance from the goal that counts as success, m"]
  success_angle: Annotated[float | None, positive(), "largest turn from the goal that is a success, rad; null: any"]
  success_steps: Annotated[int, count(0), "control steps at the goal before it counts as reached"]
  success_threshold: Annotated[float, positive(), "largest turn from the goal that counts as success, rad"]
  stuck_after: Annotated[float, positive(), "time without a goal reached after which `rotations` counts no more, s"]
  move_speed: Annotated[float, at_least_0(), "speed that gets the full reward, m/s; 0: stand still"]
  margin: Annotated[float, at_least_0(), "distance from the target at which the reward is 0.1, m; 0: no reward outside"]
  swing_up: Annotated[bool, "whether an episode starts with the pole hanging"]
  sparse: Annotated[bool, "whether the reward is 1 at the target and 0 elsewhere"]
  target_radius: Annotated[float, positive(), "radius of the target, m"]
  hinge_damping: Annotated[float, positive(), "damping of the spinner's hinge, N m s/rad"]
  links: Annotated[int, count(3, 1000), "links of the body"]


def uses_vision(env: Mapping[str, Any]) -> bool:
  """Whether a task of this `env` config observes images."""
  return "vision" in env and env["vision"]["enable"]


def impl_on_gpu(env: Mapping[str, Any]) -> str:
  """The backend that an `env` config chooses on an NVIDIA GPU."""
  return auto_impl(env["cuda_impl"], uses_vision(env), on_gpu=True) if env["impl"] == "auto" else env["impl"]


def auto_impl(cuda_impl: str, renders: bool, on_gpu: bool) -> str:
  """Returns the backend of `impl: auto`: the one that was measured faster, or the one that renders."""
  return "warp" if renders else cuda_impl if on_gpu else "jax"
