"""The part of `rsl_rl.py` that is torch: RSL-RL's algorithm, lent a training state for one iteration at a time."""

# torch is in an extra, which the type checker may not find
# pyright: reportMissingImports=false

import math
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage

from playground.adapters.rsl_rl import OBS_GROUPS, VecEnv, to_jax, to_torch
from playground.learning.networks import ActorCriticParams

if TYPE_CHECKING:
  from playground.learning.rsl_rl import RslRlPPOConfig

Learned = tuple[ActorCriticParams, Any, dict[str, Any]]  # parameters, normalisers, the optimiser's state


class TorchPPO:
  """RSL-RL's PPO for a batch of environments."""

  def __init__(self, env: VecEnv, config: "RslRlPPOConfig", precision: str | None):
    """Builds models, storage and algorithm on the environments' device.

    Args:
      env: the environments.
      config: hyperparameters.
      precision: of matrix products; torch knows float32 (`highest`) and TF32.
    """
    torch.set_float32_matmul_precision("highest" if precision in ("highest", "float32") else "high")
    obs, device, network = env.get_observations(), str(env.device), config.network
    common = {"activation": network.activation, "obs_normalization": config.normalize_observations}
    gaussian = {"class_name": "GaussianDistribution", "init_std": network.init_noise_std}
    actor = MLPModel(
      *(obs, OBS_GROUPS, "actor", env.num_actions, list(network.policy_hidden_layer_sizes)),
      distribution_cfg=gaussian,
      **common,
    )
    critic = MLPModel(obs, OBS_GROUPS, "critic", 1, list(network.value_hidden_layer_sizes), **common)
    self._unroll_length = config.unroll_length
    self._models = {"policy": actor, "value": critic}
    self._ppo = PPO(
      actor,
      critic,
      RolloutStorage("rl", env.num_envs, config.unroll_length, obs, [env.num_actions], device),
      num_learning_epochs=config.num_updates_per_batch,
      num_mini_batches=config.num_minibatches,
      clip_param=config.clipping_epsilon,
      gamma=config.discounting,
      lam=config.gae_lambda,
      value_loss_coef=config.vf_loss_coefficient,
      entropy_coef=config.entropy_cost,
      learning_rate=config.learning_rate,
      max_grad_norm=math.inf if config.max_grad_norm is None else config.max_grad_norm,
      use_clipped_value_loss=config.clip_value_loss,
      schedule=config.schedule,
      desired_kl=config.desired_kl,
      device=device,
    )
    self._ppo.train_mode()

  def training_step(self, env: VecEnv, learned: Learned, key: jax.Array) -> tuple[Learned, dict[str, np.float32]]:
    """Collects and learns once.

    Args:
      env: where the environments stand; they are stepped on.
      learned: what to learn on from.
      key: for actions and minibatches; torch's global generators are seeded from it.

    Returns:
      What was learned, in arrays of its own, and the means of the log.
    """
    torch.manual_seed(int(jax.random.bits(key)))
    self._load(learned)
    ppo, obs = self._ppo, env.get_observations()
    with torch.inference_mode():
      for _ in range(self._unroll_length):
        obs, rewards, dones, extras = env.step(ppo.act(obs))
        ppo.process_env_step(obs, rewards, dones, extras)
      ppo.compute_returns(obs)
    losses = ppo.update()
    means = {"policy_loss": losses["surrogate"], "value_loss": losses["value"], "entropy": losses["entropy"]}
    means |= {"policy_std": float(ppo.actor.output_std.detach().mean()), "learning_rate": ppo.learning_rate}
    return self._learned(), {name: np.float32(mean) for name, mean in means.items()}

  def _tensors(self) -> tuple[ActorCriticParams, Any, dict[str, Any]]:
    """The live tensors that stand for `Learned`'s arrays, but for the optimiser's two numbers."""
    params = ActorCriticParams(*(dict(model.named_parameters()) for model in self._models.values()))
    buffers = {name: dict(model.named_buffers()) for name, model in self._models.items()}
    state = self._ppo.optimizer.state
    if not state:  # which Adam makes at its first step
      for tensor in jax.tree.leaves(params):
        state[tensor] = {"step": torch.tensor(0.0)} | {k: torch.zeros_like(tensor) for k in ("exp_avg", "exp_avg_sq")}
    moments = {k: jax.tree.map(lambda tensor, k=k: state[tensor][k], params) for k in ("exp_avg", "exp_avg_sq")}
    return params, buffers, moments

  @torch.no_grad()
  def _load(self, learned: Learned) -> None:
    params, normalizer, opt_state = learned
    step, rate = float(opt_state["step"]), float(opt_state["learning_rate"])
    theirs = (params, normalizer, {k: opt_state[k] for k in ("exp_avg", "exp_avg_sq")})
    jax.tree.map(lambda tensor, array: tensor.copy_(to_torch(array)), self._tensors(), theirs)
    for state in self._ppo.optimizer.state.values():
      state["step"].fill_(step)
    self._ppo.learning_rate = rate
    for group in self._ppo.optimizer.param_groups:
      group["lr"] = rate

  def _learned(self) -> Learned:
    params, buffers, moments = jax.tree.map(_array, self._tensors())
    step = next(iter(self._ppo.optimizer.state.values()))["step"]
    numbers = {"step": float(step), "learning_rate": self._ppo.learning_rate}
    return params, buffers, moments | {name: jnp.asarray(x, jnp.float32) for name, x in numbers.items()}


def _array(tensor: torch.Tensor) -> jax.Array:
  """An array of its own; whole numbers in 32 bits (a count of observations, to which then nothing is added)."""
  if tensor.dtype == torch.int64:
    tensor = tensor.clamp(max=torch.iinfo(torch.int32).max).to(torch.int32)
  return to_jax(tensor.clone())
