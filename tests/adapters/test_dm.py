"""dm_env's own tests on a task, and how its episodes end."""

import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils

from playground import registry
from playground.adapters.dm import DmEnv
from tests.dummy import Point

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


def test_images_are_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
  class Seeing(Point):
    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
      return {"state": (2,), "pixels/eye": (4, 6, 3)}

  monkeypatch.setattr(registry, "load", lambda name, overrides=None: Seeing())
  spec = DmEnv("Seeing", physics="mjx").observation_spec()
  spec["pixels/eye"].validate(np.zeros((4, 6, 3), np.uint8))
  spec["state"].validate(np.zeros(2, np.float32))
