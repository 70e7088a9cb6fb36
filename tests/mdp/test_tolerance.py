"""`tolerance` against values computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from playground.errors import UnknownNameError
from playground.mdp.tolerance import SIGMOIDS, tolerance

# S(0.5) with S(1) = 0.1.
HALF_WAY = {
  "gaussian": 0.1**0.25,
  "hyperbolic": 1 / 5.5**0.5,  # cosh(acosh(10) / 2)² = (10 + 1) / 2
  "long_tail": 1 / (9 / 4 + 1),
  "reciprocal": 1 / 5.5,
  "cosine": 0.658114,
  "linear": 0.55,
  "quadratic": 0.775,
  "tanh_squared": 0.480506,
}


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
def test_sigmoids(sigmoid: str) -> None:
  x = jnp.array([-2.0, -1.0, 1.0, 1.5, 3.0, 5.0])
  value = tolerance(x, bounds=(-1, 2), margin=2, sigmoid=sigmoid)
  half, at_margin = HALF_WAY[sigmoid], 0.1
  np.testing.assert_allclose(value[:5], [half, 1, 1, 1, half], rtol=1e-5)
  far = tolerance(jnp.array([-3.0, 4.0]), bounds=(-1, 2), margin=2, sigmoid=sigmoid)
  np.testing.assert_allclose(far, at_margin, rtol=1e-4)
  assert 0 <= value[5] < at_margin


@pytest.mark.parametrize("sigmoid", ["cosine", "linear", "quadratic"])
def test_some_sigmoids_reach_zero(sigmoid: str) -> None:
  value = tolerance(jnp.array([0.0, 1.0, 7.0]), margin=1, sigmoid=sigmoid, value_at_margin=0)
  np.testing.assert_allclose(value, [1, 0, 0], atol=1e-6)


def test_no_margin_is_a_step() -> None:
  value = tolerance(jnp.array([-0.1, 0.0, 1.0, 1.1]), bounds=(0, 1), value_at_margin=7, sigmoid="unused")
  np.testing.assert_array_equal(value, [0, 1, 1, 0])


def test_open_bound() -> None:
  value = tolerance(jnp.array([-1.0, 1e6]), bounds=(0, float("inf")), margin=1, sigmoid="linear", value_at_margin=0.5)
  np.testing.assert_allclose(value, [0.5, 1.0])


@pytest.mark.parametrize("sigmoid", SIGMOIDS)
def test_gradients_are_finite(sigmoid: str) -> None:
  gradient = jax.vmap(jax.grad(lambda x: tolerance(x, (-1, 1), 1, sigmoid)))(jnp.array([-9.0, -1.5, 0.0, 1.5, 9.0]))
  assert jnp.isfinite(gradient).all()


@pytest.mark.parametrize(
  ("arguments", "message"),
  [
    ({"bounds": (1, 0)}, "lower bound 1 is above upper bound 0"),
    ({"margin": -1}, "margin=-1 is negative"),
    ({"margin": 1, "value_at_margin": 0}, r"value_at_margin=0 must lie in \(0, 1\) for 'gaussian'"),
    ({"margin": 1, "value_at_margin": 1}, r"value_at_margin=1 must lie in \(0, 1\)"),
    ({"margin": 1, "value_at_margin": 1, "sigmoid": "linear"}, r"must lie in \[0, 1\) for 'linear'"),
    ({"margin": 1, "value_at_margin": -0.1, "sigmoid": "cosine"}, r"must lie in \[0, 1\) for 'cosine'"),
  ],
)
def test_errors(arguments: dict, message: str) -> None:
  with pytest.raises(ValueError, match=message):
    tolerance(jnp.zeros(()), **arguments)


def test_unknown_sigmoid() -> None:
  with pytest.raises(UnknownNameError, match="Did you mean 'gaussian'"):
    tolerance(jnp.zeros(()), margin=1, sigmoid="gausian")
