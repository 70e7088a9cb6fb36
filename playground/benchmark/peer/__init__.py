"""Lists other packages to compare with; each is in its own environment, none is a dependency."""

import os
import subprocess
from pathlib import Path
from typing import NamedTuple

from playground.errors import ConfigError, UnknownNameError, nearest


class Peer(NamedTuple):
  """A package to compare with, and the program that drives it."""

  driver: Path
  distribution: str
  version: str

  @property
  def label(self) -> str:
    return f"{self.distribution} {self.version}"


PEERS = {"playground020": Peer(Path(__file__).parent / "playground020.py", "playground", "0.2.0")}


def check_peer(peer: str, python: str, path: str, menagerie: str) -> None:
  """Checks that the peer's interpreter has the package, and that its robots exist.

  Args:
    peer: one of `PEERS`.
    python: interpreter of the peer's environment.
    path: PYTHONPATH of that interpreter.
    menagerie: folder of robot models, one folder each; empty if the package downloads them.

  Raises:
    UnknownNameError: the peer does not exist.
    ConfigError: the interpreter does not exist or lacks the package, or the folder holds no robot.
  """
  if peer not in PEERS:
    raise UnknownNameError(f"peer={peer} does not exist: choose from {', '.join(PEERS)}.{nearest(peer, PEERS)}")
  if menagerie and not any(Path(menagerie).glob("*/*.xml")):
    raise ConfigError(f"peer_menagerie={menagerie} holds no robot models: name the folder of unitree_go1 and others.")
  _, distribution, version = PEERS[peer]
  ask = f"import importlib.metadata as m; print(m.version({distribution!r}))"
  env = {**os.environ, "PYTHONPATH": path}
  try:
    done = subprocess.run([python, "-c", ask], capture_output=True, text=True, env=env)
  except OSError as error:
    raise ConfigError(f"peer_python={python} cannot be run: {error.strerror}.") from None
  if done.returncode or done.stdout.strip() != version:
    found = f"it has {done.stdout.strip()}" if done.returncode == 0 else "it has none"
    raise ConfigError(
      f"{distribution} {version} is not installed for peer_python={python} (peer_path={path or 'none'}), {found}: "
      "install it there, or name the interpreter of an environment that has it."
    )
