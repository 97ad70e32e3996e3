# `make demo` and `make test` set up everything they need first; both can be run again at any time.
SHELL := /bin/bash
RIP := .venv/bin/rip

.PHONY: setup demo test coverage lint clean

setup:
	@scripts/setup.sh

# ARGS are passed on: make demo ARGS="--task push-cube --seed 3"
demo: setup
	@$(RIP) demo $(ARGS)

# Installs nothing.
lint:
	@[ -x .venv/bin/ruff ] && [ -x .venv/bin/mypy ] || { echo "the linters are not installed; run: make setup" >&2; exit 1; }
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

test: setup
	@$(MAKE) --no-print-directory lint
	.venv/bin/python -m pytest $(ARGS)

# The tests, with the share of lines that they run: 11 to 33% more processor time on Python 3.11.
coverage:
	@$(MAKE) --no-print-directory test ARGS="--cov --cov-report=term:skip-covered $(ARGS)"

clean:
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage
