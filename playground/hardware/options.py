"""Settings of `hardware`: which devices train, with which precision, and on how many machines.

One training is one mesh with a single axis, `data`: environments and every minibatch are divided evenly over its
devices, parameters are the same on all, gradients are averaged once a minibatch (docs/hardware.md).
"""

import dataclasses
from typing import Annotated, Literal

from playground.limits import count, positive

Platform = Literal["auto", "cpu", "gpu"]
Precision = Literal["default", "high", "highest", "bfloat16", "tensorfloat32", "float32"]


@dataclasses.dataclass(frozen=True)
class DistributedConfig:
  """Settings of a training on several machines, one process on each or one for each GPU."""

  enable: Annotated[bool, "train on several machines, as hardware=multi_node does"] = False
  coordinator: Annotated[str | None, "host:port of process 0; null asks Slurm or what else JAX knows"] = None
  num_processes: Annotated[int | None, count(1, 100_000), "processes in all; null asks as for coordinator"] = None
  process_id: Annotated[int | None, count(0, 100_000), "number of this process, from 0; null asks as above"] = None
  timeout: Annotated[float, positive(), "seconds to wait for the others, and for a first exchange with them"] = 300.0
  lost_after: Annotated[
    float, positive(1e6), "seconds without a sign of life after which a process is lost, and all others end"
  ] = 60.0


@dataclasses.dataclass(frozen=True)
class HardwareConfig:
  """Settings of the devices of a training."""

  platform: Annotated[Platform, "auto is a GPU if JAX sees one"] = "auto"
  kind: Annotated[str | None, "a word that the device's name must have, such as H100; null takes any"] = None
  devices: Annotated[int | None, count(1, 100_000), "devices of each machine; null is all"] = None
  scale_envs: Annotated[
    bool, "whether agent.num_envs and agent.batch_size are for one device, and multiplied by all"
  ] = False
  matmul_precision: Annotated[Precision, "of physics: full float32, TF32 ruins some contact-rich tasks"] = "highest"
  network_precision: Annotated[Precision, "of policy, value and their updates"] = "tensorfloat32"
  preallocate: Annotated[
    bool, "whether JAX takes its GPU memory at once; false leaves room for Warp and other runs"
  ] = False
  memory_fraction: Annotated[
    float | None, positive(1), "share of the GPU's memory that JAX may take; null is JAX's own, 0.75"
  ] = None
  compilation_cache: Annotated[bool, "whether compiled programs are kept for the next run"] = True
  cache_dir: Annotated[
    str | None, "folder of compiled programs, of this command alone (docs/security.md); null is ~/.cache/playground"
  ] = None
  xla_flags: Annotated[
    str, "added to XLA_FLAGS, but for those that JAX removed: switches and numbers (--xla_gpu_deterministic_ops=true)"
  ] = ""
  distributed: Annotated[DistributedConfig, "several machines"] = dataclasses.field(default_factory=DistributedConfig)
