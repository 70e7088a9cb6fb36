"""Finds the GPUs of this machine without JAX, which would take their memory."""

import os
import subprocess
from collections.abc import Mapping, MutableMapping, Sequence

MEMORY_VARIABLES = ("XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION")  # JAX refuses both, the second is old


def limit_memory(env: MutableMapping[str, str], fraction: float) -> None:
  """Sets, in place of what is exported, the share of a GPU's memory that JAX takes."""
  for name in MEMORY_VARIABLES:
    env.pop(name, None)
  env[MEMORY_VARIABLES[0]] = f"{fraction:.3f}"


def visible_gpus(env: Mapping[str, str] = os.environ) -> list[str]:
  """Returns the GPUs in CUDA_VISIBLE_DEVICES, else all that the driver has."""
  if env.get("JAX_PLATFORMS") == "cpu":
    return []
  named = env.get("CUDA_VISIBLE_DEVICES")
  if named is not None:
    return [gpu.strip() for gpu in named.split(",") if gpu.strip() not in ("", "-1")]
  return query_gpus("index")


def query_gpus(fields: str, options: Sequence[str] = ()) -> list[str]:
  """Returns the driver's answer about fields, a line for each GPU; none without a driver."""
  query = ["nvidia-smi", f"--query-gpu={fields}", "--format=csv,noheader,nounits", *options]
  try:
    done = subprocess.run(query, capture_output=True, text=True, timeout=20)
  except (OSError, subprocess.TimeoutExpired):
    return []
  return [line.strip() for line in done.stdout.splitlines()] if done.returncode == 0 else []
