"""Lists the checkpoints that the viewer offers: those of a run, or of all stages of a chain."""

from collections.abc import Callable
from pathlib import Path

from playground.errors import CheckpointError
from playground.learning.checkpoints import BEST, find_checkpoints, find_stages
from playground.pretrained import other_meaning
from playground.runs.loaded_policy import LoadedPolicy

# Keys of a run's config that, with `other_meaning`, define the meaning of an actor's inputs and outputs; its arrays
# define their sizes.
_MEANING = {"env": ("task", "robot", "vision"), "agent": ("name", "network", "normalize_observations")}


class Menu:
  """Lists the checkpoints on disk, while training adds and removes them.

  A stage of a chain whose policies do not fit the task of the newest stage is left out, and reported once.

  Attributes:
    trained: the checkpoint that was loaded first.
  """

  def __init__(self, folder: Path, trained: LoadedPolicy, say: Callable[[str], object]):
    """Takes the absolute folder of a run or chain, a checkpoint of its last stage, and a function to notify."""
    self.trained = trained
    self._folder, self._say = folder, say
    self._fits = {trained.run_dir.path: True}

  def checkpoints(self, acting: Path | None = None) -> list[Path]:
    """Returns all checkpoints, newest last, and the current one, even if it was removed."""
    here = lambda stage: {acting} if acting is not None and acting.parents[1] == stage else set()
    return [path for stage in self._stages() for path in sorted({*find_checkpoints(stage), *here(stage)})]

  def best(self) -> Path | None:
    """Returns the checkpoint with the highest return of the last stage; None without a return."""
    try:
      return find_checkpoints(self._stages()[-1] / "checkpoints" / BEST)[0]
    except CheckpointError:
      return None

  def label(self, path: Path) -> str:
    """Returns the label of a checkpoint: its environment steps, in a chain after the stage's name."""
    stage = path.parents[1]
    name = "" if stage == self._folder else f"{stage.name.partition('_')[2]} "
    return f"{name}{int(path.name):,}"

  def _stages(self) -> list[Path]:
    """Returns the run, or the chain's stages in order."""
    if self._folder == self.trained.run_dir.path:
      return [self._folder]
    stages = find_stages(self._folder)
    for stage in stages:
      if stage not in self._fits:
        self._fits[stage] = not (reason := self._misfit(stage))
        if reason:
          self._say(f"Stage {stage.name} is left out: {reason}")
    return [stage for stage in stages if self._fits[stage]]

  def _misfit(self, stage: Path) -> str:
    """Returns why a stage's policies do not fit the task, "" if they fit."""
    try:
      theirs = self.trained.at(find_checkpoints(stage)[0]).run_dir.config
    except CheckpointError as error:
      return str(error)
    ours = self.trained.run_dir.config
    keys = [(section, key) for section, keys in _MEANING.items() for key in keys]
    other = [f"{section}.{key}" for section, key in keys if theirs[section].get(key) != ours[section].get(key)]
    other += other_meaning(theirs["env"], ours["env"])
    return f"{other[0]} is not that of {self.trained.run_dir.path.name}." if other else ""
