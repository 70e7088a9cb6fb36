#!/usr/bin/env bash
# Do policies walk? Every run that the question needs, for a lent GPU: benchmarks/walk.sh [results folder].
# Stopped with SIGTERM the runs save; the same command goes on where it ended. Needs playground-run on PATH.
set -euo pipefail
out=${1:-results/walk}
one_gpu="launcher.slots_per_gpu=4 launcher.mps=true"

# Humanoids with PPO's default set, 100 M steps: first as the public curves are (no pushes, nothing randomised; G1 8 at
# 53 M and 17 at 96 M steps by the mode, T1 18 and 29), then with pushes and randomisation (goals: G1 23, T1 30).
playground-run -m sweep=humanoids $one_gpu sweep_dir="$out/humanoids"
# Goals: HumanoidRun 600, HumanoidWalk and HumanoidStand 900.
playground-run -m sweep=reppo_fast_td3 launcher.slots_per_gpu=2 launcher.mps=true sweep_dir="$out/reppo_fast_td3"
playground-run -m sweep=ppo_robust $one_gpu sweep_dir="$out/ppo_robust"

# In C MuJoCo: 20 episodes of each humanoid without a fall, with the gait's measures.
for job in "$out"/humanoids/jobs/*/; do
  playground eval "$job" --episodes 128 --deterministic
  playground play "$job" --episodes 20
done

playground-bench golden set=gpu
playground-bench report rows="[results/reference,results/benchmarks,$out]"
