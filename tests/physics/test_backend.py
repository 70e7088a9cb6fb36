"""How physics reaches a backend; what it computes is in test_golden.py."""

import re

import jax
import jax.numpy as jnp
import mujoco
import pytest

from playground import registry
from playground.config import compose
from playground.errors import ConfigError
from playground.hardware.mesh import GROUP, make_mesh
from playground.learning.trainer import Trainer, trainer_settings
from playground.physics.backend import WORLDS, Physics, batch_size
from playground.runs.train import model_sampler


def test_a_control_step_calls_warp_at_one_place() -> None:
  # Each place holds temporary memory of its own on a GPU: for the G1's 8192 environments about a GiB.
  env = registry.load("CheetahRun", config_overrides={"impl": "warp", "sim_dt": 0.005})
  state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
  program = jax.jit(env.step).lower(state, jnp.zeros(env.action_size)).as_text()
  assert len(re.findall(r"custom_call @\w*func_wrapper", program)) == 1


def test_warps_buffers_grow_with_the_environments_of_all_agents_on_a_device() -> None:
  sizes: list[int] = []
  environment = lambda x: sizes.append(batch_size()) or x
  batch = jax.vmap(environment, axis_name=WORLDS)
  batch(jnp.zeros(4))
  jax.vmap(batch, axis_name=GROUP)(jnp.zeros((3, 4)))
  environment(jnp.zeros(()))
  assert sizes == [4, 12, 1]


@pytest.mark.parametrize("impl", ["jax", "warp"])
@pytest.mark.parametrize("option", ["integrator='implicit'", "solver='PGS'"])
def test_what_mjx_does_not_implement(option: str, impl: str) -> None:
  model = mujoco.MjModel.from_xml_string(f"<mujoco><option {option}/></mujoco>")
  name = option.split("'")[1].upper()
  with pytest.raises(ConfigError, match=rf"^MJX cannot .* env\.impl={impl}: .*{name}.*; change it in the MJCF\.$"):
    Physics(model, impl=impl)


@pytest.mark.slow
def test_agents_with_other_rewards_and_models_call_warp_once() -> None:
  sizes = ["num_envs=40", "num_eval_envs=4", "batch_size=40", "num_minibatches=1", "unroll_length=2"]
  task = ["env=Go1JoystickFlatTerrain", "tuned=null", "randomization=go1", "env.impl=warp"]
  task += [f"agent.{size}" for size in sizes]
  weights = [f"env.rewards.track_linear_velocity_exp.weight={weight}" for weight in (1.0, 0.5)]
  configs = [compose([*task, weight]) for weight in weights]
  env = registry.load("Go1JoystickFlatTerrain", config=configs[0].env)
  settings = [trainer_settings(config.agent, env.settings_of(config.env)) for config in configs]
  trainer, draw = Trainer(env, configs[0].agent, make_mesh(1), None, settings), model_sampler(env, configs[0], 40, 4)
  model = jax.eval_shape(lambda: trainer.join([draw(seed)[0] for seed in (0, 1)]))
  state = jax.eval_shape(trainer.init, jax.ShapeDtypeStruct((2, 2), jnp.uint32), model, None, trainer.settings)
  traced = trainer.train.trace(state, model, jax.ShapeDtypeStruct((), jnp.int32))
  program = traced.lower(lowering_platforms=("cuda",)).as_text()  # no GPU is needed
  (call,) = re.findall(r".*custom_call @\w*func_wrapper.*", program)
  contacts = 2 * 40 * env.config.naconmax_per_env
  assert f"tensor<80x{env.mj_model.nv}xf32>" in call and f"tensor<{contacts}x3x3xf32>" in call
