"""Many runs at once: `playground-run -m` and `playground sweep`.

Everything about a sweep lies in files, so whatever runs it may die, and the same command again does what is missing:

```
<sweep_dir>/
  sweep.yaml            what was asked for, and every job with its overrides
  jobs/<job>/           a run directory, with job.json (how the job stands, by its worker) and job.log besides
  sweep.csv  groups.csv  plots/  report.html      the result, by `collect` and at the end
```

  plan      command line -> jobs, composed and checked
  folder    those files
  worker    one job in one process: started by a launcher, on whatever machine
  local, slurm, ray     launchers: where and when a worker starts
  runner    the loop that hands jobs to a launcher and waits for them; measurements of `playground-bench` use it, too
  search    Optuna instead of every combination
  view      the output meanwhile
  report    tables, curves and the page
"""
