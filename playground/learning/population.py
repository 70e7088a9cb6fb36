"""Population-based training: agents of one program copy better ones and vary their numbers (Jaderberg et al., 2017)."""

import dataclasses
from collections.abc import Mapping

import numpy as np

from playground.limits import Limit

QUARTER = 4
PARENT = "population/parent"  # in metrics.csv: the index of the agent that was copied after the row's evaluation
FACTORS = (0.8, 1.25)


@dataclasses.dataclass(frozen=True)
class Population:
  """When and how agents learn from each other.

  Attributes:
    exploit_every: evaluations from one exchange to the next; that before training does not count.
    explore: limits of the settings that agents copy and vary, by key; the others stay their own.
    seed: of what is drawn.
  """

  exploit_every: int
  explore: Mapping[str, Limit]
  seed: int

  def exchange(
    self, returns: np.ndarray, settings: Mapping[str, np.ndarray], update: int
  ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Lets each agent of the worst quarter take over what one of the best quarter is.

    Args:
      returns: of each agent, [agents]; NaN is the worst.
      settings: values by key, each [agents, ...].
      update: number of training steps so far; with the seed it says what is drawn, so that a resumed run draws it, too.

    Returns:
      Whose parameters each agent goes on with, [agents], and the settings from then on: an agent that copies another
      multiplies each of the explored ones by 0.8 or 1.25, within its limit.
    """
    rng = np.random.default_rng([self.seed, update])
    ranked = np.argsort(np.where(np.isnan(returns), -np.inf, returns), kind="stable")
    count = max(1, len(returns) // QUARTER)
    parents = np.arange(len(returns))
    parents[ranked[:count]] = rng.choice(ranked[-count:], count)
    changed, values = dict(settings), {key: settings[key][parents] for key in self.explore}
    for agent in ranked[:count]:
      for key, limit in self.explore.items():
        values[key][agent] = np.clip(values[key][agent] * rng.choice(FACTORS), limit.low, limit.high)
    return parents, changed | values
