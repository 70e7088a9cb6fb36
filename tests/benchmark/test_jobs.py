"""Measurements as processes: rows as they come, what is there is left out, failures do not stop the others."""

import csv
import dataclasses
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from playground.benchmark import jobs
from playground.benchmark.commands import Topology
from playground.benchmark.jobs import Measurement, Plan, probe, run_jobs
from playground.benchmark.schema import Table
from playground.benchmark.worker import CACHES
from playground.errors import ConfigError, HardwareError

FACTS = {"device": "a device", "versions": "1.0"}
PLAN = Plan(cache=True, commit="abc", note="a\n note")
WORKER = """
import json, os, sys, time
from pathlib import Path
from playground.benchmark import worker
job = json.loads(sys.argv[1]); measure, arguments = job["measure"], job["arguments"]
def row(**columns):
  print("ROW " + json.dumps({"quantity": "training_steps_per_s", "unit": "steps/s", **columns}), flush=True)
print("what a library says")
if measure == "train":
  gpu = os.environ["CUDA_VISIBLE_DEVICES"]
  for seed in arguments["seeds"]: row(seed=seed, value=100.0 + seed, conditions="timed", backend=gpu)
elif measure in ("lock", "caches"):
  def told(rows, **_):
    text = f"lock {rows.lock}" if measure == "lock" else ",".join(os.environ.get(name, "") for name in worker.CACHES)
    rows.emit("training_steps_per_s", 1.0, "", seed=1, conditions=text)
  worker.importlib.import_module = lambda name: type("Module", (), {"measure": told})
  worker.main()
elif measure == "read": row(seed=1, value=1.0, commit="earlier")
elif measure == "other": row(seed=1, value=1.0, device="another device")
elif measure == "user":
  (Path(job["folder"]) / "status.json").write_text('{"status": "failed", "reason": "that cannot be."}')
  sys.exit(2)
elif measure == "bug": sys.exit("Traceback of a bug")
elif measure == "sleep": row(seed=1, value=1.0); time.sleep(60)
elif measure == "wait":
  row(quantity="steps", value=os.getpid())
  time.sleep(60)
elif measure == "machine": row(value=2, device="a device", versions="1.0")
"""


@pytest.fixture(autouse=True)
def worker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
  """A worker that needs no JAX."""
  script = tmp_path / "worker.py"
  script.write_text(WORKER)
  monkeypatch.setattr(jobs, "WORKER", (sys.executable, str(script)))
  monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")


def job(measure: str, task: str = "A", seeds: tuple[int, ...] = (1, 2)) -> Measurement:
  columns = {"benchmark": "throughput", "task": task, "agent": "ppo", "who": "ours", "setting": ""}
  return Measurement(measure, {"seeds": list(seeds)}, columns, {"quantity": "training_steps_per_s"})


def test_rows_have_their_columns(tmp_path: Path):
  table = Table(tmp_path / "rows.csv")
  assert run_jobs([job("train")], table, FACTS, PLAN) == 0
  for seed in (1, 2):
    conditions = "timed; caches of earlier runs; a note"
    assert table.has(
      {"task": "A", "seed": seed, "value": 100.0 + seed, "commit": "abc", "conditions": conditions, **FACTS}
    )


def test_the_device_of_a_measurement_is_not_that_of_all(tmp_path: Path):
  table = Table(tmp_path / "rows.csv")
  own = job("train")
  own = dataclasses.replace(own, columns={**own.columns, "device": "its own"})
  assert run_jobs([own, job("train", "B")], table, FACTS, PLAN) == 0
  assert table.has({"task": "A", "device": "its own"}) and table.has({"task": "B", "device": "a device"})


def test_what_was_run_earlier_keeps_its_commit(tmp_path: Path):
  table = Table(tmp_path / "rows.csv")
  assert run_jobs([job("read")], table, FACTS, PLAN) == 0
  assert table.has({"seed": 1, "commit": "earlier"})


def test_what_another_machine_ran_is_in_the_table_once(tmp_path: Path):
  path = tmp_path / "rows.csv"
  for _ in range(2):
    assert run_jobs([job("other")], Table(path), FACTS, PLAN) == 0
  assert path.read_text().count("another device") == 1


def test_caches_are_empty_ones_unless_the_users_are_wanted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
  def caches(**plan: Any) -> list[str]:
    path = tmp_path / f"rows{plan}.csv"
    asks = [job("caches", name) for name in "AB"]
    assert run_jobs(asks, Table(path), FACTS, Plan(**{**vars(PLAN), **plan})) == 0
    return [row["conditions"].split(";")[0] for row in csv.DictReader(path.read_text().splitlines())]

  for name in CACHES:
    monkeypatch.setenv(name, "the user's")
  assert caches(cache=True) == [",".join(["the user's"] * len(CACHES))] * 2
  cold = caches(cache=False)
  assert len(set(cold)) == 2 and not any("the user's" in text for text in cold), "one for each process"


def test_only_what_is_missing_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  path = tmp_path / "rows.csv"
  run_jobs([job("train", seeds=(1,))], Table(path), FACTS, PLAN)
  run_jobs([job("train", seeds=(1, 2, 3))], Table(path), FACTS, PLAN)
  assert path.read_text().count("training_steps_per_s") == 3
  assert run_jobs([job("train", seeds=(1, 2, 3))], Table(path), FACTS, PLAN) == 0
  assert "1 of 1 are in" in capsys.readouterr().out
  assert path.read_text().count("training_steps_per_s") == 3
  other = {**FACTS, "device": "another device"}
  run_jobs([job("train", seeds=(1,))], Table(path), other, PLAN)
  run_jobs([job("train", seeds=(1,))], Table(path), FACTS, Plan(**{**vars(PLAN), "rerun": True}))
  assert path.read_text().count("training_steps_per_s") == 5


def test_a_failure_is_named_and_the_others_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  table = Table(tmp_path / "rows.csv")
  assert run_jobs([job("user", "U"), job("bug", "B"), job("train", "T")], table, FACTS, PLAN) == 1
  assert table.has({"task": "T", "seed": 2})
  captured = capsys.readouterr()
  assert "U ppo ours: that cannot be." in captured.err
  assert "Traceback of a bug" in captured.err
  assert "1 measured, 2 failed, 0 left" in captured.out


def test_the_time_is_kept_and_rows_so_far_stay(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
  table = Table(tmp_path / "rows.csv")
  plan = Plan(**{**vars(PLAN), "minutes": 4.0 / 60})
  assert run_jobs([job("sleep", "S"), job("train", "T")], table, FACTS, plan) == 3
  assert table.has({"task": "S", "seed": 1}) and not table.has({"task": "T"})
  said = capsys.readouterr().out
  assert "0 failed, 2 left" in said and "the same command measures the rest" in said
  again = Plan(**{**vars(plan), "minutes": 1e-9, "rerun": True})
  assert run_jobs([job("train", "T")], table, FACTS, again) == 3
  assert "name what is left in tasks=, because rerun=true starts over" in capsys.readouterr().out


def test_workers_are_spread_over_gpus(tmp_path: Path):
  path = tmp_path / "rows.csv"
  plan = Plan(**{**vars(PLAN), "workers": 2, "gpus": (4, 7)})
  assert run_jobs([job("train", name, (1,)) for name in "ABCDEFGH"], Table(path), FACTS, plan) == 0
  table = Table(path)
  assert all(table.has({"task": name}) for name in "ABCDEFGH")
  assert table.has({"backend": "4"}) and table.has({"backend": "7"})


def test_more_workers_than_gpus_take_turns_at_each(tmp_path: Path):
  def locks(**plan: Any) -> list[str]:
    path = tmp_path / f"rows{plan}.csv"
    jobs = [job("lock", name, (1,)) for name in "ABCD"]
    assert run_jobs(jobs, Table(path), FACTS, Plan(**{**vars(PLAN), **plan})) == 0
    return [line.split("lock ")[1].split(";")[0] for line in path.read_text().splitlines() if "lock " in line]

  assert set(locks(workers=1)) == set(locks(workers=2, gpus=(4, 7))) == {"None"}
  assert {Path(lock).name for lock in locks(workers=4, gpus=(4, 7))} <= {"gpu4.lock", "gpu7.lock"}
  whole = locks(workers=3)
  assert len(whole) == 4 and len(set(whole)) == 1 and whole[0] != "None", "one lock, the machine's"


def test_all_of_a_topology_takes_turns_at_the_machine(tmp_path: Path):
  of_it = Topology(tasks=("CartpoleBalance",), num_timesteps=5000, seeds=1, workers=3).jobs(2)
  assert {job.measure for job in of_it} == {"training", "runs:whole"}
  path = tmp_path / "rows.csv"
  jobs = [dataclasses.replace(job, measure="lock") for job in of_it]
  assert run_jobs(jobs, Table(path), FACTS, Plan(**{**vars(PLAN), "workers": 3})) == 0
  locks = [line.split("lock ")[1].split(";")[0] for line in path.read_text().splitlines() if "lock " in line]
  assert len(locks) == 6 and len(set(locks)) == 1 and locks[0] != "None"


def test_the_machine_is_asked_in_a_process_of_its_own(monkeypatch: pytest.MonkeyPatch):
  assert probe([], ()) == (2, {"device": "a device", "versions": "1.0"})
  monkeypatch.setattr(jobs, "Measurement", lambda _, *rest: Measurement("user", *rest))
  with pytest.raises(HardwareError, match="that cannot be"):
    probe([], ())


def test_a_gpu_that_the_machine_lacks_is_named(monkeypatch: pytest.MonkeyPatch):
  with pytest.raises(ConfigError, match=r"^gpus=\[0\]: this machine has no GPU\.$"):
    probe([], (0,))
  monkeypatch.setattr(jobs, "query_gpus", lambda fields: ["0", "1"])
  with pytest.raises(ConfigError, match=r"^gpus=\[1, 2\]: this machine has the GPUs 0, 1\.$"):
    probe([], (1, 2))


def test_what_was_started_ends_with_us(tmp_path: Path):
  main = tmp_path / "main.py"
  table = tmp_path / "rows.csv"
  main.write_text(f"""
import signal, sys
from pathlib import Path
from playground.benchmark import jobs
from playground.benchmark.schema import Table
signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
jobs.WORKER = {jobs.WORKER!r}
columns = dict(benchmark="throughput", task="A", agent="ppo", who="ours", setting="")
job = jobs.Measurement("wait", {{}}, columns, {{"quantity": "steps"}})
sys.exit(jobs.run_jobs([job], Table(Path({str(table)!r})), {FACTS!r}, jobs.Plan(cache=True)))
""")
  process = subprocess.Popen([sys.executable, str(main)], stdout=subprocess.PIPE, text=True)
  assert process.stdout is not None
  worker = int(process.stdout.readline().split()[-2].replace(",", ""))
  process.terminate()
  assert process.wait(60) == 143
  deadline = time.monotonic() + 60
  while Path(f"/proc/{worker}").exists() and time.monotonic() < deadline:
    time.sleep(0.05)
  assert not Path(f"/proc/{worker}").exists()
