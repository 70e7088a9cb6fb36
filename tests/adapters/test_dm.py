"""dm_env's own tests on a task, and how its episodes end."""

import numpy as np
from absl.testing import absltest
from dm_env import test_utils

from playground.adapters.dm import DmEnv

LENGTH = 4


def make() -> DmEnv:
  return DmEnv("PendulumSwingup", overrides={"episode_length": LENGTH})


class TestDmEnv(test_utils.EnvironmentTestMixin, absltest.TestCase):
  environment: DmEnv

  @classmethod
  def setUpClass(cls) -> None:
    super().setUpClass()
    cls.shared = make()

  def make_object_under_test(self) -> DmEnv:
    self.shared._running = False  # as new, but for what is compiled
    return self.shared

  def test_time_ends_an_episode_with_discount_1(self) -> None:
    env = self.shared
    env.reset()
    steps = [env.step(np.zeros(1, np.float32)) for _ in range(LENGTH)]
    assert [step.last() for step in steps] == [False] * (LENGTH - 1) + [True]
    assert steps[-1].discount == 1.0
    assert env.step(np.zeros(1, np.float32)).first()
