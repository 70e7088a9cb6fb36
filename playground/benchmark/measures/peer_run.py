"""A training of the public package from beginning to end, with its own evaluations, beside `run` of ours."""

from playground.benchmark.measures.peer import drive
from playground.benchmark.measures.run import RESULT, emit_result, emit_returns
from playground.benchmark.measures.subject import alone
from playground.benchmark.worker import Facts


def measure(
  facts: Facts,
  task: str,
  agent: str,
  num_timesteps: int | None,
  peer: str,
  python: str,
  path: str,
  menagerie: str,
  backend: str,
  told: list[str],
  seeds: list[int],
  lock: str | None,
) -> None:
  """Rows as `run` has them of ours; `told` is the job's setting, an evaluation's row adds its step.

  What a run's time is differs: the peer compiles its training while it runs, so that this is in it.
  """
  (seed,) = seeds
  job = {"task": task, "agent": agent, "backend": backend, "seed": seed}
  job |= {"evaluate": True, "num_timesteps": num_timesteps}
  with alone(lock):
    result = drive(facts, peer, python, path, menagerie, job)
  when = "time from the end of the evaluation before training to that of the last, compiling the training in it"
  facts["conditions"] = f"a whole run, {when}; {result['settings']}"
  emit_returns(facts, result["evaluations"], told, seed)
  trained = [score for step, score, _ in result["evaluations"] if step > 0]
  result |= {"best_return": max(trained), "final_return": trained[-1]}
  emit_result(facts, result, RESULT, seed=seed)
