"""`playground pretrained`: the policies that come with the package, and how one is added."""

from rich.console import Console
from rich.table import Table

from playground.cli.play import play
from playground.deploy.export import export_run
from playground.errors import ConfigError
from playground.files import read_json
from playground.learning.checkpoints import find_checkpoints
from playground.pretrained import add, cards
from playground.runs.csv_tracker import read_metrics
from playground.runs.run_dir import RunDirectory
from playground.settings import Plain

_EPISODES = 20  # in C MuJoCo


def show_policies(console: Console | None = None) -> int:
  """Prints a table of the cards; returns the exit code, 0."""
  table = Table("task", "agent", "steps", "return", "in C MuJoCo", "falls", title="Pretrained policies")
  table.columns[0].no_wrap = True
  for task, card in cards().items():
    trained, plain = card["training"], card["c_mujoco"]
    said = f"{trained['return']:.1f} ({trained['action']})"
    table.add_row(
      task, card["agent"], f"{card['steps']:,}", said, _interval(plain), f"{plain['falls']} of {plain['episodes']}"
    )
  (console or Console()).print(table)
  return 0


def add_policy(path: str) -> int:
  """Exports a run's newest policy, measures it in C MuJoCo and copies it, with its card, into the package.

  Args:
    path: a run directory.

  Returns:
    The exit code, 0.

  Raises:
    PlaygroundError: no such run, or a policy that cannot be exported.
    ConfigError: it has no evaluation at its newest checkpoint.
  """
  run = RunDirectory.open(path)
  export_run(path)
  steps = int(find_checkpoints(path)[0].name)
  result = run.path / f"export/play_step_{steps:012d}_seed_0.json"
  if read_json(result).get("episodes") != _EPISODES:
    play(path, episodes=_EPISODES)
  scores = read_json(result)["scores"]
  rows = read_metrics(run.metrics_csv)
  evaluated = rows[(rows["step"] == steps) & rows["eval/episode_reward"].notna()]
  if evaluated.empty:
    raise ConfigError(f"{path} was not evaluated at its newest checkpoint, step {steps}.")
  config, manifest, row = run.config, run.manifest, evaluated.iloc[-1]
  git: dict[str, Plain] = manifest.get("git") or {}
  facts = {
    "task": config["choices"]["env"],
    "agent": config["choices"]["agent"],
    "steps": steps,
    "seed": config["seed"],
    "command": " ".join(["playground-run", *(o for o in run.overrides if not o.startswith("run_dir="))]),
    "commit": git.get("commit"),
    "versions": {name: manifest["versions"][name] for name in ("jax", "mujoco", "mujoco-mjx", "warp-lang")},
    "device": manifest["device"],
    "date": manifest["created"][:10],
    "wall_clock_s": round(float(row["time/wall_clock_s"]), 1),
    "training": {
      "action": "mode" if config["agent"]["deterministic_eval"] else "sampled",
      "return": round(float(row["eval/episode_reward"]), 2),
      "episodes": config["agent"]["num_eval_envs"],
    },
    "c_mujoco": {
      "action": "mode",
      "return": round(scores["episode_reward"], 2),
      "return_std": round(scores["episode_reward_std"], 2),
      "episodes": _EPISODES,
      "falls": round(scores.get("episode_fall", 0.0) * _EPISODES),
    },
  }
  folder = add(run.path, facts["task"], facts)
  size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
  print(f"{folder}: {size / 1e6:.1f} MB")
  return 0


def _interval(measured: dict[str, Plain]) -> str:
  return f"{measured['return']:.1f} ± {measured['return_std']:.1f}"
