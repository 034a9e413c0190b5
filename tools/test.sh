#!/usr/bin/env bash
# The linters, then the tests in parallel, one worker per core; arguments go to pytest (`-n 0`: one process).
# Tests marked `long` run only when asked for: `make test-long`, or ARGS="-m long".
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
tools/lint.sh
. .venv/env.sh
# Files stay whole, as their tests share graphs; conftest.py puts the longest files first.
exec python -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations=25 "$@"
