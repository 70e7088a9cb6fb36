"""Dumps the first step that was NaN, infinite or too large, and replays it."""

import json
from pathlib import Path

import jax
import numpy as np

from playground.envs.base import Env, State
from playground.envs.wrappers import MAX_VALUE, MAX_VELOCITY
from playground.errors import CheckpointError
from playground.files import replacing
from playground.learning.rollout import Step
from playground.pytree import PyTree
from playground.settings import Section


def write_dump(folder: Path, step: int, captured: Step | None, config: Section) -> Path | None:
  """Writes the captured step and the run's config as `step_<step>.npz`, which needs no other file to be replayed.

  Args:
    folder: folder of the dump; made if needed.
    step: environment steps of the run when the step was found.
    captured: the captured step; None writes nothing.
    config: the run's resolved config.

  Returns:
    The file, or None if nothing was captured.
  """
  if captured is None:
    return None
  one = jax.tree.map(lambda x: x[0], captured)
  arrays: dict[str, PyTree] = {f"state{name}": leaf for name, leaf in _named(one.state)}
  arrays |= {f"model/{name}": value for name, value in one.model.items()}
  arrays |= {f"after/{name}": value for name, value in one.after.items()}
  folder.mkdir(parents=True, exist_ok=True)
  path = folder / f"step_{step:012d}.npz"
  with replacing(path) as temporary, open(temporary, "wb") as file:
    np.savez_compressed(file, action=one.action, config=json.dumps(config), **arrays)
  return path


class Dump:
  """A dumped step: the last finite state, the action, the randomised model and the resulting state."""

  def __init__(self, path: str | Path):
    """Reads a dump; raises CheckpointError if the file is missing or no dump."""
    try:
      with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
      self.config: Section = json.loads(str(arrays.pop("config")))
      self.action = arrays.pop("action")
      if not isinstance(self.config, dict):
        raise TypeError("its config is no mapping")
    except Exception as error:  # of any type: the file may hold anything
      raise CheckpointError(f"{path} is not a dump of a non-finite step (nan_dump/step_*.npz of a run).") from error
    part = lambda prefix: {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
    self._state, self.model, self.after = part("state"), part("model/"), part("after/")

  def state(self, env: Env) -> State:
    """Returns the last finite state, for the task of the dump.

    Raises:
      CheckpointError: an array is missing, unknown, or not of the shape and kind that the task has.
    """
    template, model = jax.eval_shape(lambda: (env.reset(jax.random.PRNGKey(0)), env.mjx_model))
    fields = {name.removeprefix("."): field for name, field in _named(model)}
    _must_fit("action", self.action, jax.ShapeDtypeStruct((env.action_size,), np.float32))
    for name, value in self.model.items():
      _must_fit(f"model/{name}", value, fields.get(name))
    for name, leaf in _named(template):
      _must_fit(f"state{name}", self._state.get(name), leaf)
    return jax.tree.unflatten(jax.tree.structure(template), [self._state[name] for name, _ in _named(template)])

  def replay(self, env: Env) -> State:
    """Repeats the step on this machine's backend, up to the first repeat of the action that is not finite."""
    state = self.state(env)
    for _ in range(env.action_repeat):
      state = env.jitted[1](state, self.action, self.model, {})
      if nonfinite_results(state):
        break
    return state


def nonfinite_results(state: State) -> list[str]:
  """Returns `nonfinite_fields` of a state's physics, observation, reward and, by name, rewards."""
  rewards = {name: value for name, value in state.metrics.items() if name.startswith("reward/")}
  return nonfinite_fields({"data": state.data, "obs": state.obs, "reward": state.reward, "metrics": rewards})


def nonfinite_fields(tree: PyTree) -> list[str]:
  """Counts values that are NaN, infinite or beyond the guard's limit, by name of the leaf."""
  lines = []
  for name, leaf in _named(tree):
    values, limit = np.asarray(leaf), MAX_VELOCITY if "qvel" in name else MAX_VALUE
    bad = ~(np.abs(values) <= limit) if np.issubdtype(values.dtype, np.floating) else np.zeros(1, bool)
    if bad.any():
      lines.append(f"{name}: {int(bad.sum())} of {values.size}")
  return lines


def _must_fit(name: str, found: np.ndarray | None, expected: np.ndarray | jax.ShapeDtypeStruct | None) -> None:
  """Raises CheckpointError unless an array of a dump has the shape and kind that the task expects."""
  if found is None or expected is None:
    why = f"it has no {name}" if found is None else f"the task has no {name}"
  elif (found.shape, found.dtype.kind) != (expected.shape, expected.dtype.kind):
    described = [f"{array.dtype}{list(array.shape)}" for array in (found, expected)]
    why = f"its {name} is {described[0]}, the task's is {described[1]}"
  else:
    return
  raise CheckpointError(f"The dump does not fit this task: {why}.")


def _named(tree: PyTree) -> list[tuple[str, np.ndarray]]:
  flat, _ = jax.tree_util.tree_flatten_with_path(tree)
  return [(jax.tree_util.keystr(path), leaf) for path, leaf in flat]
