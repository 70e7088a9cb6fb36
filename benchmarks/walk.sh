#!/usr/bin/env bash
# Do policies walk? The runs that the question still needs, for a lent GPU, what matters most first:
# benchmarks/walk.sh [results folder]. Planned for one H200 and 25 minutes a call, each going on where the last one ended:
# stopped with SIGTERM the runs save. Needs playground-run on PATH.
set -euo pipefail
out=${1:-results/walk}
four_at_a_time="launcher.slots_per_gpu=4 launcher.mps=true"

# The golden set first: a change that broke learning shows there.
playground-bench golden set=gpu workers=3

# Each alone on the GPU, for these have goals in minutes. Keep the policies.
playground-run -m sweep=humanoids sweep_dir="$out/humanoids"

# What is below the public or not sure with every seed, then what has not had its whole budget.
playground-run -m sweep=below_public launcher.slots_per_gpu=3 launcher.mps=true sweep_dir="$out/below_public"
playground-run -m sweep=whole_budgets $four_at_a_time sweep_dir="$out/whole_budgets"

# HumanoidRun with other seeds (663 after 60 M steps), and where public PPO is slow or stalls.
playground-run -m sweep=reppo_fast_td3 $four_at_a_time sweep_dir="$out/reppo_fast_td3"

# In C MuJoCo: 20 episodes of each without a fall, with the gait's measures.
for job in "$out"/humanoids/jobs/*/ "$out"/below_public/jobs/*/; do
  playground eval "$job" --episodes 128 --deterministic
  playground play "$job" --episodes 20
done

playground-bench report rows="[results/reference,results/benchmarks,$out]"
