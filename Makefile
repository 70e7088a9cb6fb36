# On a fresh machine with git, make and Python >= 3.11, `make run` trains the default run and `make test` tests;
# each sets up what it needs first. `make run ARGS="env=CartpoleSwingup seed=2"` hands ARGS to playground-run.

PYTHON ?= python3
ARGS ?=
BIN := .venv/bin
INSTALLED := .venv/.installed

# Compiling is most of what the tests do. Git ignores the folders; nothing is lost with them but time. What one worker
# has compiled, single operations too, the other one reads. XLA is told to compile fast rather than fast code;
# `make test-slow` tests what users run, but for OLD_FLAGS: without, JAX 0.10 takes minutes for a step of PandaRobotiqPushCube.
CACHES := JAX_COMPILATION_CACHE_DIR="$(CURDIR)/.pytest_cache/xla" WARP_CACHE_PATH="$(CURDIR)/.pytest_cache/warp" \
  JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS=0 JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES=-1
FAST_COMPILE = XLA_FLAGS="--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true \
  --xla_cpu_parallel_codegen_split_count=1 $(OLD_FLAGS) $$XLA_FLAGS"
# JAX 0.11, which is for Python 3.12 and newer, has lost this one, and XLA ends a process over a flag it does not know.
OLD_FLAGS = $(shell $(BIN)/python -c 'import sys; sys.version_info < (3, 12) and print("--xla_cpu_use_fusion_emitters=false")')

.DEFAULT_GOAL := setup
.PHONY: setup run test test-slow test-rsl-rl test-slurm lint catalog docs wheel

setup: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	@test -x $(BIN)/python || $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
	  { echo "error: $(PYTHON) is not Python 3.11 or newer: name one with PYTHON=<command>." >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $@

run: setup
	$(BIN)/playground-run $(ARGS)

test: setup
	$(CACHES) $(FAST_COMPILE) $(BIN)/python -m pytest -q -n 2 --dist worksteal $(ARGS)

test-slow: setup
	$(CACHES) XLA_FLAGS="$(OLD_FLAGS) $$XLA_FLAGS" $(BIN)/python -m pytest -q -m slow $(ARGS)

# RSL-RL brings torch, which `setup` leaves out: without it these tests are skipped.
test-rsl-rl: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[rsl-rl]'
	@$(BIN)/python -c 'import rsl_rl, torch'
	$(CACHES) $(BIN)/python -m pytest -q -m '' tests/adapters/test_rsl_rl.py $(ARGS)

# A Slurm of one node on this machine, started and ended by the tests; without its programs they are skipped. On Debian
# and Ubuntu: apt-get install slurmctld slurmd slurm-client munge, which `make test-slurm SUDO=sudo` (or SUDO=env) does.
test-slurm: setup
	$(if $(SUDO),$(SUDO) apt-get install --yes --no-install-recommends slurmctld slurmd slurm-client munge)
	$(CACHES) $(BIN)/python -m pytest -q -m slow tests/sweep/test_slurm_cluster.py $(ARGS)

lint: setup
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

# What `playground list` shows; after a change of a task, a tuned set or a reference result.
catalog: setup
	JAX_PLATFORMS=cpu $(BIN)/python -m playground.catalog

# The site is site/index.html. Strict: a link or a reference that leads nowhere is an error (mkdocs.yml).
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build
	@echo "docs: $(CURDIR)/site/index.html"

wheel: setup
	$(BIN)/python -m build --wheel
