#!/usr/bin/env bash
# Prepare .venv from the lock files, and do nothing when it is up to date.
#
#     tools/setup.sh [PART...]   parts: base build ros test oracles cluster hardware (all of these by default), bench, docs
#
# PYTHON=/path/to/python3 selects the interpreter. In a shell with ROS 2 Jazzy sourced, that ROS is
# used: .venv then sees the system's packages and the part 'ros' is left out.
set -euo pipefail
cd "$(dirname "$0")/.."

fail() {
    echo "setup: $*" >&2
    exit 1
}

# What a shell may hand down and pip, venv or the ROS wheels stumble over.
unset PYTHONHOME PIP_USER PIP_TARGET PIP_PREFIX PIP_REQUIREMENT PIP_CONSTRAINT
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONDONTWRITEBYTECODE

command -v git >/dev/null || fail 'git is missing; install it (Debian, Ubuntu: apt install git).'

machine="$(uname -s) $(uname -m)"
ros=${ROS_DISTRO:-}
[[ -z $ros || $ros == jazzy ]] ||
    fail "this shell has ROS_DISTRO=$ros, but only jazzy works; open a shell without it, or source Jazzy."
[[ -n $ros || $machine == 'Linux x86_64' ]] ||
    fail "ROS 2 comes as wheels for Linux x86_64 only, this is $machine; install ROS 2 Jazzy and source it."

version() { "$1" -c 'import sys; print("%d.%d.%d" % sys.version_info[:3])' 2>/dev/null; }
supported() { [[ $(version "$1") =~ ^3\.1[0-3]\. ]]; }

python=${PYTHON:-}
if [[ -z $python ]]; then
    python=python3
    # A .venv that stands is kept, whatever python3 is today.
    if [[ -z $ros && -f .venv/.made_for ]] && supported .venv/bin/python; then
        python=$(.venv/bin/python -c 'import sys; print(sys._base_executable)')
    fi
    for candidate in python3.12 python3.11 python3.13 python3.10; do
        supported "$python" || [[ -n $ros ]] || python=$candidate
    done
    supported "$python" || python=python3
fi
command -v "$python" >/dev/null || fail "there is no $python; install Python 3.10 to 3.13, or set PYTHON=..."
supported "$python" ||
    fail "$python is Python $(version "$python" || echo '(broken)'), needed is 3.10 to 3.13; set PYTHON=..."
"$python" -c 'import ensurepip, venv' 2>/dev/null ||
    fail "$python cannot make virtual environments; install its venv module (Debian, Ubuntu: apt install python3-venv)."
[[ -z $ros ]] || "$python" -c 'from rclpy.node import Node' 2>/dev/null ||
    fail "ROS_DISTRO=jazzy is set, but $python cannot import rclpy; source Jazzy's setup.bash, or unset ROS_DISTRO."

made_for="$(version "$python") ${ros:-wheels} $PWD"
if [[ $(cat .venv/.made_for 2>/dev/null) != "$made_for" ]]; then
    source='ROS 2 from wheels'
    [[ -z $ros ]] || source='the sourced ROS 2'
    echo "setup: making .venv with Python $(version "$python") and $source"
    # Installed scripts name the interpreter, so the build goes too.
    rm -rf .venv build install
    "$python" -m venv ${ros:+--system-site-packages} .venv >/dev/null ||
        fail "$python -m venv failed; is the disk full or the directory read-only?"
    # Tools that look for packages stay out.
    touch .venv/COLCON_IGNORE
    echo "$made_for" >.venv/.made_for
fi

parts=("$@")
[[ $# -gt 0 ]] || parts=(base build ros test oracles cluster hardware)
missing=()
for part in "${parts[@]}"; do
    lock=requirements/$part.txt
    [[ -f $lock ]] || fail "there is no part '$part'; parts are base build ros test oracles cluster hardware bench docs."
    [[ $part == ros && -n $ros ]] && continue
    [[ $part == oracles && $machine != 'Linux x86_64' ]] && continue
    cmp -s "$lock" ".venv/.installed_$part" || missing+=("$part")
done
[[ ${#missing[@]} -gt 0 ]] || exit 0

echo "setup: installing ${missing[*]} (some minutes the first time)"
locks=("${missing[@]/#/--requirement=requirements/}")
if ! .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-input \
    --require-hashes "${locks[@]/%/.txt}" >.venv/pip.log 2>&1; then
    reason=$(grep -m1 -E '^ *(ERROR|error):' .venv/pip.log || tail -n1 .venv/pip.log)
    fail "pip could not install (${reason}); check network, proxy and disk; all of it is in .venv/pip.log."
fi
for part in "${missing[@]}"; do
    cp "requirements/$part.txt" ".venv/.installed_$part"
done
