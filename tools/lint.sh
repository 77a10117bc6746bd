#!/usr/bin/env bash
# Style, types, and what must not get into a file.
set -uo pipefail
cd "$(dirname "$0")/.."
. tools/env.sh || exit 1
status=0
ruff check . || status=1
ruff format --check . || status=1
mypy src/*/cg_* || status=1
exit $status
