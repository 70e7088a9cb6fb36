"""How reward terms are chosen, gated, weighed and added up."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from playground.errors import ConfigError, UnknownNameError
from playground.mdp.rewards import REWARDS, TOTALS, bind
from tests.mdp.context import FACTS, PARAMETERS, context


def values(command: tuple[float, float, float] = (1.0, 0.0, 0.0), parity: bool = False, **config: Any):
  """Every term's value under `env.reward`'s `config`."""
  terms = bind(ConfigDict({**PARAMETERS, **config}), REWARDS, parity=parity, facts=FACTS)
  return {name: float(term(context(command=command))) for name, (_, term) in terms.items()}


def test_terms_may_be_functions_of_other_names() -> None:
  config = {
    "scales": {"pose": -2.0, "dof_pos_limits": 1.0},
    "functions": {"pose": "pose_deviation"},
    "parity_functions": {"dof_pos_limits": "dof_pos_limits_scaled"},
  }
  for parity, limits in ((False, 0.015), (True, 0.09)):
    terms = values(parity=parity, **config)
    np.testing.assert_allclose([terms["pose"], terms["dof_pos_limits"]], [0.0688, limits], rtol=1e-4)


def test_terms_may_count_only_when_moving_or_still() -> None:
  config = {
    "scales": {"torques": 1.0, "energy": 1.0, "dof_vel": 1.0},
    "when_moving": {"torques": 0.1, "dof_vel": None},
    "when_still": {"energy": 0.1},
  }
  assert values(command=(0.0, 0.0, 0.11), **config) == {"torques": 12.0, "energy": 0.0, "dof_vel": 5.0}
  assert values(command=(0.0, 0.0, 0.09), **config) == {"torques": 0.0, "energy": 10.0, "dof_vel": 5.0}


def test_a_slip_brings_its_own_condition() -> None:
  config = {
    "scales": {"stand_still": 1.0},
    "parity_functions": {"stand_still": "stand_still_unless_left"},
    "when_still": {"stand_still": 0.1},
  }
  for parity, value in ((False, 0.0), (True, 0.44)):
    np.testing.assert_allclose(values(parity=parity, **config)["stand_still"], value, rtol=1e-5)


def test_terms_of_weight_zero_are_left_out() -> None:
  assert set(bind(ConfigDict({"scales": {"energy": 0, "torques": -1.0}}), REWARDS)) == {"torques"}


@pytest.mark.parametrize(("total", "value"), [("sum", 1.0), ("product", 2 * np.exp(-0.2))])
def test_totals(total: str, value: float) -> None:
  np.testing.assert_allclose(TOTALS[total](jnp.array(2.0), jnp.array(-1.0)), value, rtol=1e-6)


@pytest.mark.parametrize(
  ("config", "message"),
  [
    ({"scales": {"energi": 1.0}}, r"env\.reward\.scales: 'energi' is unknown.*Did you mean 'energy'\?"),
    ({"functions": {"enrgy": "torques"}}, r"env\.reward\.functions: 'enrgy'.*Did you mean 'energy'\?"),
    ({"parity_functions": {"energy": "torqes"}}, r"env\.reward\.parity_functions\.energy: 'torqes'.*'torques'\?"),
    ({"when_moving": {"enrgy": 0.1}}, r"env\.reward\.when_moving: 'enrgy'.*Did you mean 'energy'\?"),
  ],
)
def test_unknown_names(config: dict[str, Any], message: str) -> None:
  with pytest.raises(UnknownNameError, match=message):
    bind(ConfigDict({"scales": {"energy": 1.0}, **config}), REWARDS)


def test_a_missing_parameter() -> None:
  with pytest.raises(ConfigError, match=r"env\.reward\.tracking_sigma is missing: term 'tracking_lin_vel' needs it"):
    bind(ConfigDict({"scales": {"tracking_lin_vel": 1.0}}), REWARDS)
