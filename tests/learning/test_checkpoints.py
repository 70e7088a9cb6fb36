"""Checkpoints: what is stored comes back bit for bit, and what is not whole, not ours or does not fit is refused."""

import errno
import json
import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from playground.errors import CheckpointError
from playground.learning import checkpoints
from playground.learning.checkpoints import Checkpoint, CheckpointStore, find_checkpoints

POLICY = {"w": jnp.linspace(-1, 1, 3000).reshape(50, 60), "count": jnp.asarray(7, jnp.int32)}
STATE = {
  "scalar": jnp.asarray(-0.0),
  "odd": jnp.asarray([np.nan, np.inf, 1e-45, 0.1], jnp.float32),
  "half": jnp.asarray([1.5, -2], jnp.bfloat16),
  "found": jnp.asarray([True, False]),
  "flag": jnp.asarray(True),
  "nothing": jnp.zeros((0, 3)),
  "key": jax.random.PRNGKey(2**31),
  "steps": np.asarray([2**31 - 1, -1], np.int32),
  "noise": jax.random.normal(jax.random.PRNGKey(0), (4000,)),
}


def save(
  folder: Path, *steps: int, keep: int = 3, returns: dict[int, float] | None = None, **kwargs: Any
) -> list[Path]:
  """Saves the trees at these steps, and those with a return, into folder/checkpoints; what lies there, newest first."""
  store = CheckpointStore(folder / "checkpoints", keep, **kwargs)
  returns = returns or {}
  for step in sorted({*steps, *returns}):
    store.save(step, POLICY, STATE, {"update": step // 10}, episode_return=returns.get(step))
  store.close()
  return find_checkpoints(folder)


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


def test_the_newest_are_kept(tmp_path: Path) -> None:
  assert [p.name for p in save(tmp_path, 10, 20, 30, 40, keep=2)] == ["000000000040", "000000000030"]
  # A run that goes on counts those that are there.
  assert [p.name for p in save(tmp_path, 50, keep=2)] == ["000000000050", "000000000040"]


def test_a_run_that_fell_back_makes_the_later_ones_again(tmp_path: Path) -> None:
  newest, _ = save(tmp_path, 10, 20)
  os.truncate(data_file(newest), 10)
  paths = save(tmp_path, 20, continued=10)
  assert [p.name for p in paths] == ["000000000020", "000000000010"]
  Checkpoint(paths[0]).restore("state", like(STATE))


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
  monkeypatch.setattr(checkpoints, "shutil", SimpleNamespace(rmtree=removing(shutil.rmtree)))
  assert numbers(save(tmp_path, keep=1, returns={10: 2.0, 20: 1.0, 30: 3.0, 40: 4.0})) == [40]
  assert seen == [30, 30, 40]
  assert numbers(save(tmp_path, keep=2, returns={50: 5.0}, continued=40)) == [50, 40]
  os.truncate(data_file(tmp_path / "checkpoints" / "000000000050"), 10)
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
  assert list((tmp_path / "checkpoints").iterdir()) == [], "from the beginning"


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


def test_a_foreign_folder_is_refused(tmp_path: Path) -> None:
  foreign = tmp_path / "checkpoints" / "000000000010"
  (foreign / "default").mkdir(parents=True)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(foreign)
  one_sentence(error, str(foreign), "not a checkpoint of playground-run")

  (path,) = save(tmp_path / "other", 10)
  meta = path / "meta" / "metadata"
  meta.write_text(json.dumps(json.loads(meta.read_text()) | {"format": "brax/1"}))
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path)
  one_sentence(error, str(path), "playground-run/1")

  with pytest.raises(CheckpointError) as error:
    Checkpoint(tmp_path / "checkpoints" / "000000000099")
  one_sentence(error, "000000000099", "no such folder")


@pytest.mark.parametrize("item", ["policy", "state", "meta"])
def test_a_missing_item_is_refused(tmp_path: Path, item: str) -> None:
  (path,) = save(tmp_path, 10)
  shutil.rmtree(path / item)
  with pytest.raises(CheckpointError) as error:
    Checkpoint(path).restore(item, like({"policy": POLICY}.get(item, STATE)))
  one_sentence(error, str(path), "meta data" if item == "meta" else f"damaged: its '{item}'")


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


def test_those_of_a_chain(tmp_path: Path) -> None:
  """They are the last stage's that has any: one that is about to save its first has none."""
  save(tmp_path / "2_near", 20)
  expected = save(tmp_path / "10_far", 10)
  (tmp_path / "11_next/checkpoints/000000000005.orbax-checkpoint-tmp").mkdir(parents=True)
  assert find_checkpoints(tmp_path) == expected
  assert [path.name for path in checkpoints.find_stages(tmp_path)] == ["2_near", "10_far"]


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
