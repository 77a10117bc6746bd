# The environment of this workspace, for bash and zsh:  source tools/env.sh
#
# Puts .venv and the built packages on the paths and keeps ROS 2 on this machine. Variables that are
# set already win: ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE, FASTRTPS_DEFAULT_PROFILES_FILE,
# ROS_LOG_DIR. With CG_DEV=1 the sources under src/ come first, so that nothing needs a build.

_cg_here=${BASH_SOURCE[0]:-$0}
_cg_root=$(cd "$(dirname "$_cg_here")/.." && pwd)

if [ ! -x "$_cg_root/.venv/bin/python" ]; then
    echo "env: there is no .venv yet; run: make setup" >&2
    return 1
fi

# A half-inherited start-up of the ROS wheels fails, the others make Python or colcon misbehave.
unset _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONHOME PYTHONDONTWRITEBYTECODE

export VIRTUAL_ENV=$_cg_root/.venv
case ":$PATH:" in
    *":$VIRTUAL_ENV/bin:"*) ;;
    *) export PATH="$VIRTUAL_ENV/bin:$PATH" ;;
esac

if [ -z "${ROS_DISTRO:-}" ]; then
    # The wheels are a ROS prefix that has no setup script.
    export AMENT_PREFIX_PATH=$VIRTUAL_ENV CMAKE_PREFIX_PATH=$VIRTUAL_ENV
fi
if [ -f "$_cg_root/install/local_setup.bash" ] && [ -z "${CG_NO_OVERLAY:-}" ]; then
    case $- in *u*) _cg_nounset=1; set +u ;; *) _cg_nounset= ;; esac
    if [ -n "${ZSH_VERSION:-}" ]; then
        . "$_cg_root/install/local_setup.zsh"
    else
        . "$_cg_root/install/local_setup.bash"
    fi
    [ -z "$_cg_nounset" ] || set -u
fi
if [ -n "${CG_DEV:-}" ]; then
    for _cg_package in "$_cg_root"/src/*/; do
        PYTHONPATH=${_cg_package%/}${PYTHONPATH:+:$PYTHONPATH}
    done
    export PYTHONPATH
fi

export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
case ${FASTRTPS_DEFAULT_PROFILES_FILE:-} in # as cg_interfaces/localhost.py has it
    '' | */fastdds_localhost.xml | */fastdds_network.xml)
        _cg_profile=localhost
        [ "$ROS_AUTOMATIC_DISCOVERY_RANGE${ROS_STATIC_PEERS:-}" = LOCALHOST ] || _cg_profile=network
        export FASTRTPS_DEFAULT_PROFILES_FILE=$_cg_root/src/cg_interfaces/cg_interfaces/fastdds_$_cg_profile.xml
        ;;
esac
export ROS_LOG_DIR=${ROS_LOG_DIR:-$_cg_root/log/ros}
# Our matrices are small and our work runs in one process per core: threads of BLAS only get in the way.
export OPENBLAS_NUM_THREADS=${OPENBLAS_NUM_THREADS:-1}

unset _cg_here _cg_root _cg_package _cg_nounset _cg_profile
