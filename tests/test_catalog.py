"""The catalogue that `playground list` shows."""

import pytest

from playground import catalog, registry


def test_lists_every_task_of_ours():
  assert [name for name in registry.names() if name in catalog.entries()] == list(catalog.entries())
  assert len(catalog.entries()) == 56


@pytest.mark.parametrize("task", ["CartpoleBalance", "Go1JoystickFlatTerrain"])
def test_an_entry_is_what_the_task_is(task: str):
  assert catalog.measure(task) == catalog.entries()[task]


@pytest.mark.slow
@pytest.mark.parametrize("task", sorted(catalog.entries()))
def test_every_entry_is_what_the_task_is(task: str):
  assert catalog.measure(task) == catalog.entries()[task]


@pytest.mark.parametrize(
  ("row", "status"),
  [
    ({"note": "", "final_return": "800"}, "solved"),
    ({"note": "", "final_return": "20"}, "open"),
    ({"note": "", "final_return": "27", "falls_per_episode": "0.5"}, "learning"),
    ({"note": "", "final_return": "27", "falls_per_episode": "", "episode_length": "981"}, "solved"),
    ({"note": "", "final_return": "27", "success": "0.95"}, "solved"),
    ({"note": "", "success": "", "turns": "4.9", "c_mujoco_falls_per_episode": "0"}, "solved"),
    ({"note": "", "success": "", "turns": "9.2", "c_mujoco_falls_per_episode": "0.65"}, "learning"),
    ({"note": "", "success": "", "turns": "0.7", "c_mujoco_falls_per_episode": "0.1"}, "learning"),
    ({"note": "", "success": "", "turns": "3.5", "c_mujoco_falls_per_episode": ""}, "learning"),
    ({"note": "", "final_return": "27", "success": "0"}, "open"),
    ({"note": "solved at 3 M", "final_return": "27", "success": ""}, "solved"),
  ],
)
def test_status(row: dict[str, str], status: str):
  assert catalog.status(row) == status


def test_of_a_chain_the_runs_of_its_last_stage_count():
  row = lambda who, experiment, setting: {"task": "A", "who": who, "experiment": experiment, "setting": setting}
  alone, first, last = row("ours", "", "seed=1"), row("ours", "a_chain", "stage=a"), row("ours", "a_chain", "stage=b")
  other = row("ours", "b_chain", "stage=a")
  rows = [alone, first, last, row("others", "", ""), other, first, last]
  assert catalog.our_runs(rows, "A") == [alone, last, other, last]
  assert catalog.our_runs(rows, "B") == []
