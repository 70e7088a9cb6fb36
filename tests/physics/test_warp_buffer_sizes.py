"""Warp's buffers: what a task needs of them, and that a run says when they are too small."""

import csv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from playground import registry
from playground.envs.wrappers import wrap_for_evaluation, wrap_for_training
from playground.errors import ConfigError
from playground.learning.rollout import episode_sums
from playground.physics import warp_buffer_sizes
from playground.physics.backend import BufferUse, mjx
from playground.physics.warp_buffer_sizes import BufferSizes, measure_buffers
from tests.dummy import PointTask


def use(constraints, contacts, overflow) -> BufferUse:
  return BufferUse(*(jnp.asarray(value, jnp.int32) for value in (constraints, contacts, overflow)))


def test_joining_keeps_the_most_and_every_overflow():
  joined = use([3, 9], [7, 7], [1, 0]).join(use([5, 2], [7, 8], [4, 0]))
  assert joined.constraints.tolist() == [5, 9]
  assert joined.contacts.tolist() == [7, 8]
  assert joined.overflow.tolist() == [5, 0]


def test_advice_has_room():
  sizes = {"njmax": 36, "naconmax_per_env": 6, "naccdmax_per_env": 3}
  assert BufferSizes(constraints=28, contacts=4.1, convex=2).advised() == sizes
  assert BufferSizes(28, 4.1, convex=8).advised() == sizes | {"naccdmax_per_env": 6}, "all contacts are convex ones"
  assert set(BufferSizes(0, 0.0, 1).advised().values()) == {0}


def test_shared_buffers_grow_with_the_batch(monkeypatch):
  pytest.importorskip("warp")
  allocated = []
  make = mjx.make_data
  remember = lambda *args, **sizes: allocated.append(sizes["naconmax"]) or make(*args, **sizes)
  monkeypatch.setattr(mjx, "make_data", remember)
  env = registry.load("Go1JoystickFlatTerrain", overrides={"impl": "warp", "naconmax_per_env": 5})
  reset = wrap_for_evaluation(env).reset
  for num_envs in (2, 8192, 32768):
    jax.eval_shape(reset, jax.ShapeDtypeStruct((num_envs, 2), jnp.uint32), {})
  assert sorted(set(allocated)) == [320, 40960, 163840]  # few environments get those of 64


@pytest.fixture
def simulated(monkeypatch):
  """Stands in for the simulation: it needs rows of an environment and pairs of all, some of them convex, and says if
  that is too many.
  """
  tried = []

  def simulate(rows: int, pairs: int, convex: int = 0, stubborn: int = 0):
    def roll(env, act, num_envs, num_steps, on_steps):
      tried.append((env.njmax, env.naconmax_per_env * num_envs, env.naccdmax_per_env * num_envs))
      assert env.naccdmax_per_env <= env.naconmax_per_env, "Warp refuses this"
      have = dict(zip((1, 8, 16), tried[-1], strict=True))
      need = {1: rows, 8: pairs, 16: convex}
      return use(rows, pairs, stubborn | sum(bit for bit, size in have.items() if need[bit] > size))

    monkeypatch.setattr(warp_buffer_sizes, "_roll", roll)
    return tried

  return simulate


@pytest.mark.parametrize(
  ("rows", "pairs", "convex", "tries", "found"),
  [(28, 16, 2, 1, 1), (200, 16, 3, 2, 2), (28, 1000, 0, 5, 1), (60, 60, 60, 6, 32), (28, 1000, 1000, 10, 512)],
)
def test_buffers_grow_until_they_are_large_enough(simulated, rows, pairs, convex, tries, found):
  tried = simulated(rows, pairs, convex)
  build: Any = lambda sizes: SimpleNamespace(**sizes)
  assert measure_buffers(build, 160, None, num_envs=2, num_steps=3) == BufferSizes(rows, pairs / 2, found)
  assert len(tried) == tries and all(have >= need for have, need in zip(tried[-1], (rows, pairs, convex), strict=True))


def test_a_rollout_reports_its_steps_and_keeps_the_most():
  class Counting(PointTask):
    """Needs one more constraint row in each step."""

    def reset(self, rng, model=None):
      state = super().reset(rng, model)
      return state.replace(data=state.data.replace(buffers=use(0, 0, 0)))

    def post_step(self, data, info, action):
      state = super().post_step(data, info, action)
      return state.replace(data=state.data.replace(buffers=use(state.info["age"], 3, 1)))

  for num_steps, stride in ((7, 1), (125, 2)):
    reported: list[int] = []
    found = warp_buffer_sizes._roll(wrap_for_training(Counting()), None, 2, num_steps, reported.append)
    assert (found.constraints, found.contacts, found.overflow) == (num_steps, 3, 1)
    assert reported == [*range(stride, num_steps, stride), num_steps]


def test_other_buffers_are_named(simulated):
  pytest.importorskip("warp")
  simulated(1, 1, stubborn=32)
  with pytest.raises(ConfigError, match=r"\(HFIELD\) still overflow with njmax=160"):
    build: Any = lambda sizes: SimpleNamespace(**sizes)
    measure_buffers(build, 160, None, 2, 3)


def test_overflows_are_counted_for_training():
  state = wrap_for_evaluation(PointTask()).reset(jax.random.split(jax.random.PRNGKey(0), 3), None)
  assert "overflows" not in episode_sums(state)
  state = state.replace(data=state.data.replace(buffers=use([1, 1, 1], [1, 1, 1], [0, 4, 1])))
  assert episode_sums(state)["overflows"] == 2


def test_what_was_measured_fits_into_what_is_configured():
  with (Path(__file__).parents[2] / "results/reference/buffers.csv").open(newline="") as file:
    for row in csv.DictReader(file):
      config: Any = registry.config(row["task"])
      assert int(row["rows_of_one_env"]) <= config.njmax, row
      assert row["conditions"].startswith("C MuJoCo") or float(row["contacts_per_env"]) <= config.naconmax_per_env, row


@pytest.mark.slow  # compiles Warp's kernels for the CPU: a minute
def test_a_real_task_on_warp():
  pytest.importorskip("warp")
  build = lambda sizes: wrap_for_training(registry.load("Go1JoystickFlatTerrain", overrides=sizes))
  found = measure_buffers(build, None, None, num_envs=2, num_steps=40)
  assert found.constraints >= 12, "a Go1 that stands on its feet"
  assert 1 <= found.contacts <= 4
