"""Logs to Weights & Biases, online if the user is logged in and offline otherwise; its failures never stop a run."""

import contextlib
import netrc
import os
import secrets
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from playground.files import write_text
from playground.pretrained import copy_policy
from playground.settings import Section
from playground.text import first_line

if TYPE_CHECKING:
  import wandb

TYPE = "policy"  # of artifacts
# wandb 0.31 renamed its public server, and still takes a netrc entry under the old name.
_PUBLIC_HOSTS = {"api.wandb.ai", "api.forge.coreweave.com"}


def logged_in() -> bool:
  """Returns whether W&B would find credentials (environment or netrc) without asking for them."""
  if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
    return True
  import wandb

  hosts = {urlsplit(os.environ.get("WANDB_BASE_URL") or wandb.Settings().base_url).netloc}
  if hosts & _PUBLIC_HOSTS:
    hosts.add("api.wandb.ai")
  for path in (os.environ.get("NETRC") or "~/.netrc", "~/_netrc"):
    with contextlib.suppress(OSError, netrc.NetrcParseError):
      entries = netrc.netrc(os.path.expanduser(path))
      if any(entries.authenticators(host) for host in hosts):
        return True
  return False


def resolve_mode(mode: str) -> str:
  """Returns the mode in which W&B starts: `auto` is $WANDB_MODE or online; online without a login is offline."""
  if mode == "auto":
    mode = os.environ.get("WANDB_MODE") or "online"
  # Online without a key would stop and ask for one.
  return "offline" if mode == "online" and not logged_in() else mode


def set_up() -> None:
  """Starts W&B without the settings of the current folder, which may be a stranger's.

  They name the machine that gets the user's key, and with `save_code` W&B runs git there, which runs what that folder
  names. The user's own settings, and the environment variables, hold.
  """
  import wandb

  with contextlib.chdir(os.sep):
    wandb.setup()


class WandbTracker:
  """Logs a run directory to one W&B run, the same one after every resume (the file `wandb_run_id` holds its id).

  A resumed run logs the same numbers for its repeated steps, and W&B ignores steps that it already has.

  Args:
    options: `tracking.wandb` (project, entity, group, name, tags, mode).
    folder: the run directory.
    config: the whole resolved config.
    notify: takes one sentence when W&B fails; the run then continues without it.
  """

  def __init__(self, options: Section, folder: Path, config: Section, notify: Callable[[str], None] = print):
    self._notify = notify
    self._folder = folder
    self._upload = options["upload"]
    self._run: wandb.Run | None = None
    self._guard(lambda: self._start(options, folder, config))

  def log(self, step: int, metrics: dict[str, float]) -> None:
    if (run := self._run) is not None:
      self._guard(lambda: run.log(metrics, step=step))

  def close(self, status: str) -> None:
    if (run := self._run) is not None:
      if self._upload and status == "finished":
        self._guard(lambda: self._log_files(run))
      self._guard(lambda: run.finish(exit_code=0 if status == "finished" else 1))
      self._run = None

  def _start(self, options: Section, folder: Path, config: Section) -> None:
    import wandb

    id_file = folder / "wandb_run_id"
    if not id_file.is_file():
      write_text(id_file, secrets.token_hex(4))
    start = {key: options[key] for key in ("project", "entity", "group", "tags")} | {
      "name": options["name"] or folder.resolve().name,
      "id": id_file.read_text().strip(),
      "config": dict(config),
      "dir": str(folder.resolve()),
      # The progress bar is ours; W&B neither prints nor wraps the terminal.
      "settings": wandb.Settings(silent=True, console="off", init_timeout=30),
    }
    mode = resolve_mode(options["mode"])
    set_up()
    try:
      # Offline, the id alone decides, and `resume` would only warn.
      self._run = wandb.init(**start, mode=mode, resume="allow" if mode == "online" else None)  # pyright: ignore[reportArgumentType]
    except Exception as error:
      if mode != "online":
        raise
      self._notify(f"W&B cannot be reached ({first_line(error)}): this run is recorded offline.")
      wandb.teardown()  # its service still holds the id
      set_up()
      self._run = wandb.init(**start, mode="offline")
    if recorded := sorted(folder.glob("wandb/offline-run-*")):  # the names begin with the time
      self._notify(f"W&B records this run offline; to upload it: wandb sync {recorded[-1]}")

  def _log_files(self, run: "wandb.Run") -> None:
    import wandb

    for video in sorted(self._folder.glob("videos/*.mp4"))[-1:]:
      run.log({"video": wandb.Video(str(video), format="mp4")})
    for plot in sorted(self._folder.glob("plots/*.png")):
      run.log({f"plots/{plot.stem}": wandb.Image(str(plot))})
    _upload(run, self._folder)

  def _guard(self, call: Callable[[], object]) -> None:
    try:
      call()
    except Exception as error:  # training continues whatever a third-party service raises
      self._run = None
      self._notify(f"W&B tracking is off for the rest of this run ({first_line(error)}); metrics.csv goes on.")


def _upload(run: "wandb.Run", folder: Path) -> None:
  """Logs the newest policy of a run directory as an artifact of its W&B run."""
  import wandb

  artifact = wandb.Artifact(f"policy-{run.id}", type=TYPE)
  with tempfile.TemporaryDirectory(prefix="playground-") as scratch:
    copy_policy(folder, Path(scratch) / "run")
    artifact.add_dir(str(Path(scratch) / "run"))  # copies the files
  run.log_artifact(artifact)
