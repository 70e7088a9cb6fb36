"""Errors: names that do not exist."""

import pytest

from playground.errors import UnknownNameError, lookup


@pytest.mark.parametrize(
  ("table", "message"),
  [
    ({}, "env.x: 'walk' is unknown; there are none."),
    ({"trot": 1, "walks": 2}, "env.x: 'walk' is unknown; choose from trot, walks. Did you mean 'walks'?"),
    (dict.fromkeys(map(str, range(100))), "env.x: 'walk' is unknown."),
  ],
  ids=len,
)
def test_a_name_that_a_table_has_not(table: dict[str, int], message: str) -> None:
  with pytest.raises(UnknownNameError) as error:
    lookup(table, "walk", "env.x")
  assert str(error.value) == message
