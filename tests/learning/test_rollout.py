"""Rollouts: how a tree travels through a scan."""

import jax
import jax.numpy as jnp
import numpy as np

from playground.learning.rollout import Stacked


def test_vectors_and_numbers_of_a_tree_travel_through_a_scan_as_one_array_each() -> None:
  tree = {
    "a": jnp.arange(3.0),
    "b": {"c": jnp.ones(3), "d": jnp.ones((3, 2)), "e": jnp.zeros((3, 2))},
    "count": jnp.arange(3),
    "x": jnp.float32(1),
    "y": jnp.float32(2),
  }
  assert [array.shape for array in Stacked.of(tree).arrays] == [(2, 3), (3, 2), (3, 2), (3,), (2,)]

  def body(carry: Stacked, i: jax.Array) -> tuple[Stacked, Stacked]:
    tree = carry.tree()
    return Stacked.of(tree | {"a": tree["a"] + i}), Stacked.of(tree)

  carry, steps = jax.lax.scan(body, Stacked.of(tree), jnp.arange(4.0))
  assert jax.tree.structure(carry.tree()) == jax.tree.structure(tree)
  np.testing.assert_array_equal(carry.tree()["a"], [6, 7, 8])
  expected = jax.tree.map(lambda leaf: jnp.stack([leaf] * 4), tree)
  expected["a"] = jnp.arange(3.0) + jnp.array([0, 0, 1, 3])[:, None]
  jax.tree.map(np.testing.assert_array_equal, steps.tree(axis=1), expected)
