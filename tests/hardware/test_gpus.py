"""Finding GPUs without JAX."""

from pathlib import Path

import pytest

from playground.hardware.gpus import limit_memory, visible_gpus


def test_visible_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  assert visible_gpus({"CUDA_VISIBLE_DEVICES": "2, GPU-af"}) == ["2", "GPU-af"]
  assert visible_gpus({"CUDA_VISIBLE_DEVICES": ""}) == visible_gpus({"CUDA_VISIBLE_DEVICES": "-1"}) == []
  assert visible_gpus({"CUDA_VISIBLE_DEVICES": "0", "JAX_PLATFORMS": "cpu"}) == []
  smi = tmp_path / "nvidia-smi"
  smi.write_text("#!/bin/sh\necho 0\necho 1\n")
  smi.chmod(0o755)
  monkeypatch.setenv("PATH", str(tmp_path))
  assert visible_gpus({}) == ["0", "1"]


@pytest.mark.parametrize("name", ["XLA_CLIENT_MEM_FRACTION", "XLA_PYTHON_CLIENT_MEM_FRACTION"])
def test_the_share_of_memory_replaces_what_is_exported(name: str) -> None:
  env = {name: "0.9", "HOME": "/"}
  limit_memory(env, 0.45)
  assert env == {"XLA_CLIENT_MEM_FRACTION": "0.450", "HOME": "/"}  # JAX refuses both names
