"""`playground pretrained`: a run's policy becomes one that comes with the package."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from playground import pretrained
from playground.cli.pretrained import add_policy, show_policies
from playground.config import compose
from playground.errors import ConfigError
from playground.learning.checkpoints import Checkpoint
from playground.runs.restore_plan import weights_of
from playground.runs.train import train
from tests.runs.helpers import TASK


def test_a_run_becomes_a_pretrained_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  pytest.importorskip("onnxruntime")
  monkeypatch.setattr(pretrained, "POLICIES", tmp_path / "policies")
  monkeypatch.chdir(tmp_path)
  run = tmp_path / "run"
  assert train(compose([*TASK, "agent.num_timesteps=320", "agent.num_evals=2", f"run_dir={run}"])) == 0
  assert add_policy(str(run), "cut short") == 0
  (folder,) = (tmp_path / "policies").iterdir()
  card = yaml.safe_load((folder / "card.yaml").read_text())
  checkpoint = weights_of(f"pretrained:{folder.name}")
  assert (card["task"], card["steps"], card["c_mujoco"]["episodes"]) == (folder.name, checkpoint.step, 20)
  assert (card["status"], card["note"]) == ("open", "cut short")
  assert card["training"]["sampled"] > 0 and card["training"]["mode"] > 0 and card["training"]["steps"] == card["steps"]
  assert not checkpoint.has("state")
  exact, shipped = Checkpoint(run / "checkpoints" / checkpoint.path.name).arrays("policy"), checkpoint.arrays("policy")
  for (name, *_), before, after in zip(checkpoint.meta["leaves"]["policy"], exact, shipped, strict=True):
    rtol = 2.0**-pretrained.CRITIC_BITS if name.startswith(".params.value") else 0
    np.testing.assert_allclose(after, before, rtol=rtol, err_msg=name)
  texts = [path.read_text() for name in ("*.yaml", "*.json", "*.txt", "metadata") for path in folder.rglob(name)]
  assert len(texts) >= 6 and str(tmp_path) not in "".join(texts), "paths of this machine"
  console = Console(record=True, width=120)
  assert show_policies(console) == 0
  assert f"{card['c_mujoco']['return']:.1f} ±" in console.export_text()

  header, *rows = (metrics := run / "metrics.csv").read_text().splitlines(keepends=True)
  metrics.write_text("".join([header, *(row for row in rows if row.startswith("0,"))]))  # stopped before the next one
  with pytest.raises(ConfigError, match=rf"There is a policy of {folder.name} already: ppo, .* --replace replaces it"):
    add_policy(str(run))
  assert add_policy(str(run), replace=True) == 0
  assert yaml.safe_load((folder / "card.yaml").read_text())["training"]["steps"] == 0
  metrics.write_text(header)
  with pytest.raises(ConfigError, match="was not evaluated before its newest checkpoint"):
    add_policy(str(run), replace=True)
