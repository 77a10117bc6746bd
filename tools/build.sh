#!/usr/bin/env bash
# Build all packages under src/ into install/.
set -euo pipefail
cd "$(dirname "$0")/.."
CG_NO_OVERLAY=1 . tools/env.sh
# Pure Python needs no prefix below; colcon would warn that the wheels have no setup script.
[[ -n ${ROS_DISTRO:-} ]] || unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH
colcon list | awk '$3 != "(ros.ament_python)" {print "build: colcon takes " $1 " for " $3 ", its package.xml must be invalid"; bad = 1}
    END {exit bad}' >&2
colcon build
