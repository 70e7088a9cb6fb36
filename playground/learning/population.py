"""Population-based training: agents of one program copy better ones and perturb settings (Jaderberg et al., 2017)."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from playground.limits import SHARE, Limit

QUARTER = 4
PARENT = "population/parent"  # in metrics.csv: the index of the agent that was copied after the row's evaluation
FACTORS = (0.8, 1.25)


@dataclasses.dataclass(frozen=True)
class Population:
  """The exchanges between agents.

  Attributes:
    exploit_every: evaluations from one exchange to the next; that before training does not count.
    explore: limits of the settings that agents copy and vary, by key; the others stay their own.
    seed: of the random choices.
  """

  exploit_every: int
  explore: Mapping[str, Limit]
  seed: int

  def exchange(
    self, returns: np.ndarray, settings: Mapping[str, np.ndarray], update: int
  ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Replaces each agent of the worst quarter by a copy of one of the best quarter.

    Args:
      returns: of each agent, [agents]; NaN is the worst.
      settings: values by key, each [agents, ...].
      update: number of training steps so far; with the seed it determines the draws, also of a resumed run.

    Returns:
      The index of the agent that each agent copies, [agents], and the new settings. An agent that copies another
      multiplies each setting of `explore` by 0.8 or 1.25, within its limit; for a share x above 0.5, such as a
      discount, the factor applies to 1 - x.
    """
    rng = np.random.default_rng([self.seed, update])
    ranked = np.argsort(np.where(np.isnan(returns), -np.inf, returns), kind="stable")
    count = max(1, len(returns) // QUARTER)
    parents = np.arange(len(returns))
    parents[ranked[:count]] = rng.choice(ranked[-count:], count)
    changed, values = dict(settings), {key: settings[key][parents] for key in self.explore}
    for agent in ranked[:count]:
      for key, limit in self.explore.items():
        value, factor = values[key][agent], rng.choice(FACTORS)
        value = 1 - (1 - value) * factor if limit == SHARE and value > 0.5 else value * factor
        values[key][agent] = np.clip(value, limit.low, limit.high)
    return parents, changed | values
