"""A run's policy with its task on C MuJoCo: what is exported, and played."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas
from ml_collections import ConfigDict

from playground import registry
from playground.config import RunConfig
from playground.deploy.contract import describe_policy
from playground.deploy.graph import policy_graph
from playground.deploy.policy import ExportedPolicy
from playground.envs.base import Env, State
from playground.envs.c_physics import on_c_physics
from playground.envs.wrappers import wrap_for_training
from playground.extras import need
from playground.learning.checkpoints import Checkpoint
from playground.learning.learner import Learner, Policy
from playground.runs.run_dir import RunDirectory
from playground.runs.trained import load_trained

_EXACT = "highest"  # precision of matrix products: what the exported policy computes


@dataclasses.dataclass(frozen=True)
class TrainedPolicy:
  """A checkpoint's policy, ready to act.

  Attributes:
    run: the run's configuration.
    run_dir: its folder.
    step: control steps trained.
    env: the task, on C MuJoCo.
    learner: the algorithm.
    policy: networks and normaliser.
  """

  run: RunConfig
  run_dir: RunDirectory
  step: int
  env: Env
  learner: Learner
  policy: Policy

  @classmethod
  def open(cls, path: str | Path) -> "TrainedPolicy":
    """Reads a run's newest checkpoint, or the one given; all of it computes on the CPU.

    Raises:
      PlaygroundError: no such run or checkpoint, or one that does not fit.
    """
    found = load_trained(path, load_task=load_on_c_physics, platform="cpu", precision=_EXACT)
    return cls(found.config, found.run_dir, found.checkpoint.step, found.env, found.learner, found.policy)

  def at(self, path: Path) -> "TrainedPolicy":
    """The policy of another checkpoint of the run; raises CheckpointError if it is gone or damaged."""
    found = Checkpoint(path)
    policy = self.learner.place_policy(found.restore("policy", self.learner.policy_shape()))
    return dataclasses.replace(self, step=found.step, policy=policy)

  def act(self, obs: Any) -> jax.Array:
    """The deterministic action."""
    return self.learner.act(self.policy, obs, jax.random.PRNGKey(0), deterministic=True)

  def record(self, num_envs: int, decisions: int) -> tuple[dict[str, np.ndarray], np.ndarray, State]:
    """Lets the policy act, noise and all.

    Returns:
      What the actor saw, by entry [num_envs * decisions, ...], what it did, [..., action_size], and a state of one
      environment.
    """
    batch, networks = wrap_for_training(self.env), self.learner.networks

    def decide(state: State, _: None) -> tuple[State, tuple[dict[str, jax.Array], jax.Array]]:
      action, seen = self.act(state.obs), networks.select(state.obs)
      return batch.step(state, action), ({entry: seen[entry] for entry in networks.policy_inputs}, action)

    @jax.jit
    def roll(key: jax.Array) -> Any:
      return jax.lax.scan(decide, batch.reset(jax.random.split(key, num_envs)), None, decisions)

    state, (obs, actions) = roll(jax.random.PRNGKey(0))
    obs, actions = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), (obs, actions))
    return obs, actions, jax.tree.map(lambda x: x[0], state)

  def export(self, state: State | None = None) -> ExportedPolicy:
    """The policy as a controller has it; `state` is any of one environment (a fresh one if None)."""
    need("deploy", "onnx", "onnxruntime")
    policy, agent, networks = jax.device_get(self.policy), self.run.agent, self.learner.networks
    params, seen = networks.mlp(policy.params.policy, policy.normalizer if agent.normalize_observations else None)
    inputs = networks.policy_inputs
    model = policy_graph(params, inputs, agent.network.activation, seen, networks.squashed, networks.cnn)
    origin = {
      "run": self.run_dir.path.absolute().name,
      "experiment": self.run.name,
      "agent": agent.name,
      "steps": self.step,
      **(self.run_dir.manifest.get("git") or {}),
      "evaluation": self._newest_evaluation(),
    }
    state = jax.jit(self.env.reset)(jax.random.PRNGKey(0)) if state is None else state
    config: Mapping[str, Any] = self.run.resolved["env"]
    contract = describe_policy(self.env, config, self.run.choices["env"], origin, inputs, state)
    return ExportedPolicy(model.SerializeToString(), contract)

  def _newest_evaluation(self) -> dict[str, float]:
    """`steps` and the scores of the last evaluation in the training run, {} if there was none."""
    if not self.run_dir.metrics_csv.is_file():
      return {}
    table = pandas.read_csv(self.run_dir.metrics_csv)
    evaluated = table[(table.step <= self.step) & table["eval/episode_reward"].notna()]
    if not len(evaluated):
      return {}
    last = evaluated.iloc[-1]
    scores = {name.removeprefix("eval/"): float(last[name]) for name in table if str(name).startswith("eval/episode_")}
    return {"steps": int(last.step)} | scores


def load_on_c_physics(task: str, config: Any) -> Env:
  """Builds a task on C MuJoCo.

  Raises:
    ConfigError: it sees pictures, and MuJoCo-Warp, which renders them, is not installed.
  """
  config = ConfigDict(config)
  renders = "vision" in config and config.vision.enable
  config.impl = "warp" if renders else "jax"  # whose model is the smallest to build; it is not simulated
  return on_c_physics(registry.load(task, config=config))
