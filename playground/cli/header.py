"""Formats the first lines of a run: task, algorithm, folder, and differences from the defaults."""

from collections.abc import Iterator, Sequence

from playground.config import RunConfig, TaskConfig, is_hydras

_SHOWN = 6  # values of the command line; config.yaml has all


def header(config: RunConfig) -> list[str]:
  """Returns some ten lines that describe a run, or a chain of runs."""
  title, *rows = _rows(config)
  return [title[1], *(f"  {name:<10} {text}" for name, text in rows)]


def _rows(config: RunConfig) -> Iterator[tuple[str, str]]:
  choices, agent, env = config.choices, config.agent, config.env
  yield "", f"Training {choices['env']} with {config.agent_name}"
  origin = {"experiment": choices.get("experiment"), "robot": choices.get("robot")}
  origin["randomization"] = choices.get("randomization")
  if named := [f"{group}={option}" for group, option in origin.items() if option]:
    yield "from", " ".join(named)
  if config.stages:
    yield "stages", ", ".join(f"{stage.name.split('/')[-1]} ({_steps(stage)})" for stage in config.stages)
  else:
    yield "budget", f"{_steps(config)} in {agent.num_envs:,} environments, {agent.num_evals} evaluations"
  tuned = choices.get("tuned")
  why = " (tuned=null)" if "tuned=null" in config.overrides else ": no tuned set for this task"
  yield "agent", f"tuned set {tuned}" if tuned else f"default hyperparameters{why}"
  backend = "jax, or warp on a GPU" if (env.impl, env.cuda_impl) == ("auto", "warp") else env.impl
  yield "hardware", f"{choices.get('hardware')}; physics backend {backend.replace('auto', 'jax')}; seed {config.seed}"
  given = [text.lstrip("+") for text in config.overrides if not is_hydras(text)]  # Hydra's form has ++ before terms
  if set_here := [text for text in given if "." in text.partition("=")[0]]:
    more = f" and {len(set_here) - _SHOWN} more" if len(set_here) > _SHOWN else ""
    yield "changed", " ".join(set_here[:_SHOWN]) + more
  for text in of_events_that_are_off(env, given):
    yield "no effect", text
  for key in ("resume", "init_from"):
    if getattr(config, key):
      yield key, str(getattr(config, key))
  if not config.resume:
    yield "folder", str(config.run_dir)
  yield "config", "config.yaml in this folder; --verbose prints it"


def of_events_that_are_off(env: TaskConfig, overrides: Sequence[str]) -> list[str]:
  """Returns a sentence for each event that overrides change, but that is off."""
  keys = [text.lstrip("+").partition("=")[0].split(".") for text in overrides]
  changed = {key[2]: None for key in keys if key[:2] == ["env", "events"] and len(key) > 3 and key[3] != "enabled"}
  events = {name: env.get("events", {}).get(name) for name in changed}
  off = [name for name, event in events.items() if event and not event.get("enabled", True)]
  return [f"The event {name} is off: env.events.{name}.enabled=true turns it on." for name in off]


def _steps(config: RunConfig) -> str:
  return f"{config.agent.num_timesteps:,} steps"
