"""Random keys by name."""

import jax
import numpy as np

from playground.mdp.keys import split_keys

RNG = jax.random.PRNGKey(0)


def test_order_is_that_of_the_splits() -> None:
  rng, keys = split_keys(RNG, ("a", "b", "c"), [["c", "unused"], ["a"]])
  one = jax.random.split(RNG, 3)
  two = jax.random.split(one[0], 2)
  three = jax.random.split(two[0], 2)  # what is left out of the order comes last
  np.testing.assert_array_equal(rng, three[0])
  assert set(keys) == {"a", "b", "c", "unused"}
  for name, key in {"c": one[1], "unused": one[2], "a": two[1], "b": three[1]}.items():
    np.testing.assert_array_equal(keys[name], key)


def test_nothing_to_draw() -> None:
  rng, keys = split_keys(RNG, ())
  np.testing.assert_array_equal(rng, RNG)
  assert keys == {}
