"""A run's directory as training leaves it, of a policy that nobody trained; and a port to show it at."""

import socket
from pathlib import Path

import jax
import numpy as np

from playground.config import compose
from playground.envs.c_physics import on_c_physics
from playground.hardware.mesh import make_mesh
from playground.learning.algorithm import Policy
from playground.learning.checkpoints import CheckpointStore
from playground.learning.trainer import Trainer
from playground.registry import load
from tests.runs.helpers import make_run


class UntrainedRun:
  """A run to play."""

  def __init__(self, path: Path, task: str, *overrides: str, scale: float = 1.0):
    """Makes it, without a checkpoint; `scale` multiplies the policy's weights, which are in [0.1, 0.5]."""
    config = compose([f"env={task}", "hardware=cpu", f"run_dir={path}", *overrides])
    self.directory = make_run(path, config.resolved)
    self._task = task
    trainer = Trainer(on_c_physics(load(task, config=config.env)), config.agent, make_mesh(1))
    rng = np.random.default_rng(0)
    weights = jax.tree.map(lambda x: rng.uniform(0.1, 0.5, x.shape).astype(x.dtype), trainer.policy_shape())
    self._policy = Policy(jax.tree.map(lambda x: x * np.float32(scale), weights.params), weights.normalizer)

  def save(self, *steps: int, episode_return: float | None = None) -> None:
    """Writes checkpoints."""
    store = CheckpointStore(self.directory.checkpoints)
    meta = {"update": 0, "wall_clock_s": 0.0, "env": self._task, "config": {}}
    for step in steps:
      store.save(step, self._policy, {"rest": np.zeros(1)}, meta, episode_return=episode_return)
    store.close()


def free_port() -> int:
  """A port that nobody listens on."""
  with socket.create_server(("127.0.0.1", 0)) as server:
    return server.getsockname()[1]
