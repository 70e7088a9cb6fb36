"""Downloads policies from Weights & Biases, which a command line names as `wandb:<entity>/<project>/<run>`.

A run with `tracking.wandb.upload=true` uploads its newest policy when it ends: an artifact with configuration, metrics
and checkpoint, but without the arrays that only resuming needs. Only a command line can name an artifact: a saved
configuration holds the path of the download, so a file from another user connects to no machine.
"""

import re
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from playground.errors import CheckpointError, ConfigError
from playground.runs.wandb_tracker import TYPE, logged_in, set_up
from playground.text import first_line

if TYPE_CHECKING:
  import wandb

PREFIX = "wandb:"
_NAME = re.compile(r"[\w.-]+/[\w.-]+/[\w.-]+(:[\w.-]+)?")
_DOWNLOADS = Path("results/wandb")


def local_path(name: str) -> str:
  """Returns the path of a run: artifacts are downloaded to `results/wandb/`, other names are paths already.

  Args:
    name: `wandb:<entity>/<project>/<run>` for the newest policy of a run, by its id or its display name;
      `wandb:<entity>/<project>/<artifact>:<version>`; or a path.

  Raises:
    ConfigError: a malformed name, no login, or no such run or artifact.
    CheckpointError: the artifact is no run directory.
  """
  if not name.startswith(PREFIX):
    return name
  path = name.removeprefix(PREFIX)
  if not _NAME.fullmatch(path):
    raise ConfigError(f"{name} is not of the form wandb:<entity>/<project>/<run> or .../<artifact>:<version>.")
  if not logged_in():
    raise ConfigError(f"{name} needs a W&B login: run `wandb login`, or set WANDB_API_KEY.")
  import wandb

  try:
    set_up()
    api = wandb.Api()
    artifact = api.artifact(path, type=TYPE) if ":" in path else _newest(api, path)
    folder = _DOWNLOADS / path.rpartition("/")[0] / artifact.name.replace(":", "-")
    if not folder.is_dir():
      _download(artifact, folder)
  except (ConfigError, CheckpointError):
    raise
  except OSError as error:
    raise CheckpointError(f"{_DOWNLOADS} cannot be written: {error.strerror or error}.") from error
  except Exception as error:  # wandb raises errors of many kinds
    raise ConfigError(f"{name} cannot be downloaded: {first_line(error)}.") from error
  return str(folder)


def _newest(api: "wandb.Api", path: str) -> "wandb.Artifact":
  """Returns the newest policy that a run logged."""
  import wandb

  project, _, name = path.rpartition("/")
  try:
    run = api.run(path)
  except (ValueError, wandb.errors.CommError):  # no id: its display name
    run = next(iter(api.runs(project, filters={"display_name": name})), None)
  if run is None:
    raise ConfigError(f"{PREFIX}{path}: {project} has no run of that id or name.")
  policies = [artifact for artifact in run.logged_artifacts() if artifact.type == TYPE]
  if not policies:
    raise ConfigError(f"{PREFIX}{path}: the run has no policy; train it with tracking.wandb.upload=true.")
  return policies[-1]


def _download(artifact: "wandb.Artifact", folder: Path) -> None:
  """Downloads a complete artifact or none; wandb compares the files' checksums."""
  folder.parent.mkdir(parents=True, exist_ok=True)
  with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
    part = Path(scratch) / "run"
    artifact.download(root=str(part))
    if not (part / "config.yaml").is_file() or any(path.is_symlink() for path in part.rglob("*")):
      raise CheckpointError(f"{artifact.name} is not a policy that tracking.wandb.upload=true uploaded.")
    part.rename(folder)
