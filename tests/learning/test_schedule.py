"""Where evaluations, resets and calls to the device lie."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from playground.learning.loop import ScheduleEvent, longest_stretch, schedule


def test_a_short_run_written_out() -> None:
  assert schedule(6, num_evals=3, num_resets_per_eval=3, max_updates=10) == [
    ScheduleEvent(0, evaluate=True),
    ScheduleEvent(1, reset=True),
    ScheduleEvent(2, reset=True),
    ScheduleEvent(3, evaluate=True, reset=True),
    ScheduleEvent(4, reset=True),
    ScheduleEvent(5, reset=True),
    ScheduleEvent(6, evaluate=True),
  ]


def test_one_evaluation_is_at_the_end() -> None:
  assert [m.update for m in schedule(5, 1, 0, 10) if m.evaluate] == [5]


def test_long_stretches_are_cut() -> None:
  assert [m.update for m in schedule(10, 1, 0, 4)] == [4, 8, 10]


@given(st.integers(1, 3000), st.integers(1, 30), st.integers(0, 12), st.integers(1, 50))
def test_any_schedule_covers_the_budget_in_order(updates: int, evals: int, resets: int, longest: int) -> None:
  marks = schedule(updates, evals, resets, longest)
  points = [mark.update for mark in marks]
  assert points == sorted(set(points))
  assert points[-1] == updates
  assert all(b - a <= longest for a, b in zip([0, *points], points, strict=False))
  assert sum(mark.evaluate for mark in marks) == min(evals, updates + 1)
  assert not marks[-1].reset


@pytest.mark.parametrize("resets", [1, 4])
def test_resets_fall_between_evaluations(resets: int) -> None:
  marks = schedule(100, 5, resets, 100)
  assert sum(mark.reset for mark in marks) == 4 * resets - 1


def test_the_longest_stretch_is_from_one_fresh_start_to_the_next_or_to_the_end() -> None:
  assert longest_stretch(schedule(12, num_evals=3, num_resets_per_eval=2, max_updates=2)) == 3
  assert longest_stretch(schedule(7, num_evals=2, num_resets_per_eval=3, max_updates=50)) == 3  # 2, 3, 2
  assert longest_stretch(schedule(12, num_evals=3, num_resets_per_eval=0, max_updates=2)) == 12
  assert longest_stretch([ScheduleEvent(4), ScheduleEvent(5, reset=True), ScheduleEvent(8)]) == 5
