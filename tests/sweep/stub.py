"""Stands in for `playground-run` in tests of sweeps: leaves what a run leaves, in no time. `seed` says what happens.

0 to 9 finish; 10 crashes; 11 hangs and does not listen; 12 is killed; 13 saves when it is asked to stop and finishes
when it is resumed; 14 crashes at its first start only; 15 takes its time;
16 saves at its first start, and at its second ends before it has a status.
"""

import datetime
import json
import os
import signal
import sys
import time
from pathlib import Path

given = dict(arg.split("=", 1) for arg in sys.argv[1:])
run = Path((given.get("resume") or given["run_dir"])[1:-1].replace("\\'", "'").replace("\\${", "${"))
again = "resume" in given
seed = int((run / "config.yaml").read_text()) if again else int(given["seed"])
(run / "config.yaml").write_text(str(seed))
facts = {"pid": os.getpid(), "gpus": os.environ.get("CUDA_VISIBLE_DEVICES"), "cores": sorted(os.sched_getaffinity(0))}
PLACE = ("XLA_CLIENT_MEM_FRACTION", "WANDB_RUN_GROUP", "CUDA_MPS_PIPE_DIRECTORY")
facts |= {name: os.environ.get(name) for name in PLACE}


def status(word: str, reason: str = "") -> None:
  now = datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
  (run / "status.json").write_text(json.dumps({"status": word, "reason": reason, "updated": now}))


def save(*_: object) -> None:
  print("saved")
  status("preempted", "interrupted and saved")
  sys.exit(143)


if seed == 16 and again:
  print("error: it is damaged.")
  sys.exit(2)
if seed == 16:
  save()
if seed == 11:
  signal.signal(signal.SIGTERM, signal.SIG_IGN)
if seed == 13 and not again:
  signal.signal(signal.SIGTERM, save)
status("running")
with (run / "starts.jsonl").open("a") as file:  # whoever reads it may send a signal
  file.write(json.dumps(facts | {"began": time.time(), "again": again}) + "\n")
if seed == 10 or (seed == 14 and not again):
  print("Traceback …\nValueError: out of luck")
  print("-" * 20 + "\nFor simplicity, JAX has removed its internal frames from the traceback of the following …")
  sys.exit(1)
if seed == 11:
  time.sleep(60)
if seed == 12:
  os.kill(os.getpid(), signal.SIGKILL)
if seed == 13 and not again:
  time.sleep(60)
if seed == 15:
  time.sleep(1.5)
rate = float(given.get("agent.learning_rate", 0))
rows = [f"{step},{seed + step / 100},{step / 10}" for step in (0, 50, 100)]
(run / "metrics.csv").write_text("\n".join(["step,eval/episode_reward,time/wall_clock_s", *rows]) + "\n")
score = -((rate - 0.3) ** 2) if rate else seed + 1.0
summary = {"final_return": score, "best_return": score + 1, "steps": 100, "steps_per_second": 50.0}
summary |= {"wall_clock_s": 10.0}
(run / "summary.json").write_text(json.dumps({"status": "finished", **summary}))
status("finished")
