#!/usr/bin/env bash
# The linters, then all tests; arguments go to pytest.
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
tools/lint.sh
. .venv/env.sh
exec python -m pytest "$@"
