#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds two wheels into a folder, dist/ if left out: all packages that need no ROS, and the large networks.
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
python=${PYTHON:-$PWD/.venv/bin/python}
folder=$(realpath -m "${1:-dist}")
for project in . plugins/networks; do
  (cd "$project" && "$python" -m hatchling build -t wheel -d "$folder")
done
