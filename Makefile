# On a fresh machine with git, make and Python >= 3.11, `make run` trains the default run and `make test` tests;
# each sets up what it needs first. `make run ARGS="env=CartpoleSwingup seed=2"` hands ARGS to playground-run.

PYTHON ?= python3
ARGS ?=
BIN := .venv/bin
INSTALLED := .venv/.installed

# Compiling is most of what the tests do. Git ignores the folder; nothing is lost with it but time.
TEST_ENV := JAX_COMPILATION_CACHE_DIR="$(CURDIR)/.pytest_cache/xla" WARP_CACHE_PATH="$(CURDIR)/.pytest_cache/warp"

.DEFAULT_GOAL := setup
.PHONY: setup run test test-slow test-rsl-rl lint wheel

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
	$(TEST_ENV) $(BIN)/python -m pytest -q -n 2 --dist loadfile $(ARGS)

test-slow: setup
	$(TEST_ENV) $(BIN)/python -m pytest -q -m slow $(ARGS)

# RSL-RL brings torch, which `setup` leaves out: without it these tests are skipped.
test-rsl-rl: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[rsl_rl]'
	$(TEST_ENV) $(BIN)/python -m pytest -q -m '' -k rsl_rl tests/adapters tests/learning tests/runs $(ARGS)

lint: setup
	$(BIN)/ruff check
	$(BIN)/pyright

wheel: setup
	$(BIN)/python -m build --wheel
