"""What is randomised is seen: each term alone changes the image of the scene that it is made for."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from playground import registry
from playground.randomization import Randomizer
from playground.rendering.batch import BatchRenderer, View
from tests.test_randomization import events

DRAWS = 3
PANDA = [
  event["params"]
  for event in yaml.safe_load(
    (Path(__file__).parents[2] / "configs/randomization/panda_vision.yaml").read_text()
  ).values()
]
CARTPOLE = [  # what the Panda's list lacks: a lamp that hangs somewhere, a lens, a material
  {"field": "light_pos", "target": "all", "operation": "add", "range": [-2.0, 2.0]},
  {"field": "light_castshadow", "target": "all", "operation": "set", "distribution": "bernoulli", "mean": 0.5},
  {"field": "cam_fovy", "target": "fixed", "operation": "scale", "range": [0.7, 0.9]},
  {"field": "mat_rgba", "target": "all", "operation": "scale", "column": [0, 1, 2], "range": [0.3, 0.7]},
]


@pytest.mark.slow
@pytest.mark.parametrize(
  ("task", "camera", "terms"),
  [("PandaPickCubeCartesianVision", "front", PANDA), ("CartpoleBalance", "fixed", CARTPOLE)],
)
def test_every_term_is_seen(task: str, camera: str, terms: list[dict[str, Any]]) -> None:
  env: Any = registry.load(task, overrides={"impl": "warp", "vision.enable": False})
  model = env.mj_model
  qpos = model.keyframe("low_home").qpos.copy() if model.nkey else model.qpos0.copy()
  qpos[1] += 0.2  # the arm lower, so that all of its materials are in the image; the pole leans
  randomizers = [Randomizer(model, events(term)) for term in terms]
  fields = {field for randomizer in randomizers for field in randomizer.fields}
  nominal = {field: jnp.asarray(getattr(model, field)) for field in fields}
  models = [nominal]
  for i, randomizer in enumerate(randomizers):
    models += [nominal | randomizer.sample(key) for key in jax.random.split(jax.random.PRNGKey(i), DRAWS)]
  renderer = BatchRenderer(env.physics, View((camera,), shadows=True))

  def render(fields: dict[str, jax.Array]) -> jax.Array:
    data = env.physics.make(qpos=qpos)
    return renderer.render(env.mjx_model.tree_replace(fields), data)[0][camera]["rgb"]

  first, *others = np.asarray(jax.jit(jax.vmap(render))(jax.tree.map(lambda *x: jnp.stack(x), *models)))
  changed = np.array([(other != first).any(axis=-1).sum() for other in others]).reshape(len(terms), DRAWS)
  unseen = [term for term, pixels in zip(terms, changed.max(axis=1), strict=True) if pixels < 5]
  assert not unseen
