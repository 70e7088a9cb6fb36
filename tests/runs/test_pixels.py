"""A whole run from pixels on the CPU: Warp's images, a CNN, evaluation, checkpoints."""

import json
from pathlib import Path

import pandas as pd
import pytest

from playground.cli.eval import evaluate_run
from playground.config import compose
from playground.errors import ConfigError
from playground.runs.callbacks import RunCallbacks
from playground.runs.run_dir import RunDirectory
from playground.runs.train import train

SIZE = ["env.vision.width=16", "env.vision.height=16"]
RUN = ["env=CartpoleBalanceVision", "debug=fast", "hardware=cpu", "tracking=csv", "agent.num_evals=3", *SIZE]


@pytest.mark.slow
def test_a_resumed_run_ends_as_if_it_had_never_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  whole, run = tmp_path / "whole", tmp_path / "run"
  assert train(compose([*RUN, f"run_dir={whole}"])) == 0
  with monkeypatch.context() as patch:
    patch.setattr(RunCallbacks, "should_stop", lambda job: job._step >= 160)
    train(compose([*RUN, f"run_dir={run}"]))
  assert RunDirectory(run).status["status"] == "preempted"
  assert train(compose([f"resume={run}"])) == 0
  ours, theirs = RunDirectory(run).summary, RunDirectory(whole).summary
  assert {ours[key] == theirs[key] for key in ("params_sha256", "final_return", "steps")} == {True}
  ours, theirs = (pd.read_csv(path / "metrics.csv").filter(regex="^(?!time/)") for path in (run, whole))
  pd.testing.assert_frame_equal(ours, theirs, check_like=True, check_exact=True)

  assert evaluate_run(str(run), deterministic=True) == 0
  (report,) = (run / "eval").iterdir()
  scores = json.loads(report.read_text())["scores"]
  assert scores["episode_length"] == 20 and 1.5 < scores["episode_reward"] < 2


def test_mistakes_are_said_before_anything_is_made(tmp_path: Path) -> None:
  run = f"run_dir={tmp_path / 'run'}"
  with pytest.raises(ConfigError, match=r"env.vision.camera=fix is no camera.*Did you mean 'fixed'"):
    train(compose([*RUN, run, "env.vision.camera=fix"]))
  with pytest.raises(ConfigError, match="agent=sac reads no images"):
    train(compose(["env=CartpoleBalanceVision", "debug=fast", "hardware=cpu", "agent=sac", run]))
  assert not (tmp_path / "run").exists()
