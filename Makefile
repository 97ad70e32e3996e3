# `make demo` and `make test` set up everything they need first; both can be run again at any time.
SHELL := /bin/bash
RIP := .venv/bin/rip

.PHONY: setup demo test lint clean

setup:
	@scripts/setup.sh

# ARGS are passed on: make demo ARGS="--task push-cube --seed 3"
demo: setup
	@$(RIP) demo $(ARGS)

lint: setup
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy

test: lint
	.venv/bin/python -m pytest $(ARGS)

clean:
	rm -rf .venv build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
