"""How physics reaches a backend; what it computes is in test_golden.py."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.mjx._src.math import quat_to_mat

from playground import registry
from playground.config import compose
from playground.errors import ConfigError
from playground.hardware.mesh import GROUP, make_mesh
from playground.learning.trainer import Trainer, trainer_settings
from playground.physics.backend import WORLDS, Physics, batch_size, compile_spec
from playground.physics.c_mujoco import CPhysics
from playground.randomization import Randomizer
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


def test_sensors_are_those_of_one_time_in_mjx_and_c_mujoco() -> None:
  model = mujoco.MjModel.from_xml_string("<mujoco><option integrator='RK4'/></mujoco>")
  with pytest.raises(ConfigError, match=r"^The model's integrator is RK4, .* 'implicitfast' in the MJCF\.$"):
    Physics(model)


def test_a_saturated_servo_is_not_damped() -> None:
  servo = "<position joint='hinge' kp='1' kv='0.1' ctrllimited='false' forcelimited='true' forcerange='-1 1'/>"
  model = mujoco.MjModel.from_xml_string(
    "<mujoco><option timestep='0.01' integrator='implicitfast'/><worldbody><body><joint name='hinge' axis='0 0 1'/>"
    f"<geom type='box' size='.1 .1 .1' mass='1'/></body></worldbody><actuator>{servo}</actuator></mujoco>"
  )
  data, physics = mujoco.MjData(model), Physics(model)
  for target in (2.0, 0.0):  # saturated, and not
    data.ctrl[:] = target
    before = physics.make(qpos=data.qpos, qvel=data.qvel)
    mujoco.mj_step(model, data)
    after = jax.jit(physics.step, static_argnums=3)(physics.model, before, jnp.full(1, target), 1)
    np.testing.assert_allclose(after.qvel, data.qvel, rtol=1e-5)


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


BOX = """
<mujoco>
  <worldbody>
    <body name="box" pos="0 0 2"><freejoint/><geom name="cube" type="box" size=".1 .1 .1" mass="1"/></body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("impl", ["jax", "warp", "c"])
@pytest.mark.parametrize(
  "drawn",
  [
    {"body_ipos": [[0, 0, 0], [0.05, 0.02, 0]]},
    {"body_mass": [0, 3], "body_ipos": [[0, 0, 0], [0, 0.03, 0]]},
    {"body_inertia": [[0, 0, 0], [0.01, 0.02, 0.03]], "body_iquat": [[1, 0, 0, 0], [0.8, 0.6, 0, 0]]},
  ],
)
def test_a_body_with_a_drawn_centre_of_mass_falls_as_newton_says(impl: str, drawn: Any) -> None:
  """At rest and free it falls without turning; a torque about its principal axes turns it by torque / inertia."""
  physics = Physics(compile_spec(mujoco.MjSpec.from_string(BOX)), impl="jax" if impl == "c" else impl)
  physics = CPhysics(physics) if impl == "c" else physics
  changed: Any = {name: jnp.array(value, jnp.float32) for name, value in drawn.items()}
  model: Any = physics.model.tree_replace(changed)
  inertia, place, frame = (getattr(model, f"body_{name}")[1] for name in ("inertia", "ipos", "iquat"))
  torque = jnp.zeros((2, 6)).at[1, 3:].set(jnp.array([0.01, 0.02, 0.03]))
  forward = jax.jit(lambda force: physics.forward(model, physics.make(xfrc_applied=force)).qacc)
  np.testing.assert_allclose(forward(jnp.zeros((2, 6))), [0, 0, -9.81, 0, 0, 0], atol=1e-3)
  to_world = quat_to_mat(frame)
  turn = to_world @ (to_world.T @ torque[1, 3:] / inertia)
  fall = jnp.array([0, 0, -9.81]) - jnp.cross(turn, place)
  np.testing.assert_allclose(forward(torque), jnp.concatenate([fall, turn]), atol=2e-3)


def test_c_mujoco_simulates_what_jax_does_not_implement() -> None:
  cylinder = '<body pos="0 0 .3"><freejoint/><geom type="cylinder" size=".05 .1"/></body>'
  floor = '<geom type="box" size="1 1 .1"/>'
  spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{floor}{cylinder}</worldbody></mujoco>")
  physics = CPhysics(Physics(compile_spec(spec), impl="warp"))
  step = lambda data, _: (physics.step(physics.model, data, jnp.zeros(0), 5), None)
  start = physics.forward(physics.model, physics.make())
  assert jax.tree.structure(start) == jax.tree.structure(physics.make())
  after = jax.jit(lambda data: jax.lax.scan(step, data, None, 100)[0])(start)
  np.testing.assert_allclose(after.qpos[2], 0.2, atol=5e-3)  # it stands on the box


HAMMER = """
<mujoco>
  <worldbody>
    <geom type="box" size="1 1 .1" pos="0 0 -.1"/>
    <body name="hammer" pos="0 0 {height}"><freejoint/><inertial pos="0 0 0" mass="{mass}" diaginertia=".01 .01 .01"/>
      <geom name="left" type="box" size="{size}" pos="-.3 0 0"/>
      <geom name="right" type="box" size="{size}" pos=".3 0 0"/>
    </body>
  </worldbody>
  <sensor><subtreelinvel body="hammer"/></sensor>
</mujoco>
"""


@pytest.mark.parametrize("impl", ["jax", "warp", "c"])
def test_drawn_sizes_and_masses_are_those_of_contacts_and_sensors(impl: str) -> None:
  nominal = compile_spec(mujoco.MjSpec.from_string(HAMMER.format(size=".05 .05 .05", mass=1, height=0.18)))
  scaled = lambda field, target, by: {"field": field, "target": target, "operation": "scale", "range": [by, by]}
  drawn = [scaled("geom_size", ["left", "right"], 4), scaled("body_mass", "all", 2)]
  section = {f"{i}": {"mode": "startup", "func": "model_field", "params": params} for i, params in enumerate(drawn)}
  physics = Physics(nominal, impl="jax" if impl == "c" else impl, njmax=80, naconmax_per_env=20)
  physics = CPhysics(physics) if impl == "c" else physics
  fields: Any = Randomizer(nominal, section, impl=physics.impl).sample(jax.random.PRNGKey(0))
  model: Any = physics.model.tree_replace(fields)
  velocity = jnp.zeros(nominal.nv).at[0].set(1.0)
  ours = jax.jit(lambda: physics.forward(model, physics.make(qvel=velocity)))()
  truth = mujoco.MjModel.from_xml_string(HAMMER.format(size=".2 .2 .2", mass=2, height=0.18))
  theirs = mujoco.MjData(truth)
  theirs.qvel[:] = velocity
  mujoco.mj_forward(truth, theirs)
  assert theirs.qacc[2] > 0  # the larger hammer touches the ground
  np.testing.assert_allclose(ours.sensordata, [1, 0, 0], atol=1e-6)
  np.testing.assert_allclose(ours.qacc[2], theirs.qacc[2], rtol=0.1)  # constraints keep their nominal softness


def test_a_drawn_body_on_a_slide_is_as_heavy_in_c_mujoco() -> None:
  ball = '<body><joint name="z" type="slide" axis="0 0 1" armature="0.5"/><geom size=".1" mass="1"/></body>'
  motor = '<actuator><motor joint="z"/></actuator>'
  spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{ball}</worldbody>{motor}</mujoco>")
  physics = CPhysics(Physics(compile_spec(spec), impl="jax"))
  for mass, armature in ((3.0, 0.5), (1.0, 0.5), (1.0, 2.0)):
    model = physics.model.replace(body_mass=jnp.array([0, mass]), dof_armature=jnp.array([armature]))
    qacc = physics.forward(model, physics.make(ctrl=jnp.array([2.0]))).qacc
    np.testing.assert_allclose(qacc, [(2 - 9.81 * mass) / (mass + armature)], rtol=1e-6)
  np.testing.assert_allclose(physics.forward(physics.model, physics.make()).qacc, [-9.81 / 1.5], rtol=1e-6)
