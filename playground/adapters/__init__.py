"""Tasks as the environments of other libraries: gymnasium, dm_env, RSL-RL and code written for 0.2.0."""
