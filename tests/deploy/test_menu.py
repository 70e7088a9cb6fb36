"""The checkpoints to choose from: those of all stages of a chain whose policies can take each other's place."""

from pathlib import Path

import pytest

from playground.cli.main import main
from playground.deploy.session import Session
from playground.deploy.web import server
from tests.command import caller
from tests.deploy.untrained import UntrainedRun

FAST = ("CartpoleBalance", "debug=fast", "env.episode_length=40")


@pytest.fixture(scope="module")
def chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """Stages that fit, and two that do not."""
  chain = tmp_path_factory.mktemp("menu") / "chain"
  UntrainedRun(chain / "1_swinging", "AcrobotSwingup", "debug=fast").save(10)
  UntrainedRun(chain / "2_relu", *FAST, "agent.network.activation=relu").save(20)
  UntrainedRun(chain / "9_near", *FAST, "env.episode_length=20").save(1000, 2000, episode_return=5.0)
  UntrainedRun(chain / "10_far", *FAST).save(500, episode_return=1.0)
  UntrainedRun(chain / "11_next", *FAST)
  (chain / "config.yaml").touch()
  return chain


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[Session]:
  """Sessions that the command would let somebody watch."""
  sessions: list[Session] = []
  monkeypatch.setattr(server, "watch", lambda session, *rest: sessions.append(session))
  return sessions


def test_a_chain(
  chain: Path, shown: list[Session], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  command = caller(monkeypatch, "playground", main)
  assert command("play", str(chain), "--web", "--port", "0") == 0
  (session,) = shown
  assert list(session.choices()) == ["latest", "best (far 500)", "near 1,000", "near 2,000", "far 500"]
  first, second = capsys.readouterr().out.splitlines()
  assert first.startswith("Stage 1_swinging is left out: ") and "does not fit this run: .params.policy" in first
  assert second == "Stage 2_relu is left out: agent.network is not that of 10_far."

  origin = lambda: session.player.exported.contract["origin"]
  assert (session.acting, origin()["run"], origin()["steps"]) == ("far 500", "10_far", 500)
  session.choose_checkpoint(session.choices()["near 1,000"])
  assert (session.acting, origin()["run"], origin()["steps"]) == ("near 1,000", "9_near", 1000)
  session.player.policy_step()
  session.choose_checkpoint("best")
  session.follow()
  assert session.acting == "far 500"

  session.choose_checkpoint("latest")
  (chain / "11_next" / "checkpoints" / "000000000100.orbax-checkpoint-tmp").mkdir(parents=True)  # about to be one
  session.follow()
  assert session.acting == "far 500"
  UntrainedRun(chain / "12_after", *FAST).save(100)
  session.follow()
  assert session.acting == "after 100" and list(session.choices())[-1] == "after 100"
  assert capsys.readouterr().out == "", "each is said once"


def test_a_stage_alone(chain: Path, shown: list[Session], monkeypatch: pytest.MonkeyPatch) -> None:
  command = caller(monkeypatch, "playground", main)
  assert command("play", str(chain / "9_near"), "--web", "--port", "0") == 0
  assert list(shown[0].choices()) == ["latest", "best (2,000)", "1,000", "2,000"]
  assert command("play", str(chain / "9_near/checkpoints/best"), "--web", "--port", "0") == 0
  assert (shown[1].following, shown[1].acting) == (None, "2,000")


def test_stages_with_other_noise_stay(
  tmp_path: Path, shown: list[Session], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  task, state = ("Go1JoystickFlatTerrain", "debug=fast"), "env.observations.state"
  UntrainedRun(tmp_path / "1_scaled", *task, f"{state}.joint_vel.scale=2.0").save(1)
  UntrainedRun(tmp_path / "2_noisy", *task, f"{state}.joint_vel.noise.uniform=3.0").save(2)
  UntrainedRun(tmp_path / "3_quiet", *task).save(3)
  (tmp_path / "config.yaml").touch()
  assert caller(monkeypatch, "playground", main)("play", str(tmp_path), "--web", "--port", "0") == 0
  assert list(shown[0].choices()) == ["latest", "noisy 2", "quiet 3"]
  assert capsys.readouterr().out == "Stage 1_scaled is left out: env.observations is not that of 3_quiet.\n"
