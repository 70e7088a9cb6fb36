"""What types cannot say: choices, ranges, and sizes that must divide. A new limit is a new entry here."""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from playground.config.schema import wrong_type
from playground.config.text import format_value
from playground.errors import ConfigError, nearest

_PRECISIONS = ("default", "high", "highest", "bfloat16", "tensorfloat32", "float32")
_CHOICES = {
  "agent.schedule": ("fixed", "adaptive"),
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
_PATHS = ("run_dir", "resume", "init_from", "sweep_dir", "hardware.cache_dir")
# Of a number, or (key[]) of each number of a list.
_RANGES: tuple[tuple[str, Callable[[float], bool], str], ...] = (
  (
    "above 0",
    lambda x: x > 0,
    "agent.num_timesteps agent.num_evals agent.num_envs agent.num_eval_envs agent.unroll_length agent.batch_size "
    "agent.num_minibatches agent.num_updates_per_batch agent.learning_rate agent.max_grad_norm agent.clipping_epsilon "
    "agent.clipping_epsilon_value agent.grad_updates_per_step agent.max_replay_size "
    "agent.alpha_learning_rate agent.desired_kl agent.network.init_noise_std "
    "agent.network.policy_hidden_layer_sizes[] agent.network.value_hidden_layer_sizes[] "
    "agent.network.hidden_layer_sizes[] agent.network.cnn.channels[] agent.network.cnn.kernels[] "
    "agent.network.cnn.strides[] "
    "env.ctrl_dt env.sim_dt env.episode_length env.action_repeat checkpoint.keep "
    "video.every_evals video.episodes video.width video.height hardware.devices profile.steps "
    "env.vision.width env.vision.height env.vision.frames env.vision.farthest "
    "env.max_torque env.stuck_after env.success_angle env.success_distance env.success_threshold "
    "launcher.timeout launcher.slots_per_gpu launcher.cores_per_job launcher.minutes launcher.memory_gb "
    "launcher.max_parallel search.trials search.parallel",
  ),
  (
    "0 or more",
    lambda x: x >= 0,
    "seed agent.num_resets_per_eval agent.entropy_cost agent.vf_loss_coefficient agent.estimation_coefficient "
    "agent.min_replay_size agent.augment_pixels "
    "curriculum.scale env.njmax env.naconmax_per_env env.naccdmax_per_env env.gripper_delay "
    "env.noise.level env.reset.box_xy env.reset.box_y env.reset.cube_spread env.reset.joint_std env.reset.target_angle "
    "env.vision.brightness[] env.reset.target_spread env.reset.target_xy env.success_steps launcher.grace "
    "launcher.gpus launcher.gpus_per_job launcher.requeues launcher.retries search.seed",
  ),
  (
    "between 0 and 1",
    lambda x: 0 <= x <= 1,
    "agent.discounting agent.gae_lambda agent.tau env.ema_alpha env.guide_probability env.noise.pose.injection "
    "hardware.memory_fraction on_nonfinite.max_fraction",
  ),
)
_LENGTHS = {
  "two numbers, from and to": (
    2,
    "env.gait.foot_height env.gait.frequency env.pushes.angular_velocity env.pushes.duration env.pushes.interval "
    "env.pushes.velocity env.reset.joint_scale env.reset.target_height env.reward.clip env.vision.brightness",
  ),
  "three numbers": (
    3,
    "env.command.min env.command.max env.command.nonzero_probability env.obs_scales.command env.reset.cube_pos "
    "env.reward.forward env.reward.upvector_target",
  ),
}


def check_limits(resolved: Mapping[str, Any]) -> None:
  """Checks the values that are there; a configuration may lack sections, and null is no value.

  Raises:
    ConfigError: the first value that cannot work.
  """
  for key, allowed in _CHOICES.items():
    value = _get(resolved, key)
    if value is not None and value not in allowed:
      near = nearest(str(value), allowed)
      raise ConfigError(f"{key}={format_value(value)} is unknown: choose from {', '.join(allowed)}.{near}")
  for key in _PATHS:
    value = _get(resolved, key)
    if value is not None and not isinstance(value, str):
      raise wrong_type(key, value, "text (put quotes around a number)")
  for what, holds, keys in _RANGES:
    for key in keys.split():
      key, is_list, _ = key.partition("[]")
      value = _get(resolved, key)
      entries = value if is_list and isinstance(value, list) else [value]
      if value is not None and not all(_is_number(entry) and holds(entry) for entry in entries):
        raise ConfigError(f"{key}={format_value(value)} must be {'numbers' if is_list else 'a number'} {what}.")
  for what, (length, keys) in _LENGTHS.items():
    for key in keys.split():
      value = _get(resolved, key)
      if isinstance(value, list) and (len(value) != length or (length == 2 and value[0] > value[1])):
        raise ConfigError(f"{key}={format_value(value)} must be {what}.")
  contacts, convex = (_get(resolved, f"env.{key}") for key in ("naconmax_per_env", "naccdmax_per_env"))
  if contacts is not None and convex is not None and convex > contacts:
    raise ConfigError(f"env.naccdmax_per_env={convex} must not be above env.naconmax_per_env={contacts}.")
  _check_batch(*(_get(resolved, f"agent.{key}") for key in ("num_envs", "batch_size", "num_minibatches")))


def check_vision(said: Iterable[str], resolved: Mapping[str, Any]) -> None:
  """Raises ConfigError where a command line says how a task sees (its keys are `said`) that sees nothing."""
  unused = [key for key in said if key.startswith("env.vision.") and key != "env.vision.enable"]
  if unused and _get(resolved, "env.vision.enable") is False:
    raise ConfigError(f"{unused[0]}: this task sees nothing. Add env.vision.enable=true env.vision.camera=<name>.")


def _check_batch(num_envs: int | None, batch_size: int | None, num_minibatches: int | None) -> None:
  if num_envs is None or batch_size is None or num_minibatches is None:
    return
  if batch_size * num_minibatches % num_envs:
    product = f"agent.batch_size * agent.num_minibatches = {batch_size} * {num_minibatches}"
    raise ConfigError(
      f"agent.num_envs={num_envs} does not divide {product} = {batch_size * num_minibatches}: "
      "choose sizes so that it does."
    )


def _is_number(value: Any) -> bool:
  return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _get(node: Any, key: str) -> Any:
  """The value of a dotted key, None if there is none."""
  for part in key.split("."):
    node = node.get(part) if isinstance(node, Mapping) else None
  return node
