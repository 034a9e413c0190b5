#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The linters, and if they find nothing the tests in parallel: one worker per core and one more, as many tests wait for
# processes; at most four. Arguments go to pytest (`-n 0`: one process).
# Tests marked `long` run only when asked for: `make test-long`, or ARGS="-m long".
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
tools/lint.sh
. .venv/env.sh
# Where an image sets it, each of the hundreds of processes of the tests compiles its modules again.
unset PYTHONDONTWRITEBYTECODE
# Files stay whole, as their tests share graphs; conftest.py puts the longest files first. A worker that dies ends the
# tests and names the one that it was running: with replaced workers, pytest-xdist's loadfile waits forever.
workers=$(nproc)
exec python -m pytest -n $((workers < 4 ? workers + 1 : 4)) --max-worker-restart 0 --dist loadfile \
  --no-loadscope-reorder --durations=25 "$@"
