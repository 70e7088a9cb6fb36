"""Loads a run's policy with its task on C MuJoCo, to export or play it."""

import functools
import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import mujoco
import numpy as np
from ml_collections import ConfigDict

from playground import registry
from playground.config import TaskConfig, config_dict
from playground.deploy.contract import describe_policy
from playground.deploy.graph import policy_graph
from playground.deploy.policy import ExportedPolicy
from playground.envs.base import Env, State
from playground.envs.c_physics import on_c_physics
from playground.envs.options import uses_vision
from playground.envs.wrappers import wrap_for_training
from playground.errors import ConfigError
from playground.extras import need
from playground.randomization import Randomizer
from playground.runs.csv_tracker import OTHER_RETURNS, newest_evaluation
from playground.runs.loaded_policy import LoadedPolicy, load_policy
from playground.settings import Section

_EXACT = "highest"  # precision of matrix products, as in the exported policy


def load_exact(
  path: str | Path, overrides: Sequence[str] = (), interval_events: bool = True, model_seed: int | None = None
) -> LoadedPolicy:
  """Reads a run's newest checkpoint, or the one at `path`, with its task on C MuJoCo, on the CPU.

  Args:
    path: a run directory, one of its checkpoints, or `pretrained:<task>`.
    overrides: of the task.
    interval_events: whether pushes and other interval events act.
    model_seed: of the model, see `load_on_c_physics`.

  Raises:
    PlaygroundError: no such run or checkpoint, one that does not fit, or an invalid override.
  """
  load_task = functools.partial(load_on_c_physics, interval_events=interval_events, model_seed=model_seed)
  return load_policy(path, overrides, load_task=load_task, platform="cpu", precision=_EXACT)


def record(trained: LoadedPolicy, num_envs: int, steps: int) -> tuple[dict[str, np.ndarray], np.ndarray, State]:
  """Rolls out the policy's mode with the task's noise, and records inputs and actions.

  Args:
    trained: the policy and its task.
    num_envs: number of environments.
    steps: policy steps in each environment.

  Returns:
    The actor's inputs by group, [N, ...], and its actions, [N, action_size], of all N policy steps, and the last state
    of one environment.
  """
  batch, networks = wrap_for_training(trained.env), trained.trainer.networks

  def act_and_step(state: State, _: None) -> tuple[State, tuple[dict[str, jax.Array], jax.Array]]:
    action, seen = trained.act(state.obs, jax.random.PRNGKey(0), deterministic=True), networks.select(state.obs)
    return batch.step(state, action), ({entry: seen[entry] for entry in networks.policy_inputs}, action)

  @jax.jit
  def roll(key: jax.Array) -> tuple[State, tuple[dict[str, jax.Array], jax.Array]]:
    return jax.lax.scan(act_and_step, batch.reset(jax.random.split(key, num_envs)), None, steps)

  state, (obs, actions) = roll(jax.random.PRNGKey(0))
  obs, actions = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), (obs, actions))
  return obs, actions, jax.tree.map(lambda x: x[0], state)


def export_policy(trained: LoadedPolicy, state: State | None = None) -> ExportedPolicy:
  """Exports the policy in memory; `state` is any state of one environment (None takes one after a reset)."""
  need("deploy", "onnx", "onnxruntime")
  policy, agent, networks = jax.device_get(trained.policy), trained.config.agent, trained.trainer.networks
  params, seen = networks.mlp(policy.params.policy, policy.normalizer if agent.normalize_observations else None)
  inputs = networks.policy_inputs
  model = policy_graph(params, inputs, networks.activation_name, seen, networks.cnn, networks.obs_limit)
  content = model.SerializeToString()
  origin = {
    "run": trained.run_dir.path.absolute().name,
    "experiment": trained.config.name,
    "agent": trained.config.agent_name,
    "steps": trained.checkpoint.step,
    **(trained.run_dir.manifest.get("git") or {}),
    "impl": trained.run_dir.manifest.get("impl"),
    "evaluation": _newest_evaluation(trained),
  }
  state = jax.jit(trained.env.reset)(jax.random.PRNGKey(0)) if state is None else state
  config = trained.config.resolved["env"]
  contract = describe_policy(trained.env, config, trained.task, origin, inputs, state)
  contract["policy"]["sha256"] = hashlib.sha256(content).hexdigest()
  return ExportedPolicy(content, contract)


def _newest_evaluation(trained: LoadedPolicy) -> dict[str, float]:
  """Returns `steps` and the finite scores of the last evaluation in training, {} without one.

  Where it has both kinds of actions, the names of the other kind's scores begin with its name, `mode/` or `sampled/`.
  """
  last = newest_evaluation(trained.run_dir.metrics_csv, trained.checkpoint.step)
  if last is None:
    return {}
  kinds = tuple(f"eval/{kind}episode_" for kind in ("", *(f"{name}/" for name in OTHER_RETURNS)))
  scores = {name.removeprefix("eval/"): float(last[name]) for name in last if name.startswith(kinds)}
  return {"steps": int(last["step"])} | {name: score for name, score in scores.items() if math.isfinite(score)}


def switch_off_interval_events(config: TaskConfig) -> None:
  """Switches off pushes and other interval events in a section `env`."""
  for event in config["events"].values():
    if event is not None and event.get("mode") == "interval":
      event.enabled = False


def load_on_c_physics(
  task: str, config: Section | ConfigDict, *, interval_events: bool = True, model_seed: int | None = None
) -> Env:
  """Builds a task on C MuJoCo.

  Args:
    task: its name.
    config: its section `env`.
    interval_events: whether pushes and other interval events act.
    model_seed: of the model that the startup events draw; None is the nominal model.

  Raises:
    ConfigError: the task has images, and MuJoCo-Warp, which renders them, is not installed, or `model_seed` is given
      and it has no startup events.
  """
  own = config_dict(config)
  if not interval_events:
    switch_off_interval_events(own)
  if own.impl != "warp" and not uses_vision(own):  # JAX may not implement what a task on Warp has
    own.impl = "jax"  # the smallest model to build; it is not simulated
  env = registry.load(task, config=own)
  if model_seed is not None:
    fields = _startup(env, task).sample(jax.random.PRNGKey(model_seed))
    set_fields(env.mj_model, fields)
    env.physics.model = env.mjx_model.replace(**fields)
  return on_c_physics(env)


def draw_models(env: Env, task: str, number: int, seed: int) -> dict[str, jax.Array]:
  """Returns the fields of models that the startup events of a task draw, as in training: by name, [number, ...].

  Raises:
    ConfigError: it has none.
  """
  return _startup(env, task).sample_batch(jax.random.split(jax.random.PRNGKey(seed), number))


def set_fields(mj_model: mujoco.MjModel, fields: Mapping[str, jax.Array]) -> None:
  """Changes fields of a model in place."""
  for name, value in fields.items():
    getattr(mj_model, name)[:] = np.reshape(value, np.shape(getattr(mj_model, name)))


def _startup(env: Env, task: str) -> Randomizer:
  randomizer = Randomizer(env.mj_model, env.config.get("events"), impl=env.impl, in_c=True)
  if not randomizer.fields:
    raise ConfigError(f"--randomize: {task} has no events of mode startup here, which draw the model.")
  return randomizer
