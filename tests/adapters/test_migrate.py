"""Code as users of Playground 0.2.0 wrote it, with nothing but the import changed (nothing is compiled)."""

import functools

import jax
import jax.numpy as jnp
import pytest

from playground import dm_control_suite, locomotion, manipulation, registry, wrapper


def test_a_training_scripts_way_to_its_environment() -> None:
  env_name = "Go1JoystickFlatTerrain"
  env_cfg = registry.get_default_config(env_name)
  env_cfg.impl = "jax"
  env = registry.load(env_name, config=env_cfg, config_overrides={"episode_length": 200})
  randomizer = registry.get_domain_randomizer(env_name)
  assert randomizer is not None
  assert (env.dt, env.sim_dt, env.n_substeps, env.action_size) == (0.02, 0.004, 5, 12)
  assert env.observation_size == {"state": (48,), "privileged_state": (123,)}
  assert env.mj_model.nu == 12 and env.unwrapped is env
  keys = jax.random.split(jax.random.PRNGKey(0), 4)
  wrapped = wrapper.wrap_for_brax_training(
    env, episode_length=200, action_repeat=1, randomization_fn=functools.partial(randomizer, rng=keys)
  )

  assert (wrapped.action_size, wrapped.unwrapped) == (12, env)


def test_a_copy_of_a_configuration_takes_another_term() -> None:
  config = locomotion.get_default_config("Go1JoystickFlatTerrain").copy_and_resolve_references()
  term = {"func": "joint_deviation_l1", "weight": -0.1, "params": {"joints": [".*_calf_joint"]}}
  with config.unlocked():
    config.update({"rewards": {"calves": term}})
  env = locomotion.load("Go1JoystickFlatTerrain", config)
  assert "calves" in env.config.rewards
  assert list(env.config.observations.state)[:2] == ["linvel", "gyro"], "the copy has them in alphabetical order"


def test_a_notebooks_rollout() -> None:
  env = dm_control_suite.load("CartpoleBalance", config_overrides={"ctrl_dt": 0.02})
  assert dm_control_suite.get_default_config("CartpoleBalance").ctrl_dt == 0.01
  wrapped = wrapper.wrap_for_brax_training(env, episode_length=50, action_repeat=2)
  jit_reset, jit_step = jax.jit(wrapped.reset), jax.jit(wrapped.step)
  state = jax.eval_shape(jit_reset, jax.random.split(jax.random.PRNGKey(0), 4))
  state = jax.eval_shape(jit_step, state, jnp.zeros((4, env.action_size)))
  assert (state.obs.shape, state.data.qpos.shape) == ((4, 5), (4, 2))
  assert state.reward.shape == state.done.shape == state.info["truncation"].shape == (4,)
  assert {"steps", "episode_metrics", "AutoResetWrapper_done_count"} <= set(state.info)


def test_the_suites_names() -> None:
  assert len(dm_control_suite.ALL_ENVS) == 25
  assert {"Go1Getup", "T1JoystickRoughTerrain", "SpotGetup"} <= set(locomotion.ALL_ENVS)
  assert {"PandaPickCube", "LeapCubeReorient", "AeroCubeRotateZAxis"} <= set(manipulation.ALL_ENVS)
  suites = (dm_control_suite.ALL_ENVS, locomotion.ALL_ENVS, manipulation.ALL_ENVS)
  assert sum(map(len, suites)) == len(set().union(*suites))
  assert set().union(*suites) <= set(registry.ALL_ENVS)


def test_randomizers() -> None:
  assert locomotion.get_domain_randomizer("Go1Getup") is not None
  assert manipulation.get_domain_randomizer("PandaPickCube") is None
  with pytest.raises(ValueError, match="Did you mean 'Go1Getup'"):
    locomotion.load("Go1GetUp2")
