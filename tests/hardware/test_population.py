"""Agents that learn from each other on several devices: what an exchange copies, and what a resumed population has.

Each layout divides other axes: agents alone, agents and their environments, environments alone.
"""

import json
from pathlib import Path

import pytest

from tests.processes import start

EXCHANGE = """
import dataclasses, json, sys
import numpy as np
from playground.hardware.mesh import make_mesh
from playground.learning.evaluation import make_evaluator
from playground.learning.loop import Loop, compile_program, schedule
from playground.learning.population import PARENT, Population
from playground.learning.trainer import Trainer, trainer_settings
from playground.limits import positive
from tests.dummy import SMALL, PointTask, Recorder, check_resume, numbers

EVERY = 8  # training steps between evaluations; SAC only fills its buffer in the first four
RATE = "agent.learning_rate"
algorithm, devices, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
config = dataclasses.replace(SMALL[algorithm], num_timesteps=3200)
settings = [trainer_settings(dataclasses.replace(config, learning_rate=1e-3 * (i + 1)), {}) for i in range(count)]
trainer = Trainer(PointTask(), config, make_mesh(devices), agents=settings)
program = compile_program(
  trainer, make_evaluator(PointTask(), trainer.act, config.num_eval_envs, trainer.mesh, 0), lambda: ({}, {})
)
population, seeds = Population(1, {RATE: positive(1e-2)}, 5), range(count)

def run(recorders, state=None, update=None):
  loop = Loop(trainer, program, schedule(3 * EVERY, 4, 0, EVERY), seeds, recorders, population)
  return loop.run(loop.init() if state is None else state, update)[0]

whole, first, second = ([Recorder() for _ in seeds] for _ in range(3))
expected = run(whole)
exchanges = []
for at in (1, 2):  # of rows; nothing is exchanged before training and after it
  saved = [dict(recorder.saved)[EVERY * at] for recorder in whole]
  parents = [int(recorder.rows[at][1].get(PARENT, i)) for i, recorder in enumerate(whole)]
  for agent, parent in enumerate(parents):
    for own, theirs in zip(numbers(saved[agent].algorithm), numbers(saved[parent].algorithm), strict=True):
      np.testing.assert_array_equal(own, theirs)
    if parent != agent:
      exchanges.append([agent, parent])
      assert not np.array_equal(saved[agent].env_state.data.qpos, saved[parent].env_state.data.qpos)
  kept = [i for i in range(count) if parents[i] == i]
  policies = [np.concatenate([x.ravel() for x in numbers(saved[i].algorithm.params)]) for i in kept]
  assert len({policy.tobytes() for policy in policies}) == len(kept), "only what was copied is the same"
  assert all(recorder.rows[at][1][f"population/{RATE}"] == s.settings[RATE] for recorder, s in zip(whole, saved))

check_resume(trainer, run, (whole, first, second), expected)
print(json.dumps([list(trainer.mesh.devices.shape), exchanges]))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
  ("algorithm", "devices", "agents", "mesh"),
  [("ppo", 2, 4, [2, 1]), ("ppo", 4, 2, [2, 2]), ("sac", 2, 3, [1, 2])],
)
def test_exchanges_between_devices(algorithm: str, devices: int, agents: int, mesh: list[int], tmp_path: Path) -> None:
  process = start(EXCHANGE, tmp_path, algorithm, str(devices), str(agents), devices=devices)
  out, _ = process.communicate(timeout=600)
  assert process.returncode == 0, out[-3000:]
  divided, exchanges = json.loads(out.strip().splitlines()[-1])
  assert divided == mesh and len(exchanges) == 2
  if mesh[0] > 1:
    device = lambda agent: agent * mesh[0] // agents
    assert any(device(agent) != device(parent) for agent, parent in exchanges), "a copy comes from another device"
