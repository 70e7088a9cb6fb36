"""Finds the GPUs of this machine without JAX, which would take their memory."""

import os
import subprocess
from collections.abc import Mapping, Sequence


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
