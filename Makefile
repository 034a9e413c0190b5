# `make help` lists the targets. PYTHON=/path/to/python3.12 chooses the interpreter, ARGS= is handed on.
SHELL := /bin/bash
RUN_SETUP = $${PYTHON:-python3} tools/setup.py

.PHONY: help setup test fuzz lint demo clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup:  ## virtual environment and colcon workspace, once
	@$(RUN_SETUP)

demo: setup  ## the whole method, small, into demo/ (ARGS="..." for `ds demo`)
	@./ds demo --out demo $(ARGS)

test:  ## linters and all tests (ARGS="..." for pytest)
	@$(RUN_SETUP) --dev
	@./tools/test.sh $(ARGS)

fuzz:  ## damaged inputs for every reader of files (FUZZ=20000 for so many of each kind)
	@$(RUN_SETUP) --dev
	@. .venv/env.sh && DS_FUZZ=$${FUZZ:-20000} python -m pytest tests/fuzz $(ARGS)

lint:  ## linters only
	@$(RUN_SETUP) --dev
	@./tools/lint.sh

clean:  ## remove what set-up and the tools made; results stay
	rm -rf .venv ros_ws/build ros_ws/install ros_ws/log .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests tools benchmarks -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true
