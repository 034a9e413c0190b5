#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Sources the workspace, then becomes the command: `ds ...`, `ros2 run ...`, or anything else.
set -e
root=$(dirname "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")")
[[ ! -f /opt/ros/jazzy/setup.bash ]] || . /opt/ros/jazzy/setup.bash
. "$root/.venv/env.sh"
[[ ${1:-} != ds ]] || set -- python -m ds_cli.main "${@:2}"
exec "$@"
