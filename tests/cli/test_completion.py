"""Completion: what a command line can become, and the script of bash."""

import shutil
import subprocess

import pytest

from playground.cli.completion import SHELLS, script
from playground.cli.main import main
from tests.command import Command, caller


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Command:
  return caller(monkeypatch, "playground", main)


@pytest.mark.parametrize(
  ("line", "some"),
  [
    ("playground ", ["train", "list", "view", "completion"]),
    ("playground li", ["list"]),
    ("playground show Go1Ge", ["Go1Getup"]),
    ("playground list --su", ["--suite"]),
    ("playground view CartpoleBalance --agent ", ["random", "zero"]),
    ("playground sweep ", ["collect", "retry", "status", "stop"]),
    ("playground keys agent.net", ["agent.network."]),
    ("playground view Go1Getup robot=g", ["robot=g1", "robot=go1"]),
    ("playground show Go1Getup env.rewards.upr", ["env.rewards.upright_exp."]),
    ("playground train env=Cartpole", ["env=CartpoleBalance", "env=CartpoleSwingup"]),
    ("/usr/bin/playground-run experiment=go1_j", ["experiment=go1_joystick", "experiment=go1_joystick_chain"]),
    ("playground-run --ver", ["--verbose", "--version"]),
    ("playground-run age", ["agent.", "agent="]),
    ("playground-run -m agent=ppo,s", ["agent=ppo,sac"]),
    ("playground-run agent=sac agent.num_e", ["agent.num_envs=", "agent.num_eval_envs="]),
    ("playground-run env=Go1Getup env.rewards.upr", ["env.rewards.upright_exp."]),
    ("playground-run -m env=Go1Getup,CartpoleBalance seed=1,2 env.rewards.upr", ["env.rewards.upright_exp."]),
    ("playground-run env.impl=", ["env.impl=auto", "env.impl=jax", "env.impl=warp"]),
    ("playground-run video.enable=", ["video.enable=false", "video.enable=true"]),
  ],
)
def test_candidates(command: Command, capsys: pytest.CaptureFixture[str], line: str, some: list[str]):
  assert command("completion", "query", line) == 0
  found = capsys.readouterr().out.split()
  assert set(some) <= set(found)
  assert all(word.startswith(line.split()[-1]) for word in found) or line.endswith(" ")


@pytest.mark.parametrize(
  "line",
  [
    *("", "playground", "'\"", "playground-bench ", "playground-run 'env=", "playground nothing ", "ls "),
    *("playground show Go1Getup env.swing", "playground-run agent.na", "playground-run agent.num_envs.x.y"),
    "playground-run agent.network.policy_hidden_layer_sizes.x.y",
  ],
)
def test_nothing_to_complete(command: Command, capsys: pytest.CaptureFixture[str], line: str):
  assert command("completion", "query", line) == 0
  assert not capsys.readouterr().out.strip()


@pytest.mark.parametrize("shell", SHELLS)
def test_a_script_names_our_programs(command: Command, capsys: pytest.CaptureFixture[str], shell: str):
  assert command("completion", shell) == 0
  out = capsys.readouterr().out
  assert out == script(shell) and "playground playground-run" in out
  if shutil.which(shell):
    subprocess.run([shell, "-n"], input=out, text=True, check=True)


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash")
def test_bash_completes_behind_an_equals_sign():
  """Bash takes `=` for the end of a word, so the candidates must begin behind it."""
  asked = "playground() { printf 'env=CartpoleBalance\\nenv=CartpoleSwingup\\n'; }"
  ask = "COMP_LINE='playground-run env=Cart' COMP_POINT=23; _playground; echo ${COMPREPLY[@]}"
  text = f"{script('bash')}\n{asked}\n{ask}"
  done = subprocess.run(["bash", "-c", text], capture_output=True, text=True, check=True)
  assert done.stdout == "CartpoleBalance CartpoleSwingup\n"
