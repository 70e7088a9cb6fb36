"""What types cannot say: choices, ranges, and sizes that must divide. A new limit is a new entry here."""

import dataclasses
import fnmatch
import functools
import operator
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, get_type_hints

from playground.config.schema import wrong_type
from playground.config.text import format_value, join
from playground.errors import ConfigError, nearest
from playground.learning.hyperparameters import config_class
from playground.limits import MOST, SEED, SHARE, Limit, at_least_0, count, positive, span
from playground.mdp.options import OPTIONS

_PRECISIONS = ("default", "high", "highest", "bfloat16", "tensorfloat32", "float32")
_CHOICES = {
  "env.impl": ("auto", "jax", "warp"),
  "env.vision.image": ("rgb", "gray", "depth", "segmentation"),
  "hardware.platform": ("auto", "cpu", "gpu"),
  "hardware.matmul_precision": _PRECISIONS,
  "hardware.network_precision": _PRECISIONS,
  "on_error": ("continue", "stop"),
  "search.direction": ("maximize", "minimize"),
  "search.metric": ("final_return", "best_return", "steps_per_second", "wall_clock_s"),
  "search.sampler": ("tpe", "random", "cmaes"),
}
_XLA_SWITCH = re.compile(r"--xla_\w+(=(true|false|-?\d+(\.\d+)?))?")
_XLA_PLACES = ("dir", "path", "file", "dump", "load", "cache", "option", "override", "_to", "_from")  # in flags' names
# Text (or null, as everywhere), lists of texts, and lists of such lists.
_TEXTS = {
  0: "run_dir resume init_from sweep_dir curriculum.start_at video.camera "
  "hardware.cache_dir hardware.kind hardware.distributed.coordinator "
  "tracking.wandb.entity tracking.wandb.group tracking.wandb.name "
  "launcher.address launcher.partition launcher.account launcher.qos launcher.constraint "
  "env.vision.camera env.robot.mjcf",
  1: "tracking.wandb.tags launcher.setup env.robot.foot_pos env.observation_order.*",
  2: "env.robot.foot_contact",
}
_OF_TERMS = re.compile(rf"env\.({'|'.join(OPTIONS)})\.")  # checked when a task binds them (playground/mdp/terms.py)
_NESTED = ("text (put quotes around a number)", "a list of texts", "a list of lists of texts")
# Numbers of a run; those of agent have theirs beside their definition (playground/learning/hyperparameters.py).
_RUN = {
  "seed search.seed": SEED,
  "on_nonfinite.max_fraction": SHARE,
  "hardware.memory_fraction": positive(1),
  "hardware.devices hardware.distributed.num_processes": count(1, 100_000),
  "hardware.distributed.process_id": count(0, 100_000),
  "hardware.distributed.timeout hardware.distributed.lost_after": positive(),
  "checkpoint.keep video.every_evals video.episodes profile.steps": count(1),
  "video.width video.height": count(1, 8192),
  "curriculum.scale": at_least_0(1000),
  "launcher.timeout launcher.minutes launcher.memory_gb": positive(),
  "launcher.slots_per_gpu launcher.cores_per_job launcher.max_parallel": count(1),
  "launcher.gpus launcher.requeues launcher.retries": count(0),
  "launcher.grace launcher.gpus_per_job": at_least_0(),
  "search.trials search.parallel": count(1),
}
# Numbers of a task, by name: the first that matches.
_ENV = {
  "episode_length": count(1, 2**24),
  "action_repeat observation_frames vision.frames links": count(1, 1000),
  "vision.width vision.height": count(1, 4096),
  "naconmax_per_env naccdmax_per_env njmax success_steps": count(0),
  "gripper_delay": count(0, 1000),
  "action_delay observation_delay": Limit(0, 1000, whole=True, form="list", length=2, rising=True),
  "*probability pose_noise.injection": SHARE,
  "ema_alpha": positive(1),
  "ctrl_dt sim_dt": positive(100),
  "reward_clip robot.restricted_range.*": span(-MOST),
  "vision.brightness": span(),
  "action_scale": positive().each,
  "hinge_damping max_torque stuck_after target_radius vision.farthest": positive(),
  "success_angle success_distance success_threshold": positive(),
  "curriculum.angle curriculum.distance robot.pd.* robot.pose_weights": at_least_0().each,
  "goal.min_turn margin move_speed noise_level pose_noise.* sensor_noise.* settle_s": at_least_0(),
  "scene.terrain_params.* success_wait success_reward termination_reward": Limit(),
  "robot.gaits.* robot.target_range.*": Limit().each,
}


def check_limits(resolved: Mapping[str, Any]) -> None:
  """Checks the values that are there; a configuration may lack sections, and null is no value.

  Raises:
    ConfigError: the first value that cannot work.
  """
  for key, value in _leaves(resolved):
    if value is not None and not _OF_TERMS.match(key):
      _check(key, value, _get(resolved, "agent.name"))
  _check_xla_flags(_get(resolved, "hardware.xla_flags"))
  env = resolved.get("env", {})
  _check_order(env, "env")
  contacts, convex = env.get("naconmax_per_env"), env.get("naccdmax_per_env")
  if contacts is not None and convex is not None and convex > contacts:
    raise ConfigError(f"env.naccdmax_per_env={convex} must not be above env.naconmax_per_env={contacts}.")
  _check_batch(*(_get(resolved, f"agent.{key}") for key in ("num_envs", "batch_size", "num_minibatches")))


@functools.cache
def limit_of(key: str, agent: str | None = None) -> Limit | None:
  """The limit of a dotted key's numbers, None if there is none; `agent` is the algorithm's name."""
  section, _, name = key.partition(".")
  if section == "agent":
    return _of_agent(config_class(agent), name) if agent else None
  table, name = (_ENV, name) if section == "env" else (_RUN, key)
  return next((limit for patterns, limit in table.items() if _matches(name, patterns)), None)


@functools.cache
def text_depth(key: str) -> int | None:
  """How deep the texts of a dotted key are nested in lists: 0 is a text itself; None if it takes no texts."""
  return next((depth for depth, patterns in _TEXTS.items() if _matches(key, patterns)), None)


def _check(key: str, value: Any, agent: str | None) -> None:
  shown = f"{key}={format_value(value)}"
  if (allowed := _CHOICES.get(key)) and value not in allowed:
    raise ConfigError(f"{shown} is unknown: choose from {', '.join(allowed)}.{nearest(str(value), allowed)}")
  depth = text_depth(key)
  if depth is not None and not _is_text(value, depth):
    raise wrong_type(key, value, _NESTED[depth])
  limit = limit_of(key, agent) or (Limit().each if _numbers(value) else None)
  if limit is not None and not limit.allows(value):
    raise ConfigError(f"{shown} must be {limit}.")


def _of_agent(config_class: Any, name: str) -> Limit | None:
  """The limit in the annotation of a field, or of a field of a dataclass in it."""
  head, _, rest = name.partition(".")
  hint = get_type_hints(config_class, include_extras=True).get(head)
  if rest:
    return _of_agent(hint, rest) if dataclasses.is_dataclass(hint) else None
  return next((entry for entry in getattr(hint, "__metadata__", ()) if isinstance(entry, Limit)), None)


def _check_order(node: Mapping[str, Any], key: str) -> None:
  """Raises ConfigError where a number is above the one whose name has `max` for its `min`, `upper` for `lower`."""
  for name, low in node.items():
    other = str(name).replace("min", "max").replace("lower", "upper")
    if isinstance(low, Mapping):
      _check_order(low, f"{key}.{name}")
    elif other != name and any(map(operator.gt, _numbers(low), _numbers(node.get(other)))):
      high = format_value(node[other])
      raise ConfigError(f"{key}.{name}={format_value(low)} must not be above {key}.{other}={high}.")


def check_vision(said: Iterable[str], resolved: Mapping[str, Any]) -> None:
  """Raises ConfigError where a command line says how a task sees (its keys are `said`) that sees nothing."""
  unused = [key for key in said if key.startswith("env.vision.") and key != "env.vision.enable"]
  if unused and _get(resolved, "env.vision.enable") is False:
    raise ConfigError(f"{unused[0]}: this task sees nothing. Add env.vision.enable=true env.vision.camera=<name>.")


def _check_xla_flags(flags: Any) -> None:
  """Allows switches and numbers alone: some flags write to files, or name a folder of programs that XLA starts."""
  for flag in flags.split() if isinstance(flags, str) else []:
    if not _XLA_SWITCH.fullmatch(flag) or any(word in flag for word in _XLA_PLACES):
      what = "must be switches and numbers, such as --xla_gpu_deterministic_ops=true"
      raise ConfigError(f"hardware.xla_flags={flag} is refused: they {what}; export others in XLA_FLAGS.")


def _check_batch(num_envs: int | None, batch_size: int | None, num_minibatches: int | None) -> None:
  if num_envs is None or batch_size is None or num_minibatches is None:
    return
  if batch_size * num_minibatches % num_envs:
    product = f"agent.batch_size * agent.num_minibatches = {batch_size} * {num_minibatches}"
    raise ConfigError(
      f"agent.num_envs={num_envs} does not divide {product} = {batch_size * num_minibatches}: "
      "choose sizes so that it does."
    )


def _matches(key: str, patterns: str) -> bool:
  return any(fnmatch.fnmatchcase(key, pattern) for pattern in patterns.split())


def _is_text(value: Any, depth: int) -> bool:
  if depth == 0:
    return isinstance(value, str)
  return isinstance(value, list) and all(_is_text(entry, depth - 1) for entry in value)


def _numbers(value: Any) -> list[float]:
  """The numbers in a value, a number or a list."""
  if isinstance(value, list):
    return [number for entry in value for number in _numbers(entry)]
  return [value] if isinstance(value, int | float) and not isinstance(value, bool) else []


def _leaves(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
  """Dotted keys and values of everything that is no mapping, or an empty one."""
  for name, value in node.items():
    if isinstance(value, Mapping) and value:
      yield from _leaves(value, join(prefix, name))
    else:
      yield join(prefix, name), value


def _get(node: Any, key: str) -> Any:
  """The value of a dotted key, None if there is none."""
  for part in key.split("."):
    node = node.get(part) if isinstance(node, Mapping) else None
  return node
