#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# The linters, as `make lint`, `make test` and the pre-commit hooks run them.
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
. .venv/env.sh
ruff check .
ruff format --check .
codespell
mypy
