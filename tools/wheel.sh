#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Builds the wheel of all packages that need no ROS into dist/. Arguments go to hatchling (`-d DIR`: another folder).
set -euo pipefail
cd "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/.."
exec "${PYTHON:-.venv/bin/python}" -m hatchling build -t wheel "$@"
