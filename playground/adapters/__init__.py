"""Tasks as the environments of other libraries: gymnasium, dm_env and code written for Playground 0.2.0."""
