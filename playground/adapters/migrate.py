"""The suites of Playground 0.2.0, for code written for it: `from playground import locomotion`.

`registry` and `wrapper` are our own modules under 0.2.0's names. docs/migrate.md lists the other changes.
"""

from collections.abc import Callable, Sequence

from ml_collections import ConfigDict

from playground import registry
from playground.envs.base import Env
from playground.paper import tasks_of
from playground.settings import Section


class Suite:
  """A suite of the registry."""

  def __init__(self, members: Callable[[], Sequence[str]]):
    """Takes a function that returns the names of its tasks."""
    self._members = members

  @property
  def ALL_ENVS(self) -> tuple[str, ...]:  # 0.2.0's name
    return tuple(self._members())

  def load(self, env_name: str, config: ConfigDict | None = None, config_overrides: Section | None = None) -> Env:
    """See `registry.load`."""
    return registry.load(env_name, config=config, config_overrides=config_overrides)

  def get_default_config(self, env_name: str) -> ConfigDict:
    """See `registry.config`."""
    return registry.config(env_name)

  def get_domain_randomizer(self, env_name: str) -> registry.DomainRandomizer | None:
    """See `registry.get_domain_randomizer`."""
    return registry.get_domain_randomizer(env_name)


def _beginning(*robots: str) -> Callable[[], Sequence[str]]:
  return lambda: [name for name in registry.names() if name.startswith(robots)]


dm_control_suite = Suite(lambda: tasks_of("dm_control"))
locomotion = Suite(_beginning("Apollo", "Barkour", "Berkeley", "G1", "Go1", "H1", "Op3", "Spot", "T1"))
manipulation = Suite(_beginning("Aero", "Aloha", "Leap", "Panda"))
