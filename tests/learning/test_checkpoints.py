"""Checkpoints: what is stored comes back bit for bit, and what is not whole, not ours or does not fit is refused."""

import contextlib
import errno
import json
import math
import os
import resource
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from playground.errors import CheckpointError
from playground.learning import checkpoints
from playground.learning.checkpoints import (
  Checkpoint,
  CheckpointStore,
  DamagedCheckpointError,
  NoCheckpointError,
  find_checkpoints,
)

POLICY = {"w": jnp.linspace(-1, 1, 3000).reshape(50, 60), "count": jnp.asarray(7, jnp.int32)}
STATE = {
  "scalar": jnp.asarray(-0.0),
  "odd": jnp.asarray([1e-45, 0.1, 3e38], jnp.float32),
  "half": jnp.asarray([1.5, -2], jnp.bfloat16),
  "found": jnp.asarray([True, False]),
  "flag": jnp.asarray(True),
  "nothing": jnp.zeros((0, 3)),
  "key": jax.random.PRNGKey(2**31),
  "steps": np.asarray([2**31 - 1, -1], np.int32),
  "noise": jax.random.normal(jax.random.PRNGKey(0), (4000,)),
}


def meta(update: int = 0) -> dict[str, Any]:
  """What a run notes beside the arrays."""
  return {"update": update, "wall_clock_s": 1.0, "env": "Point", "config": {"agent": {"name": "ppo"}}}


def save(
  folder: Path, *steps: int, keep: int = 3, returns: dict[int, float] | None = None, **kwargs: Any
) -> list[Path]:
  """Saves the trees at these steps, and those with a return, into folder/checkpoints; what lies there, newest first."""
  store = CheckpointStore(folder / "checkpoints", keep, **kwargs)
  returns = returns or {}
  for step in sorted({*steps, *returns}):
    store.save(step, POLICY, STATE, meta(step // 10), episode_return=returns.get(step))
  store.close()
  return find_checkpoints(folder)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
  (path,) = save(tmp_path_factory.mktemp("original"), returns={10: 1.0})
  return path


def numbers(paths: list[Path]) -> list[int]:
  return [int(path.name) for path in paths]


def like(tree: Any) -> Any:
  return jax.eval_shape(lambda: jax.tree.map(jnp.asarray, tree))


def data_file(checkpoint: Path, item: str = "state") -> Path:
  """The file that holds most of an item's numbers."""
  return max((p for p in (checkpoint / item).rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)


def one_sentence(error: pytest.ExceptionInfo[CheckpointError], *words: str) -> None:
  text = str(error.value)
  assert "\n" not in text
  assert text.endswith(".")
  for word in words:
    assert word in text


def test_what_is_stored_comes_back_bit_for_bit(tmp_path: Path) -> None:
  (path,) = save(tmp_path, 120)
  checkpoint = Checkpoint(path)
  assert (checkpoint.step, checkpoint.meta["update"]) == (120, 12)
  for item, tree in {"policy": POLICY, "state": STATE}.items():
    restored = checkpoint.restore(item, like(tree))
    assert jax.tree.structure(restored) == jax.tree.structure(tree)
    for name, leaf in tree.items():
      got = restored[name]
      assert (got.shape, got.dtype) == (leaf.shape, leaf.dtype), name
      assert got.tobytes() == np.asarray(leaf).tobytes(), name


def test_rounded_arrays_take_less_space_and_come_back_bit_for_bit(tmp_path: Path) -> None:
  (path,) = save(tmp_path, 10)
  size = lambda: sum(file.stat().st_size for file in (path / "policy").rglob("*") if file.is_file())
  checkpoints.round_policy(path, lambda name: 4 if "w" in name else None)
  count, rounded = Checkpoint(path).arrays("policy")
  np.testing.assert_allclose(rounded, POLICY["w"], rtol=2**-4)
  assert count == 7 and len(np.unique(rounded)) < 0.05 * rounded.size
  compressed = size()
  with ocp.StandardCheckpointer() as orbax:
    orbax.save(path / "policy", {"00000": count, "00001": rounded}, force=True)
  assert compressed < 0.8 * size()
  checkpoints.compress(path / "policy")
  assert size() < 1.02 * compressed
  np.testing.assert_array_equal(Checkpoint(path).arrays("policy")[1], rounded)


@pytest.mark.parametrize(
  ("returns", "said"),
  [
    ({10: 999.0, 20: 485.1}, "The newest checkpoint returned 485.1 in training, {best} 999: name that one to take it."),
    ({10: -4.0, 20: -8.0}, "The newest checkpoint returned -8 in training, {best} -4: name that one to take it."),
    ({10: 999.0, 20: 940.0}, ""),
    ({10: 3.0, 20: 999.0}, ""),
    ({10: 999.0, 20: math.nan}, ""),
  ],
)
def test_that_an_earlier_one_is_better_is_said(returns: dict[int, float], said: str, tmp_path: Path) -> None:
  newest, best = save(tmp_path, returns=returns)[0], tmp_path / "checkpoints" / "best"
  for named in (tmp_path, tmp_path / "checkpoints"):
    assert "".join(checkpoints.of_a_better_one(named, Checkpoint(newest))) == said.format(best=best)
  for named in (newest, best):
    assert not checkpoints.of_a_better_one(named, Checkpoint(newest))
  older = Checkpoint(newest)
  del older.meta["return"]  # an earlier version noted none
  assert not checkpoints.of_a_better_one(tmp_path, older)
  best.unlink()
  assert not checkpoints.of_a_better_one(tmp_path, Checkpoint(newest))


def test_the_newest_are_kept(tmp_path: Path) -> None:
  assert [p.name for p in save(tmp_path, 10, 20, 30, 40, keep=2)] == ["000000000040", "000000000030"]
  # A run that goes on counts those that are there.
  assert [p.name for p in save(tmp_path, 50, keep=2)] == ["000000000050", "000000000040"]


def test_a_run_that_fell_back_keeps_the_damaged_ones_aside_and_makes_them_again(tmp_path: Path) -> None:
  newest, _ = save(tmp_path, 10, 20)
  os.truncate(data_file(newest), 10)
  before = {path.relative_to(newest): path.read_bytes() for path in newest.rglob("*") if path.is_file()}
  for aside in ("damaged_000000000020", "damaged_000000000020_2"):
    paths = save(tmp_path, 20, continued=10)
    assert [p.name for p in paths] == ["000000000020", "000000000010"]
    Checkpoint(paths[0]).restore("state", like(STATE))
    assert (newest.parent / aside).is_dir()
  aside = newest.with_name("damaged_000000000020")
  assert {path.relative_to(aside): path.read_bytes() for path in aside.rglob("*") if path.is_file()} == before


# The best


def test_the_best_is_kept_besides_the_newest(tmp_path: Path) -> None:
  best = tmp_path / "checkpoints" / "best"
  assert numbers(save(tmp_path, 50, keep=1, returns={10: -3.0, 20: -1.0, 30: math.nan, 40: -2.0})) == [50, 20]
  assert os.readlink(best) == "000000000020", "relative: it goes where the run goes"
  assert find_checkpoints(best) == find_checkpoints(str(best)) == [tmp_path / "checkpoints" / "000000000020"]
  assert Checkpoint(find_checkpoints(best)[0]).meta["return"] == -1.0
  # A run that goes on knows it from what lies there, a half-made link from a SIGKILL included.
  best.with_name(".best").symlink_to("000000000050")
  assert numbers(save(tmp_path, keep=1, returns={60: -1.5, 70: math.inf})) == [70, 20]
  assert numbers(find_checkpoints(best)) == [20]
  assert numbers(save(tmp_path, 90, keep=1, returns={80: -1.0})) == [90, 80], "of equals the newest"
  assert numbers(find_checkpoints(best)) == [80]
  assert numbers(save(tmp_path, keep=2, returns={100: 0.0})) == [100, 90]
  assert sorted(os.listdir(best.parent)) == ["000000000090", "000000000100", "best"]


@pytest.mark.parametrize("item", ["policy", "state"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_is_never_the_best_and_refused_with_its_name(
  tmp_path: Path, item: str, value: float
) -> None:
  broken = {"half": jnp.asarray([1.5, value], jnp.bfloat16)}
  trees = {"policy": POLICY, "state": STATE} | {item: {"policy": POLICY, "state": STATE}[item] | broken}
  store = CheckpointStore(tmp_path / "checkpoints")
  store.save(10, POLICY, STATE, meta(), episode_return=1.0)
  store.save(20, trees["policy"], trees["state"], meta(), episode_return=2.0)
  store.close()
  assert numbers(find_checkpoints(tmp_path / "checkpoints/best")) == [10]
  newest = Checkpoint(find_checkpoints(tmp_path)[0])
  with pytest.raises(CheckpointError) as error:
    newest.restore(item, like(trees[item]))
  one_sentence(error, f"{newest.path} cannot be used: its {item}['half'] holds NaN or infinite values")


def test_environments_may_hold_numbers_that_are_not_finite(tmp_path: Path) -> None:
  class Training(NamedTuple):
    env_state: Any

  state = Training({"nonfinite_state": jnp.asarray([jnp.nan, jnp.inf])})
  store = CheckpointStore(tmp_path / "checkpoints")
  store.save(10, POLICY, state, meta(), episode_return=1.0)
  store.close()
  (best,) = find_checkpoints(tmp_path / "checkpoints/best")
  restored = Checkpoint(best).restore("state", like(state))
  np.testing.assert_array_equal(restored.env_state["nonfinite_state"], [np.nan, np.inf])


def test_without_a_return_there_is_no_best(tmp_path: Path) -> None:
  best = tmp_path / "checkpoints" / "best"
  assert numbers(save(tmp_path, 10, returns={20: math.nan})) == [20, 10]
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(best)
  one_sentence(error, f"{best} is no link", "has not saved one with a return")
  best.symlink_to("000000000030")
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(best)
  one_sentence(error, f"{best} points to 000000000030, which is not there")
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(tmp_path / "nowhere/checkpoints/best")
  one_sentence(error, "nowhere/checkpoints/best does not exist")
  save(tmp_path)
  assert not best.is_symlink(), "a run that goes on removes it"


def test_the_best_is_always_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  """Before anything is removed, the link has gone over to what stays."""
  best, seen = tmp_path / "checkpoints" / "best", []

  def removing(remove: Callable[..., Any]) -> Callable[..., Any]:
    def watched(*args: Any, **kwargs: Any) -> Any:
      (path,) = find_checkpoints(best)
      Checkpoint(path).restore("state", like(STATE))
      seen.append(int(path.name))
      return remove(*args, **kwargs)

    return watched

  monkeypatch.setattr(ocp.CheckpointManager, "delete", removing(ocp.CheckpointManager.delete))
  monkeypatch.setattr(Path, "rename", removing(Path.rename))
  assert numbers(save(tmp_path, keep=1, returns={10: 2.0, 20: 1.0, 30: 3.0, 40: 4.0})) == [40]
  assert seen == [30, 30, 40]
  assert numbers(save(tmp_path, keep=2, returns={50: 5.0}, continued=40)) == [50, 40]
  seen.clear()
  assert numbers(save(tmp_path, continued=40)) == [40]
  assert (seen, numbers(find_checkpoints(best))) == ([40], [40])


def test_a_run_whose_best_is_damaged_makes_it_again(tmp_path: Path) -> None:
  best = tmp_path / "checkpoints" / "best"
  newest, _ = save(tmp_path, keep=2, returns={10: 1.0, 20: 2.0})
  (newest / "meta" / "metadata").write_text("{")
  assert numbers(save(tmp_path, keep=2, continued=10)) == numbers(find_checkpoints(best)) == [10]
  save(tmp_path, keep=2, returns={20: 2.0})
  assert numbers(find_checkpoints(best)) == [20]
  store = CheckpointStore(tmp_path / "checkpoints", continued=-1)
  store.close()
  aside = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
  assert aside == ["damaged_000000000010", "damaged_000000000020", "damaged_000000000020_2"], "from the beginning"


def test_a_copy_without_links_loses_only_the_best(tmp_path: Path) -> None:
  paths = save(tmp_path / "run", keep=1, returns={10: 2.0, 20: 1.0})
  kept = shutil.copytree(tmp_path / "run", tmp_path / "kept", symlinks=True)
  assert numbers(find_checkpoints(kept / "checkpoints/best")) == [10]
  copy = shutil.copytree(tmp_path / "run", tmp_path / "copy")  # which follows them
  best = copy / "checkpoints" / "best"
  assert best.is_dir() and not best.is_symlink()
  assert numbers(find_checkpoints(copy)) == numbers(paths) == [20, 10]
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(best)
  one_sentence(error, f"{best} is no link", "copied without its links")
  assert numbers(save(copy, 30, keep=1)) == [30, 10]
  assert numbers(find_checkpoints(best)) == [10], "until the run goes on"


@pytest.mark.parametrize(("number", "works"), [(errno.EPERM, True), (errno.ENOSPC, False)])
def test_where_there_are_no_links(number: int, works: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(Path, "symlink_to", lambda *_: (_ for _ in ()).throw(OSError(number, os.strerror(number))))
  if not works:
    with pytest.raises(OSError, match="No space left"):
      save(tmp_path, returns={10: 1.0})
    return
  assert numbers(save(tmp_path, keep=1, returns={10: 2.0, 20: 1.0})) == [20, 10]
  assert numbers(save(tmp_path, 30, keep=1)) == [30, 10]
  assert not (tmp_path / "checkpoints" / "best").exists()


# What is refused


def test_what_cannot_be_written_is_raised(tmp_path: Path) -> None:
  store = CheckpointStore(tmp_path / "checkpoints")
  store.save(10, POLICY, STATE, {"bad": object()})
  with pytest.raises(TypeError):
    store.close()
  opened = {os.path.realpath(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd")}
  assert str(tmp_path / "checkpoints") not in opened
  assert not any(thread.name.startswith("checkpoint") for thread in threading.enumerate())


def test_a_save_that_failed_is_raised_before_the_next_one(tmp_path: Path) -> None:
  store = CheckpointStore(tmp_path / "checkpoints")
  store.check()
  store.save(10, POLICY, STATE, {"bad": object()})
  with pytest.raises(TypeError):
    for _ in range(1000):
      store.check()
      time.sleep(0.01)
  store.check()
  store.close()


def test_a_disk_that_is_full_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  save(tmp_path, 10)

  def half(self: Any, step: int, **kwargs: Any) -> None:
    (tmp_path / "checkpoints" / f"{step:012d}.orbax-checkpoint-tmp").mkdir()
    raise ValueError("UNKNOWN: Error writing [os_error_code='28']")  # as TensorStore does

  monkeypatch.setattr(ocp.CheckpointManager, "save", half)
  with pytest.raises(CheckpointError) as error:
    save(tmp_path, 20)
  said = f"{tmp_path / 'checkpoints'} cannot be written: No space left on device. resume={tmp_path} goes on from"
  one_sentence(error, said)
  assert numbers(find_checkpoints(tmp_path)) == [10]
  assert sorted(os.listdir(tmp_path / "checkpoints")) == ["000000000010"], "the space of the half is free again"


def test_a_folder_that_was_removed_is_not_made_again(tmp_path: Path) -> None:
  store = CheckpointStore(tmp_path / "run/checkpoints")
  shutil.rmtree(tmp_path / "run")
  store.save(10, POLICY, STATE, meta())
  with pytest.raises(CheckpointError, match="checkpoints cannot be written: it was removed"):
    store.close()
  assert not (tmp_path / "run").exists()


def test_a_foreign_folder_is_refused(tmp_path: Path) -> None:
  foreign = tmp_path / "checkpoints" / "000000000010"
  (foreign / "default").mkdir(parents=True)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(foreign)
  one_sentence(error, str(foreign), "not a checkpoint of playground-run")

  (path,) = save(tmp_path / "other", 10)
  file = path / "meta" / "metadata"
  file.write_text(json.dumps(json.loads(file.read_text()) | {"format": "brax/1"}))
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path)
  one_sentence(error, str(path), "playground-run/1")

  with pytest.raises(CheckpointError) as error:
    Checkpoint(tmp_path / "checkpoints" / "000000000099")
  one_sentence(error, "000000000099", "no such folder")


def test_too_many_open_files_is_not_damage(original: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  monkeypatch.setattr(checkpoints, "_RETRY_AFTER_S", (0.0,))
  limits = resource.getrlimit(resource.RLIMIT_NOFILE)
  highest = max(map(int, os.listdir("/proc/self/fd")))
  held = [os.open("/", os.O_RDONLY) for _ in range(highest)]  # no number is free below the limit
  resource.setrlimit(resource.RLIMIT_NOFILE, (max(held) + 1, limits[1]))
  try:
    with pytest.raises(CheckpointError) as error:
      Checkpoint(original)
  finally:
    resource.setrlimit(resource.RLIMIT_NOFILE, limits)
    for handle in held:
      os.close(handle)
  assert not isinstance(error.value, DamagedCheckpointError)
  one_sentence(error, str(original), "cannot be read now", "Too many open files")
  Checkpoint(original)


@pytest.mark.parametrize(
  ("problem", "passes"),
  [
    (OSError(errno.EMFILE, "Too many open files"), True),
    (ValueError("UNKNOWN: read failed [os_error_code='5']"), True),
    (RuntimeError("can't start new thread"), True),
    (OSError(errno.EIO, "Input/output error"), False),
    (MemoryError(), False),
  ],
)
def test_what_may_pass_is_tried_again(
  tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: Exception, passes: bool
) -> None:
  checkpoint = Checkpoint(save(tmp_path, 10)[0])
  problems = [problem] * (2 if passes else 9)
  arrays = Checkpoint._read_arrays

  def read(self: Checkpoint, item: str) -> Any:
    if problems:
      raise problems.pop()
    return arrays(self, item)

  monkeypatch.setattr(Checkpoint, "_read_arrays", read)
  monkeypatch.setattr(checkpoints, "_RETRY_AFTER_S", (0.0, 0.0))
  if passes:
    checkpoint.restore("policy", like(POLICY))
    return
  with pytest.raises(CheckpointError) as error:
    checkpoint.restore("policy", like(POLICY))
  assert not isinstance(error.value, DamagedCheckpointError)
  assert len(problems) == 6


def edit(checkpoint: Path, change: Callable[[dict[str, Any]], Any]) -> None:
  """Changes a checkpoint's meta data as an accident would, which computes no checksum."""
  file = checkpoint / "meta" / "metadata"
  content = json.loads(file.read_text())
  change(content)
  file.write_text(json.dumps(content))


def test_a_newer_format_is_refused_with_its_version_and_stays(tmp_path: Path) -> None:
  newest, _ = save(tmp_path, 10, 20)
  edit(newest, lambda meta: meta.update(format="playground-run/2", leaves="another way to say it"))
  with pytest.raises(CheckpointError) as error:
    Checkpoint(newest)
  assert not isinstance(error.value, DamagedCheckpointError)
  one_sentence(error, str(newest), "newer version", "playground-run/2", "playground-run/1")
  with pytest.raises(CheckpointError, match="newer version"):
    save(tmp_path)
  assert newest.is_dir()


@pytest.mark.parametrize("key", ["step", "update", "wall_clock_s", "env", "config", "leaves", "sha256", "return"])
@pytest.mark.parametrize("value", ["missing", None, -1, "text", [], {}, {"policy": 5}, {"policy": [[1, 2, 3]]}])
@pytest.mark.parametrize("with_checksum", [True, False])
def test_changed_meta_data_are_damage(
  original: Path, tmp_path: Path, key: str, value: Any, with_checksum: bool
) -> None:
  """Those of earlier versions have no checksum; a change that shows is one sentence there, too."""
  checkpoint = shutil.copytree(original, tmp_path / "checkpoints" / "000000000010")
  if not with_checksum:
    edit(checkpoint, lambda meta: meta.pop("meta_sha256"))
  edit(checkpoint, lambda meta: meta.pop(key) if value == "missing" else meta.update({key: value}))
  with contextlib.ExitStack() as stack:
    if with_checksum:
      error = stack.enter_context(pytest.raises(DamagedCheckpointError))
    else:
      error = stack.enter_context(contextlib.suppress(CheckpointError))
    Checkpoint(checkpoint).restore("policy", like(POLICY))
  if error is not None:
    one_sentence(error, str(checkpoint), "is damaged: its meta data")


@pytest.mark.parametrize(
  ("change", "key"),
  [
    ({"columns": 5}, "columns"),
    ({"settings": [1]}, "settings"),
    ({"update": -5}, "update"),
    ({"config": {"agent": [1]}}, "config.agent"),
    ({"config": {"env": 3}}, "config.env"),
  ],
)
def test_meta_data_that_no_run_writes_are_damage(
  original: Path, tmp_path: Path, change: dict[str, Any], key: str
) -> None:
  checkpoint = shutil.copytree(original, tmp_path / "checkpoints" / "000000000010")
  edit(checkpoint, lambda meta: (meta.pop("meta_sha256"), meta.update(change)))
  with pytest.raises(DamagedCheckpointError, match=f"its meta data have no valid '{key}'"):
    Checkpoint(checkpoint)


def test_a_step_is_its_folders(tmp_path: Path) -> None:
  newest, _ = save(tmp_path, 10, 20)
  renamed = newest.rename(newest.with_name("000000000030"))
  with pytest.raises(CheckpointError) as error:
    Checkpoint(renamed)
  assert not isinstance(error.value, DamagedCheckpointError), "its bytes are whole"
  one_sentence(error, str(renamed), "holds step 20: rename the folder to 000000000020")


def test_a_folder_that_cannot_be_listed_has_not_no_checkpoints(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  """Else a resumed run would begin again, over what is there."""
  save(tmp_path, 10)
  monkeypatch.setattr(Path, "iterdir", lambda _: (_ for _ in ()).throw(OSError(errno.EMFILE, "Too many open files")))
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(tmp_path)
  assert not isinstance(error.value, NoCheckpointError)
  one_sentence(error, "cannot be read: Too many open files")


@pytest.mark.parametrize("item", ["policy", "state", "meta"])
def test_a_missing_item_is_refused(tmp_path: Path, item: str) -> None:
  (path,) = save(tmp_path, 10)
  shutil.rmtree(path / item)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path).restore(item, like({"policy": POLICY}.get(item, STATE)))
  one_sentence(error, str(path), f"damaged: its '{item}' cannot be read")


@pytest.mark.parametrize("size", [0, 10, 0.5, 0.9])
def test_a_truncated_file_is_refused(tmp_path: Path, size: float) -> None:
  (path,) = save(tmp_path, 10)
  file = data_file(path)
  os.truncate(file, int(size if size > 1 else size * file.stat().st_size))
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path).restore("state", like(STATE))
  one_sentence(error, str(path), "is damaged")
  Checkpoint(path).restore("policy", like(POLICY))  # which is whole


@pytest.mark.parametrize("where", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_a_flipped_byte_is_refused(tmp_path: Path, where: float) -> None:
  (path,) = save(tmp_path, 10)
  file = data_file(path)
  content = bytearray(file.read_bytes())
  content[int(where * len(content))] ^= 0x40
  file.write_bytes(content)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path).restore("state", like(STATE))
  one_sentence(error, str(path), "is damaged")


@pytest.mark.parametrize(
  ("change", "words"),
  [
    ({"w": jnp.zeros((50, 61))}, ["['w'] is float32[50, 60] there and float32[50, 61] here"]),
    ({"count": jnp.zeros((), jnp.float32)}, ["['count'] is int32[] there and float32[] here"]),
    ({"extra": jnp.zeros(2)}, ["it has no ['extra']"]),
  ],
)
def test_another_shape_is_named(tmp_path: Path, change: dict[str, Any], words: list[str]) -> None:
  (path,) = save(tmp_path, 10)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path).restore("policy", like(POLICY | change))
  one_sentence(error, str(path), "does not fit", *words)


def test_what_it_has_besides_is_named(tmp_path: Path) -> None:
  (path,) = save(tmp_path, 10)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path).restore("policy", like({"w": POLICY["w"]}))
  one_sentence(error, str(path), "it has ['count'] besides")


def test_find_checkpoints(tmp_path: Path) -> None:
  save(tmp_path, 20, 100)
  checkpoints = tmp_path / "checkpoints"
  (checkpoints / "000000000300.orbax-checkpoint-tmp").mkdir()  # a save that was killed
  (checkpoints / "notes").mkdir()
  (checkpoints / "000000000400").write_text("a file")
  expected = [checkpoints / "000000000100", checkpoints / "000000000020"]
  assert find_checkpoints(tmp_path) == expected
  assert find_checkpoints(str(checkpoints)) == expected
  assert find_checkpoints(expected[1]) == [expected[1]]


def test_a_sweeps_folder_holds_runs(tmp_path: Path) -> None:
  save(tmp_path / "jobs" / "000_seed=1", 10)
  with pytest.raises(CheckpointError, match=r"is a folder of runs: name one, .* \S+/jobs/000_seed=1\."):
    find_checkpoints(tmp_path)


def test_the_newest_run_of_a_folder_may_be_a_chain(tmp_path: Path) -> None:
  save(tmp_path / "2026-01-01", 10)
  save(tmp_path / "2026-01-02" / "1_near", 10)
  (tmp_path / "2026-01-02" / "config.yaml").touch()
  with pytest.raises(CheckpointError, match=r"is a folder of runs: name one, .* \S+/2026-01-02\."):
    find_checkpoints(tmp_path)


def test_those_of_a_chain(tmp_path: Path) -> None:
  """They are the last stage's that has any: one that is about to save its first has none."""
  save(tmp_path / "2_near", 20)
  expected = save(tmp_path / "10_far", 10)
  (tmp_path / "11_next/checkpoints/000000000005.orbax-checkpoint-tmp").mkdir(parents=True)
  with pytest.raises(CheckpointError, match="is a folder of runs"):  # so are a sweep's jobs, `000_seed=1`
    find_checkpoints(tmp_path)
  (tmp_path / "config.yaml").touch()
  assert find_checkpoints(tmp_path) == expected
  assert [path.name for path in checkpoints.find_stages(tmp_path)] == ["2_near", "10_far"]


def test_saves_that_overlap_silence_no_thread_afterwards() -> None:
  """Runs that train together save at the same time."""
  hook = threading.excepthook
  first, second = checkpoints._quiet_threads(), checkpoints._quiet_threads()
  with contextlib.ExitStack() as outer:
    with contextlib.ExitStack() as inner:
      inner.enter_context(first)
      outer.enter_context(second)
    assert threading.excepthook is not hook
  assert threading.excepthook is hook


def test_an_unfinished_save_is_cleaned_away(tmp_path: Path) -> None:
  save(tmp_path, 10)
  half = tmp_path / "checkpoints" / "000000000020.orbax-checkpoint-tmp"
  shutil.copytree(tmp_path / "checkpoints" / "000000000010", half)
  assert [p.name for p in save(tmp_path, 20)] == ["000000000020", "000000000010"]
  assert not half.exists()


@pytest.mark.parametrize("content", [None, ".", "checkpoints", "checkpoints/000000000300.orbax-checkpoint-tmp"])
def test_find_checkpoints_where_there_is_none(tmp_path: Path, content: str | None) -> None:
  run = tmp_path / "run"
  if content:
    (run / content).mkdir(parents=True)
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(run)
  one_sentence(error, str(run), "holds no checkpoint" if content else "does not exist")
  if content == "checkpoints":
    with pytest.raises(CheckpointError) as error:
      find_checkpoints(tmp_path)
    one_sentence(error, "is a folder of runs: name one, such as the newest,", str(run))


@pytest.mark.parametrize("given", ["", "policy.onnx"])
def test_an_exported_policy_is_no_checkpoint(tmp_path: Path, given: str) -> None:
  (tmp_path / "policy.onnx").touch()
  with pytest.raises(CheckpointError) as error:
    find_checkpoints(tmp_path / given)
  one_sentence(error, str(tmp_path / given), "an exported policy, which only `playground play` takes")
