"""A batch of environments for RSL-RL (rsl-rl-lib 5): `OnPolicyRunner(vec_env(task, num_envs=4096), config)`.

Tensors are views of JAX's arrays and the other way round (DLPack), on a GPU and on a CPU: nothing is copied. Neither
side may write to an array that it received. DLPack orders the two libraries' work on a GPU. Memory that JAX frees
while torch still reads it is reused in the next step at the earliest, which waits for torch's actions.
"""

# torch is in an extra, which the type checker may not find
# pyright: reportMissingImports=false

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp

from playground.adapters.episodes import need_shape
from playground.envs.base import PIXELS, Env, Observation, State, observation_groups
from playground.envs.wrappers import FINAL_OBS, AutoReset, wrap_for_evaluation
from playground.errors import ConfigError, lookup
from playground.extras import install_command
from playground.learning.rollout import episode_sums
from playground.randomization import Randomizer
from playground.settings import Section

try:
  import torch
  from rsl_rl import env as rsl_rl_env
  from tensordict import TensorDict
except ImportError:
  raise ConfigError(f"playground.adapters.rsl_rl needs RSL-RL and torch: {install_command('rsl-rl')}.") from None

Extra = torch.Tensor | TensorDict | dict[str, float]
PRIVILEGED = "privileged_state"
OBS_GROUPS = {"actor": ["policy"], "critic": ["critic"]}  # for RSL-RL's configuration: which model reads which group


def to_torch(array: jax.Array) -> torch.Tensor:
  """Returns a tensor in the memory of an array."""
  return torch.from_dlpack(array)


def to_jax(tensor: torch.Tensor) -> jax.Array:
  """Returns an array in the memory of a tensor, which must not be written to afterwards."""
  return jax.dlpack.from_dlpack(tensor.detach().contiguous())


class VecEnv(rsl_rl_env.VecEnv):
  """The environment that RSL-RL steps: one batch on one device, with auto-reset.

  Observations have the groups `policy` and `critic`. `extras["time_outs"]` is 1 where time ended the episode, and not
  the task, so that RSL-RL bootstraps the value; `extras["final_obs"]` are the observations that the
  step itself made, in the same groups: where an episode ended, its last (RSL-RL 5 does not look at them and takes the
  value of the observation before instead; an algorithm of yours may). `extras["log"]` has the means of reward, length
  and the task's metrics over the episodes that ended in the step, if any did, and the share of them that a non-finite
  number ended.

  Attributes:
    state: the current batch of states.
    max_episode_length: control steps; `episode_length_buf` counts those of the current episodes.
    step_dt: s between two actions, by which RSL-RL scales rewards of its own.
    cfg: the task's configuration, which RSL-RL's loggers save.
  """

  def __init__(self, env: Env, state: State, step: Callable[[State, jax.Array], State], groups: Mapping[str, str]):
    """Takes a batch of environments; `vec_env` makes one.

    Args:
      env: the task.
      state: the batch of states to start from.
      step: advances the state by actions [N, action_size].
      groups: the task's observation group for each RSL-RL group.
    """
    self.state, self._step, self.groups = state, step, groups
    self.num_envs, self.num_actions = state.done.shape[0], env.action_size
    self.max_episode_length = env.episode_length
    self.device = to_torch(state.done).device
    self.step_dt = env.dt * env.action_repeat
    self.cfg = env.config
    self._sums = jax.jit(episode_sums)

  @property
  def unwrapped(self) -> "VecEnv":
    return self

  @property
  def episode_length_buf(self) -> torch.Tensor:  # pyright: ignore[reportIncompatibleVariableOverride]
    return (to_torch(self.state.info["steps"]) * (1 - to_torch(self.state.done))).long()  # auto-reset

  @episode_length_buf.setter
  def episode_length_buf(self, steps: torch.Tensor) -> None:
    need_shape("episode_length_buf", steps, (self.num_envs,))
    state = self.state
    placed = jax.device_put(to_jax(steps.to(torch.float32, copy=True)), state.info["steps"].sharding)
    self.state = state.replace(done=jnp.zeros_like(state.done), info=state.info | {"steps": placed})

  def get_observations(self) -> TensorDict:
    """Returns the current observations."""
    return self._grouped(self.state.obs)

  def _grouped(self, obs: Observation) -> TensorDict:
    entries = observation_groups(obs)
    return TensorDict({group: to_torch(entries[entry]) for group, entry in self.groups.items()}, [self.num_envs])

  def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict[str, Extra]]:
    """Applies actions, [num_envs, num_actions], clipped to [-1, 1]; see RSL-RL's `VecEnv.step` for what it returns.

    Raises:
      ConfigError: actions of another shape, which JAX may broadcast.
    """
    need_shape("actions", actions, (self.num_envs, self.num_actions))
    state = self.state = self._step(self.state, to_jax(actions.clamp(-1.0, 1.0)))
    extras: dict[str, Extra] = {"time_outs": to_torch(state.info["truncation"])}
    if FINAL_OBS in state.info:
      extras[FINAL_OBS] = self._grouped(state.info[FINAL_OBS])
    sums = self._sums(state)
    if ended := float(sums["episodes"]):
      means = {name: float(sums[f"episode_{name}"]) / ended for name in state.info["episode_metrics"]}
      means |= {"reward": means.pop("sum_reward"), "nonfinite": float(sums["nonfinite"]) / ended}
      extras["log"] = {f"Episode/{name}": mean for name, mean in means.items()}
    return self.get_observations(), to_torch(state.reward), to_torch(state.done), extras


def vec_env(
  env: Env,
  num_envs: int,
  *,
  seed: int = 0,
  events: Section | None = None,
  groups: Mapping[str, str] | None = None,
) -> VecEnv:
  """Makes a batch of environments of a task for RSL-RL.

  Args:
    env: the task, from `registry.load`.
    num_envs: number of environments.
    seed: of the episodes and the randomised models; torch has a seed of its own.
    events: domain randomisation, drawn once for each environment (`compose(["env=..."]).env.events`).
    groups: the task's observation group for each RSL-RL group; the default is those of actor and critic.

  Raises:
    ConfigError: a group has images, `groups` maps no names to names, or `num_envs` is below 1.
    UnknownNameError: the task has no such observation group.
  """
  if num_envs < 1:
    raise ConfigError(f"num_envs={num_envs} must be at least 1.")
  batch = AutoReset(wrap_for_evaluation(env), keep_final_obs=True)
  groups = group_entries(env, groups)
  reset_key, model_key = jax.random.split(jax.random.PRNGKey(seed))
  randomizer = Randomizer(env.mj_model, events, impl=env.impl) if events else None
  model = jax.jit(randomizer.sample_batch)(jax.random.split(model_key, num_envs)) if randomizer else {}
  state = jax.jit(batch.reset)(jax.random.split(reset_key, num_envs), model)
  step = jax.jit(batch.step)
  return VecEnv(env, state, lambda state, action: step(state, action, model), groups)


def group_entries(env: Env, groups: Mapping[str, str] | None = None) -> dict[str, str]:
  """Returns the task's observation group for each RSL-RL group; the default is those of the policy and of the critic.

  Raises:
    ConfigError: a group has images, which the adapter does not pass on, or `groups` maps no names to names.
    UnknownNameError: the task has no such observation group.
  """
  entries = observation_groups(env.observation_size)
  default = {"policy": "state", "critic": PRIVILEGED if PRIVILEGED in entries else "state"}
  if groups is not None and not (
    isinstance(groups, Mapping) and groups and all(isinstance(entry, str) for entry in groups.values())
  ):
    raise ConfigError(f"groups={groups!r} must name a group of the task for each of RSL-RL's, such as {default}.")
  for group, entry in (groups or {}).items():
    lookup(entries, entry, f"groups[{group!r}]")
  if any(entry.startswith(PIXELS) for entry in (groups.values() if groups else entries)):
    raise ConfigError("RSL-RL gets no images from here: leave env.vision.enable=false, or name `groups` without them.")
  return dict(groups or default)
