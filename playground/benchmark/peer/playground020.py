"""Drives the public package `playground` 0.2.0, in its own environment: `python playground020.py <json>`.

Imports no module of this package. Prints one line, `RESULT <json>`. The public package is older than current JAX and
MuJoCo, so the driver first restores a few names that JAX and MuJoCo have removed.
"""

import functools
import importlib
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

SIZES = ("num_envs", "batch_size", "num_minibatches", "grad_updates_per_step")
Settings = dict[str, Any]  # arguments of Brax's trainers
EVALUATION = ("num_evals", "num_resets_per_eval", "num_eval_envs")


def put_back_names() -> None:
  """Restores names that the package calls and that JAX and MuJoCo have removed."""
  if not hasattr(jax, "device_put_replicated"):
    jax.device_put_replicated = replicate  # Brax's trainer
  clip = jnp.clip

  @functools.wraps(clip)
  def with_old_bounds(*args: Any, a_min: Any = None, a_max: Any = None, **kwargs: Any) -> jax.Array:
    bounds = {name: bound for name, bound in (("min", a_min), ("max", a_max)) if bound is not None}
    return clip(*args, **kwargs, **bounds)

  jnp.clip = with_old_bounds
  if not hasattr(mujoco.MjSpec, "find_body"):
    mujoco.MjSpec.find_body = lambda spec, name: spec.body(name)


def replicate(tree: object, devices: Sequence[object]) -> object:
  """Returns a copy of every array on each device, stacked on a leading axis as pmap expects."""
  mesh = jax.sharding.Mesh(np.asarray(devices), ("device",))
  sharding = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("device"))
  spread = lambda leaf: jax.device_put(jnp.broadcast_to(leaf, (len(devices), *jnp.shape(leaf))), sharding)
  return jax.tree.map(spread, tree)


def use_menagerie(folder: str) -> None:
  """Makes the package read robot models from a folder instead of downloading them."""
  import mujoco_playground._src.mjx_env as mjx_env  # pyright: ignore[reportMissingImports]
  from etils import epath

  mjx_env.MENAGERIE_PATH = epath.Path(folder)


def tuned(task: str, backend: str, agent: str) -> Settings:
  """Returns the package's own settings for a task; for SAC only DM Control has settings."""
  from mujoco_playground import dm_control_suite, locomotion  # pyright: ignore[reportMissingImports]
  from mujoco_playground.config import dm_control_suite_params, locomotion_params, manipulation_params  # pyright: ignore[reportMissingImports]

  if task in dm_control_suite._envs:
    params = dm_control_suite_params
  else:
    params = locomotion_params if task in locomotion._envs else manipulation_params
  return dict(getattr(params, f"brax_{agent}_config")(task, backend))


def load(task: str, backend: str, num_envs: int) -> object:
  """Returns the package's task on a backend; Warp's buffers, sized for 8192 environments, grow with more."""
  from mujoco_playground import registry  # pyright: ignore[reportMissingImports]

  config = registry.get_default_config(task)
  changes: dict[str, object] = {"impl": backend} if "impl" in config else {}
  if backend == "warp" and num_envs > 8192:
    sizes = {name: config.get(name) for name in ("naconmax", "naccdmax")}
    changes |= {name: int(size * num_envs / 8192) for name, size in sizes.items() if size}
  return registry.load(task, config_overrides=changes)


def arguments_of(task: str, backend: str, seed: int, agent: str = "ppo") -> Settings:
  """Returns the arguments with which Brax's trainer trains a task on one device as the package does."""
  from mujoco_playground import registry, wrapper  # pyright: ignore[reportMissingImports]

  networks = importlib.import_module(f"brax.training.agents.{agent}.networks")
  settings = tuned(task, backend, agent)
  settings.update(json.loads(os.environ.get("PEER_SETTINGS", "{}")))  # smaller ones, to try the driver out
  network = dict(settings.pop("network_factory", None) or {})
  return {
    **settings,
    "environment": load(task, backend, settings["num_envs"]),
    "network_factory": functools.partial(getattr(networks, f"make_{agent}_networks"), **network),
    "wrap_env_fn": wrapper.wrap_for_brax_training,
    "randomization_fn": registry.get_domain_randomizer(task),
    "max_devices_per_host": 1,
    "seed": seed,
  }


def in_words(arguments: Settings, *names: str) -> str:
  """Formats settings as text."""
  return ", ".join(f"{name} {arguments[name]}" for name in (*SIZES, *names) if name in arguments)


def train(task: str, backend: str, seed: int, steps: int, epochs: int, age_s: Callable[[], float]) -> dict[str, object]:
  """Trains for `epochs` epochs of at least `steps` control steps, without evaluations or resets in between."""
  from brax.training.agents.ppo import train as ppo

  arguments, marks = arguments_of(task, backend, seed), []
  for name in EVALUATION:
    arguments.pop(name, None)
  update_steps = arguments["batch_size"] * arguments["num_minibatches"] * arguments["unroll_length"]
  update_steps *= arguments.get("action_repeat", 1)
  epoch_steps = -(-steps // update_steps) * update_steps
  start_s, begin = age_s(), time.perf_counter()
  ppo.train(
    **arguments | {"num_timesteps": epochs * epoch_steps},
    num_evals=epochs + 1,
    run_evals=False,
    progress_fn=lambda step, _: marks.append((step, time.perf_counter())),
  )
  times = [begin, *(moment for step, moment in marks if step)]
  memory = (jax.local_devices()[0].memory_stats() or {}).get("peak_bytes_in_use")
  return {
    "start_s": start_s,
    "epochs": [later - earlier for earlier, later in itertools.pairwise(times)],
    "epoch_steps": epoch_steps,
    "update_steps": update_steps,
    "peak_memory_gib": None if memory is None else memory / 2**30,
    "settings": in_words(arguments),
  }


def learn(task: str, backend: str, seed: int, num_timesteps: int | None, agent: str) -> dict[str, object]:
  """Trains with the package's own evaluations and resets; `num_timesteps` None is the package's own budget.

  The clock starts after the evaluation before training, which Brax compiles and runs first. The time includes compiling
  the training, training, resets and later evaluations.
  """
  brax = importlib.import_module(f"brax.training.agents.{agent}.train")
  arguments, evaluations, rates = arguments_of(task, backend, seed, agent), [], []
  if num_timesteps is not None:
    arguments["num_timesteps"] = num_timesteps
  if agent == "sac":
    arguments.pop("num_resets_per_eval", None)  # 0.2.0 has it in the set, Brax's SAC resets nothing between
  stretches = max(arguments.get("num_resets_per_eval", 0), 1)

  def note(step: int, metrics: Mapping[str, float]) -> None:
    evaluations.append((int(step), float(metrics["eval/episode_reward"]), time.perf_counter()))
    if step:  # Brax divides the steps of all stretches between resets by the time of the last one
      rates.append(float(metrics["training/sps"]) / stretches)

  brax.train(**arguments, progress_fn=note)
  begin = evaluations[0][2]
  return {
    "evaluations": [(step, score, moment - begin) for step, score, moment in evaluations],
    "steps": evaluations[-1][0],
    "wall_clock_s": evaluations[-1][2] - begin,
    "training_steps_per_s": float(np.median(rates)),
    "settings": in_words(arguments, *EVALUATION),
  }


def process_age_s() -> float:
  """Returns the seconds since this process started (Linux)."""
  started = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
  return float(Path("/proc/uptime").read_text().split()[0]) - started / os.sysconf("SC_CLK_TCK")


def main() -> None:
  job = json.loads(sys.argv[1])
  put_back_names()
  if os.environ.get("PEER_MENAGERIE"):
    use_menagerie(os.environ["PEER_MENAGERIE"])
  subject = job["task"], job["backend"], job["seed"]
  if job.get("evaluate"):
    result = learn(*subject, job["num_timesteps"], job["agent"])
  else:
    result = train(*subject, job["steps"], job["epochs"], process_age_s)
  names = {"jax": "JAX", "mujoco": "MuJoCo", "mujoco-mjx": "MJX", "brax": "Brax", "warp-lang": "Warp"}
  have = {dist.name: dist.version for dist in metadata.distributions()}
  result["versions"] = "; ".join(f"{label} {have[name]}" for name, label in names.items() if name in have)
  print("\nRESULT " + json.dumps(result), flush=True)


if __name__ == "__main__":
  main()
