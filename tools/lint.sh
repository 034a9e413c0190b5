#!/usr/bin/env bash
# The linters, as `make lint` and `make test` run them.
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
. .venv/env.sh
ruff check .
mypy
