#!/usr/bin/env bash
# Do policies walk? The runs that the question still needs, for a lent GPU, what matters most first:
# benchmarks/walk.sh [results folder]. Planned for one H200 and 25 minutes a call, each going on where the last one ended:
# stopped with SIGTERM the runs save. Needs playground-run on PATH.
set -euo pipefail
out=${1:-results/walk}
four_at_a_time="launcher.slots_per_gpu=4 launcher.mps=true"

# Each alone on the GPU, for these have goals in minutes. Keep the policies.
playground-run -m sweep=humanoids sweep_dir="$out/humanoids"

# The Go1's resets, and runs that were cut short.
playground-run -m sweep=below_public launcher.slots_per_gpu=3 launcher.mps=true sweep_dir="$out/below_public"

# HumanoidRun with other seeds (663 after 60 M steps), and where public PPO is slow or stalls.
playground-run -m sweep=reppo_fast_td3 $four_at_a_time sweep_dir="$out/reppo_fast_td3"

# In C MuJoCo: 20 episodes of each without a fall, with the gait's measures.
for job in "$out"/humanoids/jobs/*/ "$out"/below_public/jobs/*/; do
  playground eval "$job" --episodes 128 --deterministic
  playground play "$job" --episodes 20
done

playground-bench golden set=gpu workers=3
playground-bench report rows="[results/reference,results/benchmarks,$out]"
