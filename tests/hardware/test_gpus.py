"""Finding GPUs without JAX."""

from pathlib import Path

import pytest

from playground.hardware.gpus import visible_gpus


def test_visible_gpus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  assert visible_gpus({"CUDA_VISIBLE_DEVICES": "2, GPU-af"}) == ["2", "GPU-af"]
  assert visible_gpus({"CUDA_VISIBLE_DEVICES": ""}) == visible_gpus({"CUDA_VISIBLE_DEVICES": "-1"}) == []
  assert visible_gpus({"CUDA_VISIBLE_DEVICES": "0", "JAX_PLATFORMS": "cpu"}) == []
  smi = tmp_path / "nvidia-smi"
  smi.write_text("#!/bin/sh\necho 0\necho 1\n")
  smi.chmod(0o755)
  monkeypatch.setenv("PATH", str(tmp_path))
  assert visible_gpus({}) == ["0", "1"]
