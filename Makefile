# `make help` lists the targets. PYTHON=/path/to/python3.12 chooses the interpreter, ARGS= is passed on.
SHELL := /bin/bash
RUN_SETUP = $${PYTHON:-python3} tools/setup.py

.PHONY: help setup demo torcs test test-long fuzz lint docs wheel clean

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup:  ## create the virtual environment and build the ROS workspace, once
	@$(RUN_SETUP)

demo:  ## run the whole method, small, into demo/, while the rest is set up (ARGS="..." for `ds demo`)
	@./ds demo --out demo $(ARGS)

torcs:  ## build and install the simulator torcs of plugins/ (docs/torcs.md says what it needs)
	@./tools/torcs.sh

test:  ## run the linters and the tests (ARGS="..." for pytest)
	@$(RUN_SETUP) --dev
	@./tools/test.sh $(ARGS)

test-long:  ## run the tests that take minutes each (CONTRIBUTING.md says what they cover)
	@$(RUN_SETUP) --dev
	@./tools/test.sh -m long --timeout 1800 $(ARGS)

fuzz:  ## damage received files by the ten thousand (DS_FUZZ=N inputs of each kind, ARGS="..." for pytest)
	@$(RUN_SETUP) --dev
	@. .venv/env.sh && DS_FUZZ=$${DS_FUZZ:-20000} python -m pytest tests/fuzz -n auto --maxprocesses 4 $(ARGS)

lint:  ## run the linters only
	@$(RUN_SETUP) --dev
	@./tools/lint.sh

docs:  ## build the documentation's site into build/site; a broken link fails
	@$(RUN_SETUP) --docs
	@. .venv/env.sh && NO_MKDOCS_2_WARNING=1 python -m mkdocs build --strict

wheel:  ## build the wheel of all packages that need no ROS into dist/
	@$(RUN_SETUP) --dev
	@./tools/wheel.sh

clean:  ## remove what set-up and the tools created; results stay
	rm -rf .venv build dist ros_ws/build ros_ws/install ros_ws/log .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find src tests tools benchmarks -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true
