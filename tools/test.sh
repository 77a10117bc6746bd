#!/usr/bin/env bash
# Run the tests of all packages through colcon; the last line says what came of them.
#
#     tools/test.sh [PACKAGE...]
set -uo pipefail
cd "$(dirname "$0")/.."
. tools/env.sh || exit 1
export MPLBACKEND=Agg

rm -f build/*/pytest.xml log/tests.txt
colcon test ${1:+--packages-select "$@"}
status=$?
[[ $status -eq 0 ]] || colcon test-result --verbose
mkdir -p log
python tools/count_tests.py "$@" | tee log/tests.txt
counted=${PIPESTATUS[0]}
[[ $status -eq 0 && $counted -eq 0 ]]
