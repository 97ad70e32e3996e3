# `make demo` and `make test` set up everything they need first; both can be run again at any time.
SHELL := /bin/bash
RIP := .venv/bin/rip
WORKERS := 3

.PHONY: setup demo studio test lint lerobot clean

setup:
	@scripts/setup.sh

# ARGS are passed on: make demo ARGS="--task push-cube --seed 3"
demo: setup
	@$(RIP) demo $(ARGS)

# The page on which a person demonstrates: make studio ARGS="--task pick-banana"
studio: setup
	@$(RIP) studio $(ARGS)

# Installs nothing. Benchmarks and scripts are held to names and arguments that exist, not to every type.
LOOSE := $(addprefix --disable-error-code=,arg-type assignment import-untyped misc operator return-value type-var union-attr var-annotated)
lint:
	@[ -x .venv/bin/ruff ] && [ -x .venv/bin/mypy ] || { echo "the linters are not installed; run: make setup" >&2; exit 1; }
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy
	.venv/bin/mypy --cache-dir .mypy_cache/scripts $(LOOSE) benchmarks scripts

# The tests on three workers, each with one thread, and the share of lines that they run. Tests of real time wait, so three
# keep two cores busy; with less than 12 GB of memory: make test WORKERS=2
# A single test: make test ARGS="tests/test_demo.py -k plan"
test: export OMP_NUM_THREADS := 1
test: export OPENBLAS_NUM_THREADS := 1
test: setup
	@$(MAKE) --no-print-directory lint
	.venv/bin/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --cov --cov-report= $(ARGS)
	@.venv/bin/python scripts/coverage_table.py

# The LeRobot plugins, in an environment of their own (6 GB): the commands of docs/lerobot.md as they stand there, and tests.
LEROBOT := .venv-lerobot
lerobot: setup
	plugins/setup.sh $(LEROBOT)
	MUJOCO_GL=egl $(LEROBOT)/bin/python -m pytest -p no:cacheprovider tests/test_lerobot_plugin.py tests/test_robots_lerobot.py
	.venv/bin/python scripts/lerobot_end_to_end.py --lerobot $(LEROBOT)

clean:
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage .coverage.*
