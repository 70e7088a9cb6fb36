"""Agents that learn from each other: what an exchange does, and that a resumed population ends the same."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from playground.hardware.mesh import make_mesh
from playground.learning.evaluation import make_evaluator
from playground.learning.loop import Loop, compile_program, schedule
from playground.learning.population import PARENT, Population
from playground.learning.trainer import Trainer, trainer_settings
from playground.limits import SHARE, positive
from tests.dummy import SMALL_PPO, PointTask, Recorder, check_resume, numbers

RATE, COST = "agent.learning_rate", "agent.entropy_cost"
POPULATION = Population(exploit_every=1, explore={RATE: positive(1e-2)}, seed=5)


def test_the_worst_quarter_takes_over_from_the_best() -> None:
  returns = np.array([3.0, np.nan, 9.0, 8.0, 1.0, 5.0, 4.0, 6.0])
  settings = {RATE: np.linspace(1e-3, 8e-3, 8, dtype=np.float32), COST: np.arange(8, dtype=np.float32)}
  parents, changed = POPULATION.exchange(returns, settings, update=7)
  replaced = parents != np.arange(8)
  assert np.flatnonzero(replaced).tolist() == [1, 4] and set(parents[replaced]) <= {2, 3}
  factors = changed[RATE][replaced] / settings[RATE][parents[replaced]]
  assert all(np.isclose(factor, [0.8, 1.25], rtol=1e-5).any() for factor in factors)
  np.testing.assert_array_equal(changed[RATE][~replaced], settings[RATE][~replaced])
  np.testing.assert_array_equal(changed[COST], settings[COST])
  again = POPULATION.exchange(returns, settings, update=7)
  np.testing.assert_array_equal(again[1][RATE], changed[RATE])


@pytest.mark.parametrize("start", [1e-2, 9e-3])
def test_a_number_stays_within_its_limit(start: float) -> None:
  settings = {RATE: np.full(4, start, np.float32)}
  found = [POPULATION.exchange(np.arange(4.0), settings, update)[1][RATE].max() for update in range(20)]
  assert max(found) == np.float32(1e-2)


def test_a_discount_varies_by_its_distance_from_1() -> None:
  population = dataclasses.replace(POPULATION, explore={"agent.discounting": SHARE})
  settings = {"agent.discounting": np.full(4, 0.99, np.float32)}
  found = {float(population.exchange(np.arange(4.0), settings, i)[1]["agent.discounting"][0]) for i in range(20)}
  assert sorted(found) == pytest.approx([0.9875, 0.992])


def test_a_population_goes_on_where_it_was_cut_short() -> None:
  """Copies are exact, each agent's row says what was copied, and nothing is exchanged before or after training."""
  config, seeds = dataclasses.replace(SMALL_PPO, num_timesteps=800), [3, 4]
  rates = [1e-3, 8e-3]
  settings = [trainer_settings(dataclasses.replace(config, learning_rate=rate), {}) for rate in rates]
  trainer = Trainer(PointTask(), config, make_mesh(1), agents=settings)
  evaluate = make_evaluator(PointTask(), trainer.act, config.num_eval_envs, trainer.mesh, 0)
  program = compile_program(trainer, evaluate, lambda: ({}, {}))
  events = schedule(6, 4, 0, 2)

  def run(recorders: list[Recorder], state: Any = None, update: int | None = None) -> Any:
    loop = Loop(trainer, program, events, seeds, recorders, POPULATION)
    return loop.run(loop.init() if state is None else state, update)[0]

  whole, first, second = ([Recorder() for _ in seeds] for _ in range(3))
  expected = run(whole)
  parents = [[row.get(PARENT, i) for _, row in recorder.rows] for i, recorder in enumerate(whole)]
  assert [own[0] for own in parents] == [own[-1] for own in parents] == [0, 1]
  returns = [[row["eval/episode_reward"] for _, row in recorder.rows] for recorder in whole]
  for at in (1, 2):
    best = float(np.argmax([own[at] for own in returns]))
    assert [own[at] for own in parents] == [best, best]
    saved = [dict(recorder.saved)[2 * at] for recorder in whole]
    for a, b in zip(*(numbers(state.algorithm) for state in saved), strict=True):
      np.testing.assert_array_equal(a, b)
    for recorder, state in zip(whole, saved, strict=True):
      assert recorder.rows[at][1][f"population/{RATE}"] == state.settings[RATE]
    assert not np.array_equal(saved[0].env_state.data.qpos, saved[1].env_state.data.qpos)

  check_resume(trainer, run, (whole, first, second), expected)
