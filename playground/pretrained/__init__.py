"""Policies that come with the package: `pretrained:<task>` wherever a run or a checkpoint is named.

Each is a run directory in `policies/<task>/` without what only resuming needs: configuration, evaluations, the newest
checkpoint's policy, and `card.yaml`: how it was trained, what it reaches, and the SHA-256 of every file. `playground
pretrained` lists them, `playground export` writes the ONNX file of one, and `add` makes one from a run.
"""

import hashlib
import json
import re
import shutil
import tempfile
from collections.abc import Container, Mapping
from pathlib import Path

import yaml

from playground.envs.options import MEANING
from playground.errors import CheckpointError, UnknownNameError, nearest
from playground.files import csv_text, locking, numbered, read_csv, write_text
from playground.settings import Plain, Section

PREFIX = "pretrained:"
POLICIES = Path(__file__).parent / "policies"
CARD = "card.yaml"
ACTOR_BITS = 11  # of kernels: what TensorFloat-32, in which GPUs multiply, reads of them
CRITIC_BITS = 3
_COPIES = Path("results/pretrained")
_PATIENCE_S = 60.0  # for the copies of other processes


def cards() -> dict[str, dict[str, Plain]]:
  """The card of each policy, by task."""
  return {path.parent.name: yaml.safe_load(path.read_text()) for path in sorted(POLICIES.glob(f"*/{CARD}"))}


def locate(name: str) -> str:
  """The path that a name stands for: `pretrained:<task>` is a folder of this package, every other name itself.

  Raises:
    UnknownNameError: there is no pretrained policy of that task.
    CheckpointError: a file is missing, or is another than when the policy was added.
  """
  if not name.startswith(PREFIX):
    return name
  task, known = name.removeprefix(PREFIX), [path.parent.name for path in sorted(POLICIES.glob(f"*/{CARD}"))]
  if task not in known:
    raise UnknownNameError(f"{name}: there are pretrained policies of {', '.join(known)}.{nearest(task, known)}")
  folder = POLICIES / task
  if changed := _changed(folder):
    raise CheckpointError(f"{folder / changed[0]} is not the file that was trained: install the package again.")
  return str(folder)


def _changed(folder: Path) -> list[str]:
  """Returns the files of a policy that are not those that its card names, or are missing."""
  files = yaml.safe_load((folder / CARD).read_text())["sha256"]
  return [name for name in files if not (folder / name).is_file() or _sha256(folder / name) != files[name]]


def working_copy(name: str, tasks: Container[str]) -> str:
  """The path that a name stands for, in a folder that results can be written to.

  A pretrained policy is copied to `results/pretrained/<task>` when it is asked for first.

  Args:
    name: a path, `pretrained:<task>`, or the name of a task, which means the same where no such path exists.
    tasks: the names of all tasks.

  Raises:
    PlaygroundError: what `locate` raises, or the folder cannot be written to.
  """
  if name in tasks and not Path(name).exists():
    name = PREFIX + name
  if not name.startswith(PREFIX):
    return name
  source = Path(locate(name))
  copy = _COPIES / source.name
  try:
    if _is_copy(copy, source):
      return str(copy)
    _COPIES.mkdir(parents=True, exist_ok=True)
    with locking(_COPIES / ".lock", _PATIENCE_S):  # else processes that start together move each other's copy away
      if not _is_copy(copy, source):
        with tempfile.TemporaryDirectory(dir=_COPIES) as scratch:
          shutil.copytree(source, Path(scratch) / source.name)
          if copy.exists():  # with the user's results
            old = copy.rename(numbered(copy.with_name(f"{copy.name}_old")))
            print(f"The policy of {source.name}, or your copy, has changed; the old one and its results are in {old}.")
          (Path(scratch) / source.name).rename(copy)
  except OSError as error:
    raise CheckpointError(f"{copy} cannot be written: {error.strerror}.") from error
  return str(copy)


def _is_copy(folder: Path, source: Path) -> bool:
  """Whether a folder is a whole copy of this policy; not while another process replaces it."""
  try:
    return (folder / CARD).read_bytes() == (source / CARD).read_bytes() and not _changed(folder)
  except FileNotFoundError:
    return False


def check_task(task: str, saved: Section, today: Section) -> None:
  """Raises CheckpointError if a pretrained policy's task observes or acts otherwise today.

  Args:
    task: its name.
    saved: the env section that it was trained with.
    today: the task's.
  """
  if changed := other_meaning(saved, today):
    raise CheckpointError(
      f"The pretrained policy of {task} does not fit its task any more: {changed[0]} has changed since it was "
      f"trained; train again with playground-run env={task}."
    )


def other_meaning(saved: Section, today: Section) -> list[str]:
  """Returns the keys of `env`, dotted, in which two env sections give a policy's numbers another meaning."""
  return [f"env.{key}" for key in MEANING if _without_noise(saved.get(key)) != _without_noise(today.get(key))]


def _without_noise(value: object) -> object:
  """A part of an env section as it bears on what a policy's inputs mean."""
  if isinstance(value, Mapping):
    return [(key, _without_noise(entry)) for key, entry in value.items() if key != "noise" and entry is not None]
  return list(value) if isinstance(value, list | tuple) else value


def _sha256(file: Path) -> str:
  return hashlib.sha256(file.read_bytes()).hexdigest()


def is_pretrained(folder: Path) -> bool:
  """Whether a run directory is a pretrained policy, or a copy of one."""
  return (folder / CARD).is_file()


def copy_policy(run: Path, folder: Path) -> None:
  """Copies a run's newest policy with its configuration and metrics, without what only resuming needs."""
  step = max((run / "checkpoints").glob("[0-9]*"), key=lambda path: int(path.name))
  folder.mkdir(parents=True)
  for name in ("config.yaml", "overrides.yaml", "manifest.json", "metrics.csv"):
    shutil.copyfile(run / name, folder / name)
  shutil.copytree(step, folder / "checkpoints" / step.name, ignore=shutil.ignore_patterns("state", "replay"))


def _bits(name: str) -> int | None:
  """Significant bits that a policy keeps of an array; None keeps all, of the actor's biases and of statistics."""
  if name.startswith(".params.policy"):
    return ACTOR_BITS if "kernel" in name else None
  return CRITIC_BITS if name.startswith(".params.") else None  # acting does not read it, fine-tuning does


def _forget_machine(folder: Path) -> None:
  """Removes the paths and the name of the machine from a policy's configuration, manifest and checkpoint."""
  for note in folder.rglob("commit_success.txt"):  # Orbax writes its path; only that the file exists counts
    note.write_text("Checkpoint commit was successful\n")
  config = folder / "config.yaml"
  config.write_text(re.sub(r"^run_dir: .*$", "run_dir: null", config.read_text(), flags=re.MULTILINE))
  overrides = folder / "overrides.yaml"
  kept = [line for line in overrides.read_text().splitlines(keepends=True) if not line.startswith("- run_dir=")]
  overrides.write_text("".join(kept))
  manifest = json.loads((folder / "manifest.json").read_text())
  kept = {key: value for key, value in manifest.items() if key not in ("host", "compilation_cache")}
  (folder / "manifest.json").write_text(json.dumps(kept, indent=2) + "\n")


def _keep_evaluations(metrics: Path) -> None:
  """Removes the rows of a metrics.csv between the evaluations, and the columns that are empty then."""
  rows = [row for row in read_csv(metrics) if row.get("eval/episode_reward")]
  columns = [name for name in rows[0] if any(row[name] for row in rows)]
  write_text(metrics, csv_text(columns, rows, header=True))


def add(run: Path, task: str, entries: Section) -> Path:
  """Copies a run's policy into the package and writes its card.

  The actor's kernels are rounded to `ACTOR_BITS` significant bits, which makes its files half: actions, of -1 to 1,
  change by 0.0001 to 0.0005 on average. The critic is rounded to `CRITIC_BITS`, which makes its files a fifth: values
  of Barkour's change by 7 % of their standard deviation, with random observations.

  Args:
    run: a run directory.
    task: its task.
    entries: entries of the card beside the files' hashes.

  Returns:
    The folder.
  """
  POLICIES.mkdir(parents=True, exist_ok=True)
  with tempfile.TemporaryDirectory(dir=POLICIES) as scratch:  # the old one stays until the new one is whole
    folder = _build(run, Path(scratch) / task, entries)
    shutil.rmtree(POLICIES / task, ignore_errors=True)
    return folder.rename(POLICIES / task)


def _build(run: Path, folder: Path, entries: Section) -> Path:
  from playground.learning.checkpoints import round_policy  # imports JAX, which composing a run must not

  copy_policy(run, folder)
  for checkpoint in (folder / "checkpoints").iterdir():
    round_policy(checkpoint, _bits)
  _forget_machine(folder)
  _keep_evaluations(folder / "metrics.csv")
  files = sorted(path for path in folder.rglob("*") if path.is_file())
  hashes = {str(path.relative_to(folder)): _sha256(path) for path in files}
  (folder / CARD).write_text(yaml.safe_dump({**entries, "sha256": hashes}, sort_keys=False, width=120))
  return folder
