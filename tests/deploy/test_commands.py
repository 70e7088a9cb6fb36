"""`playground export` and `playground play` on a checkpoint of an untrained policy."""

import json
import re
import shutil
import signal
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from playground.cli import eval as eval_command
from playground.cli import play
from playground.cli.main import main
from playground.deploy import export
from playground.deploy.policy import ExportedPolicy
from playground.deploy.web.server import Watch
from playground.errors import CheckpointError, ConfigError
from tests.command import Command, caller
from tests.deploy.untrained import UntrainedRun, free_port

STEPS = 3000


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
  """A run's directory as training leaves it."""
  path = tmp_path_factory.mktemp("deploy") / "run"
  run = UntrainedRun(path, "CartpoleBalance", "debug=fast", "env.episode_length=40")
  run.directory.update_manifest(git={"commit": "abc", "dirty": False}, impl="warp")
  run.directory.metrics_csv.write_text(
    "step,eval/episode_reward,eval/episode_length,eval/mode/episode_reward\n"
    "0,1.0,40,1.5\n2000,12.5,40,13.5\n2500,,,\n4000,30.0,40,31\n"
  )
  run.save(STEPS)
  return path


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  return caller(monkeypatch, "playground", main)


def test_play_with_other_values_of_the_task(
  command: Command, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  run = shutil.copytree(run, tmp_path / "run")
  assert command("export", str(run)) == 0
  scores = []
  for policy in (run, run / "export" / "policy.onnx"):
    assert command("play", str(policy), "--episodes", "2", "env.episode_length=30") == 0
    assert "trained, with env.episode_length=30" in " ".join(capsys.readouterr().out.split())
    (file,) = (run / "export").glob(f"play_step_{STEPS:012d}_seed_0_episodes_2_*.json")
    report = json.loads(file.read_text())
    assert (report["overrides"], report["scores"]["episode_length"]) == (["env.episode_length=30"], 30)
    scores.append(report["scores"])
  assert scores[0] == scores[1]
  assert command("play", str(run), "--episodes", "1", "randomization=none") == 0
  assert "only events of mode reset act; --randomize draws it" in capsys.readouterr().out
  for wrong in ("agent.num_envs=2", "env=CheetahRun", "env.episode_lenght=3", "env.episode_length=0"):
    assert command("play", str(run), wrong) == 2
    assert wrong.partition("=")[0] in capsys.readouterr().err


def test_export_then_play(command: Command, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
  assert command("export", str(run)) == 0
  out = " ".join(capsys.readouterr().out.split())
  difference = re.search(r"same actions on 1000 observations .* largest difference (\S+)", out)
  assert difference and float(difference[1]) <= 1e-5
  assert re.search(r"\d+ µs \(median\).* of the 10,000 µs of a step at 100 Hz", out)
  contract = yaml.safe_load((run / "export" / "policy.yaml").read_text())
  origin = {"run": "run", "agent": "ppo", "steps": STEPS, "commit": "abc", "dirty": False, "impl": "warp"}
  assert origin.items() <= contract["origin"].items()
  evaluation = {"steps": 2000, "episode_reward": 12.5, "episode_length": 40, "mode/episode_reward": 13.5}
  assert contract["origin"]["evaluation"] == evaluation

  scores = []
  for policy in (run, run / "export" / "policy.onnx", run / "export"):
    assert command("play", str(policy), "--episodes", "3", "--seed", "4") == 0
    shown = " ".join(capsys.readouterr().out.split())
    report = json.loads((run / "export" / f"play_step_{STEPS:012d}_seed_4_episodes_3.json").read_text())
    assert (report["simulator"], report["episodes"]) == ("C MuJoCo", 3)
    scores.append(report["scores"])
    assert re.search(r"C MuJoCo\W+training, mode\W+training, sampled", shown)
    assert "Training: MJX-Warp at 2,000 steps" in shown
    assert re.search(rf"reward\W+{scores[-1]['episode_reward']:.4g}\W+13.5\W+12.5\b", shown)
  assert scores[0] == scores[1] == scores[2]
  assert command("play", str(run), "--episodes", "3", "--seed", "4", "--no-events") == 0
  report = json.loads((run / "export" / f"play_step_{STEPS:012d}_seed_4_episodes_3_no_events.json").read_text())
  assert not report["interval_events"] and report["scores"] == scores[0], "Cartpole has no interval events"
  assert 0 < scores[0]["episode_reward"] < 40 == scores[0]["episode_length"]
  assert command("play", str(run), "--episodes", "1", "--seed", "4") == 0
  report = json.loads((run / "export" / f"play_step_{STEPS:012d}_seed_4_episodes_3.json").read_text())
  assert report["episodes"] == 3, "fewer episodes do not replace more"


def test_play_on_randomised_models(
  command: Command, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  run = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("export"))
  assert command("play", str(run), "--randomize") == 2
  assert "CartpoleBalance has no events of mode startup here" in capsys.readouterr().err
  params = "{field: body_mass, target: all, operation: scale, range: [0.1, 10]}"
  event = f"+env.events.masses={{mode: startup, func: model_field, params: {params}}}"
  drawn: list[Any] = []
  measure = play.measure
  monkeypatch.setattr(play, "measure", lambda *args: (drawn.append(args[-1]), measure(*args))[1])
  films: list[Any] = []
  monkeypatch.setattr(eval_command, "render_video", lambda model, **_: films.append(model))
  assert command("play", str(run), "--episodes", "3", "--randomize", "--video", str(tmp_path / "a.mp4"), event) == 0
  assert "mean of 3 episodes, randomised models" in " ".join(capsys.readouterr().out.split())
  (masses,) = (np.asarray(models["body_mass"]) for models in drawn)
  assert len(np.unique(masses[:, 1])) == 3
  np.testing.assert_allclose(films[0].body_mass, masses[0], rtol=1e-6)
  (file,) = (run / "export").glob("play_*_randomized*.json")
  assert json.loads(file.read_text())["randomized"] is True
  assert command("play", str(run), "--episodes", "3", event) == 0
  other = json.loads(next((run / "export").glob("play_*_episodes_3_[!r]*.json")).read_text())
  assert "randomized" not in other and other["scores"] != json.loads(file.read_text())["scores"]


@pytest.mark.slow
def test_a_policy_that_sees(command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
  seeing = ["env.vision.enable=true", "env.vision.camera=fixed", "env.vision.width=20", "env.vision.height=16"]
  settings = ["debug=fast", "env.episode_length=10", "agent.network.policy_obs_key=state", *seeing]
  UntrainedRun(tmp_path / "run", "CartpoleBalance", *settings, scale=0.1).save(STEPS)
  assert command("export", str(tmp_path / "run"), "--out", str(tmp_path)) == 0
  out = " ".join(capsys.readouterr().out.split())
  assert "images of 16 x 20 x 3 and 5 numbers in, 1 out" in out and "same actions on 1000 observations" in out
  contract = yaml.safe_load((tmp_path / "policy.yaml").read_text())
  assert [(row["name"], row["entry"]) for row in contract["policy"]["inputs"]] == [
    ("pixels_fixed", "pixels/fixed"), ("obs", "state"),
  ]  # fmt: skip
  obs = {"pixels/fixed": np.zeros((2, 16, 20, 3), np.uint8), "state": np.zeros((2, 5))}
  obs["pixels/fixed"][1] = 255
  dark, bright = ExportedPolicy.load(tmp_path / "policy.onnx").actions(obs)
  assert np.abs(dark - bright) > 0.01
  assert command("play", str(tmp_path / "policy.onnx"), "--episodes", "2") == 0
  scores = json.loads((tmp_path / f"play_step_{STEPS:012d}_seed_0_episodes_2.json").read_text())["scores"]
  assert 0 < scores["episode_reward"] < 10 == scores["episode_length"]


def test_a_policy_that_acts_otherwise_is_not_written(
  command: Command, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  truly = ExportedPolicy.actions
  monkeypatch.setattr(ExportedPolicy, "actions", lambda self, obs: truly(self, obs) + np.float32(1e-3))
  assert command("export", str(run), "--out", str(tmp_path / "out")) == 2
  assert "differ by 1.0e-03, more than 1e-05: nothing is written" in capsys.readouterr().err
  assert not (tmp_path / "out").exists()


def test_a_run_that_cannot_be_written_to_is_said_before_anything_is_traced(
  command: Command, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  copied = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("export"))
  (copied / "export").touch()
  monkeypatch.setattr("playground.deploy.export.record", pytest.fail)
  assert command("export", str(copied)) == 2
  assert f"error: {copied / 'export'} cannot be written:" in capsys.readouterr().err
  monkeypatch.undo()
  assert command("play", str(copied), "--episodes", "1") == 0
  assert f"not written: {copied / 'export'} is not a folder" in capsys.readouterr().out


def test_a_link_out_of_a_run_is_not_followed(
  run: Path, tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
  copied = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("export", "eval"))
  (tmp_path / "outside").mkdir()
  for name in ("export", "eval"):
    (copied / name).symlink_to(tmp_path / "outside")
  assert command("export", str(copied)) == 2
  leads_out = f"is a link that leads out of {copied}"
  assert f"{copied / 'export'} cannot be written: {copied / 'export'} {leads_out}" in capsys.readouterr().err
  for name, folder in (("play", "export"), ("eval", "eval")):
    assert command(name, str(copied), "--episodes", "1") == 0
    assert f"not written: {copied / folder} {leads_out}" in capsys.readouterr().out
  assert not any((tmp_path / "outside").iterdir())
  (tmp_path / "link").symlink_to(copied)  # of the user, to the whole run
  (copied / "export").unlink()
  assert command("play", str(tmp_path / "link"), "--episodes", "1") == 0
  assert "written to" in capsys.readouterr().out and any((copied / "export").iterdir())


def test_a_score_that_is_no_number_is_left_out(run: Path, tmp_path: Path, command: Command) -> None:
  copied = shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("export"))
  (copied / "metrics.csv").write_text("step,eval/episode_reward,eval/episode_success\n2000,12.5,nan\n")
  assert command("export", str(copied)) == 0
  origin = ExportedPolicy.load(copied / "export" / "policy.onnx").contract["origin"]
  assert origin["evaluation"] == {"steps": 2000, "episode_reward": 12.5}


def test_a_damaged_policy_and_one_of_another_task(
  command: Command, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
  assert command("export", str(run), "--out", str(tmp_path)) == 0
  model, contract = (tmp_path / "policy.onnx").read_bytes(), (tmp_path / "policy.yaml").read_text()
  capsys.readouterr()
  for content, told, said in [
    (b"", contract, "is no model that ONNX Runtime can read"),
    (model[:-9], contract, "is no model that ONNX Runtime can read"),
    (model, contract.replace("shape: [1, 5]", "shape: [1, 6]"), "'continuous_actions': [1, 1]} instead of {'obs'"),
    (model, contract.replace("action_size: 1", "action_size: 2"), "has other inputs or outputs than its contract"),
  ]:
    (tmp_path / "policy.onnx").write_bytes(content)
    (tmp_path / "policy.yaml").write_text(told)
    assert command("play", str(tmp_path / "policy.onnx")) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: {tmp_path / 'policy.onnx'}: The policy ") and said in line
  assert command("export", str(run), "--out", str(tmp_path)) == 0, "the same task's, whatever state it is in"
  told = contract.replace("task: CartpoleBalance\n", "task: CheetahRun\n")
  (tmp_path / "policy.yaml").write_text(told)
  assert command("export", str(run), "--out", str(tmp_path)) == 2
  assert "holds a policy of CheetahRun, not of CartpoleBalance" in capsys.readouterr().err
  assert (tmp_path / "policy.yaml").read_text() == told


def test_files_of_two_exports_are_refused(
  command: Command, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  other, out = tmp_path / "other", tmp_path / "out"
  UntrainedRun(other, "CartpoleBalance", "debug=fast", "env.episode_length=40", scale=0.5).save(STEPS)
  policy, contract = out / "policy.onnx", out / "policy.yaml"
  assert command("export", str(other), "--out", str(out)) == 0
  told = yaml.safe_load(contract.read_text())
  del told["policy"]["sha256"]
  contract.write_text(yaml.safe_dump(told))
  old = policy.read_bytes()
  ExportedPolicy.load(policy)  # as exported before there was a hash
  with monkeypatch.context() as patch:
    patch.setattr(export, "replacing", lambda path: signal.raise_signal(signal.SIGINT))
    assert command("export", str(run), "--out", str(out)) == 130
  assert policy.read_bytes() == old, "the contract comes first"
  capsys.readouterr()
  assert command("play", str(policy)) == 2
  sentence = f"{policy}: The policy and its contract are not of one export (sha256): export the run again."
  assert capsys.readouterr().err == f"error: {sentence}\n"
  assert command("export", str(run), "--out", str(out)) == 0
  ExportedPolicy.load(policy)

  def read_text(path: Path, **options: Any) -> str:
    """An export that comes to its end while a policy is read."""
    policy.write_bytes(new)
    return truly(path, **options)

  truly, new = Path.read_text, policy.read_bytes()
  monkeypatch.setattr(Path, "read_text", read_text)
  policy.write_bytes(old)
  with pytest.raises(CheckpointError, match="not of one export"):
    ExportedPolicy.load(policy)


def test_a_display_that_is_not_there(
  command: Command, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
  monkeypatch.setenv("DISPLAY", ":4242")
  assert command("play", str(run), "--viewer") == 2
  assert "--viewer cannot open a window on the display :4242" in capsys.readouterr().err


def test_a_video_by_the_camera_that_is_named(
  command: Command, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  filmed: list[Any] = []
  film = lambda model, **view: filmed.append((view["out_path"], view["camera"]))
  monkeypatch.setattr(eval_command, "render_video", film)
  monkeypatch.setenv("HOME", str(tmp_path))
  video = ["--episodes", "1", "--video=~/new/a.mp4"]
  assert command("play", str(run), *video, "--camera", "lookatcart") == 0
  assert f"rendering {filmed[0][0]}\n" in capsys.readouterr().out
  assert command("play", str(run), *video) == 0
  config = shutil.copytree(run, tmp_path / "run") / "config.yaml"
  config.write_text(re.sub(r"^  camera: null$", "  camera: fixed", config.read_text(), flags=re.MULTILINE))
  assert command("play", str(config.parent), *video) == 0
  assert filmed == [(tmp_path / "new" / "a.mp4", camera) for camera in ("lookatcart", None, "fixed")]
  monkeypatch.setattr(play, "make_evaluator", pytest.fail)
  capsys.readouterr()
  assert command("play", str(run), *video, "--camera", "lookat_cart") == 2
  assert capsys.readouterr().err == (
    "error: --camera=lookat_cart is no camera of the model; it has fixed, lookatcart. Did you mean 'lookatcart'?\n"
  )


def test_a_video_or_a_window(command: Command, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
  for shown in ("--web", "--viewer"):
    assert command("play", str(run), "--video", "a.mp4", shown) == 2
    assert f"{shown}: not allowed with argument --video" in capsys.readouterr().err


def test_ctrl_c_is_no_traceback(
  command: Command, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  def interrupted(*_: object) -> None:
    signal.raise_signal(signal.SIGINT)

  monkeypatch.setattr(play, "open_policy", interrupted)
  assert command("play", str(run)) == 130
  assert capsys.readouterr().err == ""


def test_play_in_the_browser(
  command: Command, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  watched: list[Watch] = []
  truly = Watch.frame

  def frame(watch: Watch) -> None:
    truly(watch)
    watched.append(watch)
    if len(watched) == 20:
      signal.raise_signal(signal.SIGINT)

  monkeypatch.setattr(Watch, "frame", frame)
  port = free_port()
  assert command("play", str(run / "checkpoints" / f"{STEPS:012d}"), "--web", "--port", str(port)) == 0
  assert f"http://127.0.0.1:{port}" in capsys.readouterr().out
  session, panel = watched[0].session, watched[0].panel
  assert session.player.seconds > 0 and not session.following and panel.checkpoint.value == f"{STEPS:,}"
  assert session.terrain is None and panel.command == []  # which this task has not
  before = np.array(session.player.state.data.qvel)
  session.player.push(2.0)
  np.testing.assert_allclose(
    np.abs(session.player.state.data.qvel - before), [2, 0], atol=1e-6
  )  # the cart, not the pole
  socket.create_server(("127.0.0.1", port)).close()  # it is free again


def test_one_sentence_each(
  command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
  for name in ("DISPLAY", "WAYLAND_DISPLAY"):
    monkeypatch.delenv(name, raising=False)
  for name in ("policy", "other", "cut"):
    (tmp_path / f"{name}.onnx").touch()
  (tmp_path / "other.yaml").write_text("format: something else")
  (tmp_path / "cut.yaml").write_text("format: playground-policy/3\ntask: CartpoleBalance\n")
  for args, said in [
    (["play", str(tmp_path / "policy.onnx")], "policy.yaml does not exist"),
    (["play", str(tmp_path / "other.onnx")], "other.yaml is not a policy's contract"),
    (["play", str(tmp_path / "cut.onnx")], "cut.yaml is not a policy's contract"),
    (["play", str(tmp_path / "none")], "does not exist: give a run directory"),
    (["play", str(tmp_path), "--episodes", "0"], "--episodes=0 must be a whole number from 1"),
    (["play", str(tmp_path), "--seed", "-1", "--web"], "--seed=-1 must be a whole number from 0 to 4294967295"),
    (["eval", str(tmp_path), "--seed", "99999999999999999999"], "must be a whole number from 0 to 4294967295"),
    (["eval", str(tmp_path), "--episodes", "9999999999"], "--episodes=9999999999 must be a whole number from 1 to"),
    (["play", str(tmp_path), "--port", "99999"], "--port=99999 must be a whole number from 0 to 65535"),
    (["eval", "a" * 300], "File name too long"),
    (["sweep", "status", "a" * 300], "File name too long"),
    (["export", str(tmp_path), "--out", "/proc/nowhere/at/all"], "cannot be written"),
    (["play", str(tmp_path), "--video", "a.gif"], "--video=a.gif must be a file that ends in .mp4"),
    (["play", str(tmp_path), "--video", str(tmp_path / "cut.yaml" / "a.mp4")], "cut.yaml is not a folder"),
    (["play", str(tmp_path), "--camera", "fixed"], "--camera=fixed needs --video=<file>"),
    (["play", str(tmp_path), "--viewer"], "--viewer needs a display"),
    (["export", str(tmp_path)], "holds no checkpoint"),
    (["export", str(tmp_path), "--out", str(tmp_path / "cut.yaml")], "cut.yaml is not a folder"),
    (["eval", str(tmp_path), "--video", "a"], "--video=a must be a file that ends in .mp4"),
  ]:
    assert command(*args) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and said in line


def test_observations_that_do_not_fit_a_policy(
  command: Command, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
  assert command("export", str(run), "--out", str(tmp_path)) == 0
  policy = ExportedPolicy.load(tmp_path / "policy.onnx")
  with pytest.raises(ConfigError, match=re.escape("The policy reads state of the shape [..., 5], not [2, 4].")):
    policy.actions(np.zeros((2, 4)))
  with pytest.raises(ConfigError, match=r"The observation lacks state, which the policy reads: it has other\."):
    policy.actions({"other": np.zeros(5)})
  capsys.readouterr()
  monkeypatch.chdir(tmp_path)
  term = "env.observations.state.gravity=null"
  assert command("eval", "pretrained:Go1JoystickFlatTerrain", term) == 2
  sentence = f"{term} does not fit the policy, which was trained with other env.observations: leave it as it was."
  assert capsys.readouterr().err == f"error: {sentence}\n"
