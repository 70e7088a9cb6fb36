"""Plans the start of a run: as a new run, from the run's last intact checkpoint, or from another run's weights."""

import contextlib
import dataclasses
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Self

import jax
import numpy as np

from playground.config import RunConfig, compose
from playground.errors import CheckpointError
from playground.hardware.distributed import is_main
from playground.learning.algorithm import Policy
from playground.learning.checkpoints import (
  Checkpoint,
  DamagedCheckpointError,
  Leaf,
  NoCheckpointError,
  describe,
  find_checkpoints,
  of_a_better_one,
)
from playground.learning.loop import Draw
from playground.learning.trainer import Settings, Trainer, TrainState
from playground.pretrained import PREFIX, check_task, is_pretrained, locate, other_meaning
from playground.pytree import PyTree
from playground.runs.run_dir import RunDirectory
from playground.settings import Plain, Section, nodes
from playground.text import format_value

_ONLY_AT_FIRST = ("value_dtype", "policy_output_scale", "init_std")  # keys of networks that given weights leave open
_OF_NETWORKS = ("normalize_observations", "min_value", "max_value")  # keys beside those of `network` that they do


def weights_of(path: str | Path) -> Checkpoint:
  """Returns the checkpoint that `path` names: a run's newest, one of its checkpoints, or `pretrained:<task>`.

  Raises:
    PlaygroundError: the checkpoint is missing or damaged, or a pretrained policy's task has changed since.
  """
  checkpoint = Checkpoint(find_checkpoints(locate(str(path)))[0])
  folder = checkpoint.path.parents[1]
  if is_pretrained(folder):
    task, saved = checkpoint.meta["env"], checkpoint.meta["config"]
    today = compose([f"env={task}", f"agent={saved['agent']['name']}"])  # an agent's set may change the task
    check_task(task, saved["env"], today.resolved["env"])
  return checkpoint


@dataclasses.dataclass
class RestorePlan:
  """Finds the files of a run before anything expensive starts, and then holds the state restored from them.

  Attributes:
    run_dir: directory of the resumed run, None for a new run.
    checkpoints: checkpoints of the resumed run, newest first.
    weights: checkpoint of the weights of a new run.
    notices: sentences for the user about restored and skipped checkpoints.
    state: the restored training state, on the devices.
    update: training steps at the restored checkpoint.
    step: environment steps at the restored checkpoint.
    wall_clock_s: time of the run up to the checkpoint.
    policy: restored weights (host arrays) for a new run.
    columns: columns of metrics.csv at the restored checkpoint.
    settings: the agent's settings at the restored checkpoint, which population-based training may have changed.
    began_s: age of the process when the run started.
    longer: whether the resumed run gets a larger budget than it was started with.
    error: why nothing can be restored, of a run that trains with others; else None.
  """

  run_dir: RunDirectory | None = None
  checkpoints: list[Path] = dataclasses.field(default_factory=list)
  weights: Checkpoint | None = None
  notices: list[str] = dataclasses.field(default_factory=list)
  state: TrainState | None = None
  update: int | None = None
  step: int | None = None
  wall_clock_s: float = 0.0
  policy: Policy | None = None
  columns: list[str] = dataclasses.field(default_factory=list)
  settings: dict[str, float | list[float]] = dataclasses.field(default_factory=dict)
  began_s: float = 0.0
  longer: bool = False
  error: str | None = None

  @classmethod
  def find(cls, config: RunConfig, began_s: float = 0.0) -> Self:
    """Finds the runs and checkpoints of `resume`, `init_from` and `run_dir`.

    Raises:
      CheckpointError: no usable checkpoint, `run_dir` holds a run already, or a run to train longer has a damaged
        overrides.yaml or manifest.json.
    """
    if config.resume is not None:
      run_dir = RunDirectory.open(config.resume)
      now = config.agent.num_timesteps
      longer = run_dir.config["agent"].get("num_timesteps", now) < now  # a key that is not there has its default
      if longer:
        _ = run_dir.overrides, run_dir.manifest  # damaged ones raise before anything is changed
      plan = cls(run_dir=run_dir, began_s=began_s, longer=longer)
      try:
        plan.checkpoints = find_checkpoints(config.resume)
      except NoCheckpointError:
        if run_dir.status:  # without a status, a chain made the run and starts it now
          plan.notices.append(f"{config.resume} stopped before its first checkpoint: starting from the beginning.")
        plan.start_over(config)
      return plan
    assert config.run_dir is not None, "composing names one"
    if config.resolved["run_dir"] is not None:  # else `create` numbers the name if it is taken
      RunDirectory(config.run_dir).must_be_new()
    if config.init_from is not None:
      weights = weights_of(config.init_from)
      return cls(weights=weights, notices=of_a_better_one(config.init_from, weights))
    return cls()

  def start_over(self, config: RunConfig) -> None:
    """Makes a resumed run start from the beginning, with its initial weights and without its checkpoints.

    Raises:
      CheckpointError: the weights are missing or damaged.
    """
    assert self.run_dir is not None, "only a resumed run can start over"
    # Only a chain sets this in the `config` of a resumed run; the chain may have been moved.
    weights = config.init_from or _first_policy(self.run_dir)
    if weights and not Path(os.path.expanduser(locate(weights))).exists():
      raise CheckpointError(
        f"{self.run_dir.path} cannot start again from {weights}, which is no longer there: "
        f"init_from=<run or checkpoint> starts a new run."
      )
    self.checkpoints, self.weights = [], weights_of(weights) if weights else None

  def to_write(self, config: RunConfig) -> dict[str, Plain]:
    """Returns the configuration that a new run's directory holds: `init_from` names the checkpoint that is used.

    What the user gave may name another one by the time the run is resumed: in another working directory, or when the
    run that it names has trained on. A pretrained policy keeps its name.
    """
    if self.weights is None or str(config.init_from).startswith(PREFIX):
      return config.resolved
    return {**config.resolved, "init_from": str(self.weights.path.resolve())}

  @contextlib.contextmanager
  def locked(self, config: RunConfig) -> Iterator[Self]:
    """Locks the resumed run, if any; yields a plan of the current files, which another process may have changed.

    Raises:
      CheckpointError: another process writes the run.
    """
    if self.run_dir is None:
      yield self
      return
    with self.run_dir.locked() if is_main() else contextlib.nullcontext():
      yield dataclasses.replace(type(self).find(config, self.began_s), run_dir=self.run_dir)

  @property
  def finished(self) -> bool:
    """Whether the resumed run has finished, and is to train no longer."""
    return self.run_dir is not None and self.run_dir.status.get("status") == "finished" and not self.longer

  def settings_over(self, own: Settings) -> dict[str, PyTree]:
    """Returns a run's settings: those of the restored checkpoint if it has any, else the config's."""
    noted = {key: np.asarray(value, np.float32) for key, value in self.settings.items() if key in own}
    return {**own, **noted}

  def restore(self, trainer: Trainer, config: RunConfig, draw: Draw) -> None:
    """Restores the state or weights, checked against the algorithm and its shapes, before compilation.

    Raises:
      CheckpointError: no checkpoint is intact, or the newest intact one is unreadable now or does not fit.
    """
    if not self.checkpoints and self.weights is None:
      return
    if self.weights is not None:
      theirs, name = self.weights.meta["config"].get("agent", {}), config.agent_name
      if theirs.get("name") != name:
        raise CheckpointError(
          f"{self.weights.path} was trained by {theirs.get('name')}: agent={name} cannot start from it."
        )
      _check_networks(self.weights, dataclasses.asdict(trainer.config), "start from it")
      template = trainer.policy_shape()
      there, here = _observations(self.weights.meta["leaves"].get("policy", [])), _observations(describe(template))
      if there and there != here:
        raise CheckpointError(
          f"{self.weights.path} was trained with the observation {there}: a run with {here} cannot start from it."
        )
      self.policy = self.weights.restore("policy", template)
      source = f"{self.weights.path} ({self.weights.meta['env']}, {self.weights.step:,} steps)"
      self.notices.append(f"Starting from the weights and observation statistics of {source}; the optimiser is new.")
      saved, env = self.weights.meta["config"].get("env", {}), config.resolved["env"]
      if changed := other_meaning({**env, **saved}, env):  # an earlier version had fewer keys
        what = "what the policy reads or does means something else now"
        self.notices.append(f"These weights were trained with other values of {', '.join(changed)}: {what}.")
      return
    model, _ = jax.eval_shape(draw)
    template = trainer.template(model)
    for path in self.checkpoints:
      try:
        checkpoint = Checkpoint(path)
        self.state, notice = trainer.restore(checkpoint, template)
      except DamagedCheckpointError as error:
        if path == self.checkpoints[-1]:
          if (path / "policy").is_dir() and not (path / "state").is_dir():
            raise CheckpointError(f"{path} holds a policy alone: init_from={path} starts a new run from it.") from None
          raise
        self.notices.append(
          f"{error} It is moved to checkpoints/damaged_{path.name}. Falling back to the checkpoint before it."
        )
        continue
      check_origin(checkpoint, config)
      self.update, self.step = checkpoint.meta["update"], checkpoint.step
      self.wall_clock_s = checkpoint.meta["wall_clock_s"]
      self.columns = checkpoint.meta.get("columns", [])  # checkpoints of earlier versions have none
      self.settings = checkpoint.meta.get("settings", {})
      self.notices.append(notice)
      return


def networks_of(agent: Section) -> dict[str, str]:
  """Returns the keys of an agent section, with their values, that say what its networks compute with given weights."""
  network = {name: value for name, value in nodes(agent.get("network", {})) if not isinstance(value, Mapping)}
  found = {f"network.{name}": value for name, value in network.items() if name not in _ONLY_AT_FIRST}
  found |= {name: agent[name] for name in _OF_NETWORKS if name in agent}
  return {f"agent.{key}": format_value(value) for key, value in found.items()}


def check_origin(checkpoint: Checkpoint, config: RunConfig) -> None:
  """Raises CheckpointError if a run's configuration has another task or other networks than its checkpoint."""
  task, here = checkpoint.meta["env"], config.choices["env"]
  if task != here:
    raise CheckpointError(f"{checkpoint.path} was trained on {task}, but its run is one of {here}.")
  _check_networks(checkpoint, config.resolved["agent"], "use it")


def _check_networks(checkpoint: Checkpoint, agent: Section, cannot: str) -> None:
  """Raises CheckpointError if the networks of an agent section would compute something else with its weights."""
  there, here = networks_of(checkpoint.meta["config"].get("agent", {})), networks_of(agent)
  for key, value in there.items():
    if value != here.get(key, value):  # an earlier version had fewer keys
      trained = f"{checkpoint.path} was trained with {key}={value}"
      raise CheckpointError(f"{trained}: a run with {key}={here[key]} cannot {cannot}.")


def _observations(policy: list[Leaf]) -> str:
  """Returns the sizes of the observation groups that a policy normalises, such as `state 48, privileged_state 123`."""
  means = ((re.fullmatch(r"\.normalizer\.mean\['(.+)'\]", name), shape) for name, shape, _ in policy)
  return ", ".join(f"{found[1]} {' x '.join(map(str, shape))}" for found, shape in means if found)


def _first_policy(run_dir: RunDirectory) -> str | None:
  """Returns the path of the policy that a run starts from; for a stage of a chain, where the chain is now.

  Raises:
    CheckpointError: the stage before it is not finished.
  """
  path, chain = run_dir.config["init_from"], run_dir.path.parent
  number = lambda stage: int(prefix) if (prefix := stage.partition("_")[0]).isdecimal() else 0
  if path is None or not (chain / "config.yaml").is_file() or not (chain / Path(path).name).is_dir():
    return path
  if number(Path(path).name) >= number(run_dir.path.name):  # a stage of another chain
    return path
  before = RunDirectory(chain / Path(path).name)
  if before.status.get("status") != "finished":
    raise CheckpointError(f"{before.path} is not finished: resume={chain} trains it first.")
  return str(before.path)
