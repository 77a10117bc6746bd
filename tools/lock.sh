#!/usr/bin/env bash
# Resolve requirements/*.in anew into requirements/*.txt: exact versions and hashes for
# Python 3.10 to 3.13, x86-64 Linux. For maintainers; needs uv on the PATH (or UV=...).
set -euo pipefail
cd "$(dirname "$0")/../requirements"
all=$(mktemp)
trap 'rm -f "$all"' EXIT

compile() {  # arguments of uv pip compile
    "${UV:-uv}" pip compile --quiet --universal --python-version 3.10 \
        --generate-hashes --no-strip-extras --no-header --no-emit-index-url --no-annotate "$@"
}

compile ./*.in --output-file "$all"  # one resolution, so that the parts agree
for part in base build ros test oracles cluster hardware bench docs; do
    compile --constraint "$all" "$part.in" --output-file "$part.txt" --upgrade
done
# Every line carries the environment that pyproject.toml fixes and tools/setup.sh checks: leave it out.
machine="platform_machine == 'x86_64' and platform_python_implementation == 'CPython'"
machine+=" and sys_platform == 'linux'"
sed -i -e "s/ and $machine//" -e "s/ and python_full_version < '3.14'//" \
    -e "s/ ; python_full_version < '3.14'//" ./{base,build,ros,test,oracles,cluster,hardware,bench,docs}.txt
if grep -nE '://' ./*.txt; then
    echo 'an address got into a lock file' >&2
    exit 1
fi
