"""Finds the GPUs of this machine without JAX, which would take their memory."""

import os
import subprocess
from collections.abc import Mapping


def visible_gpus(env: Mapping[str, str] = os.environ) -> list[str]:
  """Returns the GPUs in CUDA_VISIBLE_DEVICES, else all that the driver has."""
  if env.get("JAX_PLATFORMS") == "cpu":
    return []
  named = env.get("CUDA_VISIBLE_DEVICES")
  if named is not None:
    return [gpu.strip() for gpu in named.split(",") if gpu.strip() not in ("", "-1")]
  try:
    query = ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"]
    done = subprocess.run(query, capture_output=True, text=True, timeout=20)
  except (OSError, subprocess.TimeoutExpired):
    return []
  return done.stdout.split() if done.returncode == 0 else []
