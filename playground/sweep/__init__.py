"""Sweeps of runs: `playground-run -m` and `playground sweep`.

The state of a sweep is in files. If the sweep's process dies, the same command runs the missing jobs:

```
<sweep_dir>/
  sweep.yaml            the command, and every job with its overrides
  jobs/<job>/           a run directory, with job.json (status, by its worker) and job.log
  sweep.csv  groups.csv  plots/  report.html      the result, by `collect` and at the end
```

  plan      command line -> jobs, composed and checked
  folder    the files above
  worker    one job in one process, started by a launcher on any machine
  local, slurm, ray     launchers: start workers
  runner    the loop that starts jobs through a launcher and waits for them; `playground-bench` uses it, too
  search    Optuna instead of every combination
  view      the output of a running sweep
  report    tables, curves and the page
"""
