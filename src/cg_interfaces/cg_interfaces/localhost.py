"""DDS stays on this machine unless the environment asks for more.

It asks by ROS_AUTOMATIC_DISCOVERY_RANGE, with anything but LOCALHOST, or by ROS_STATIC_PEERS.
LOCALHOST alone says whom a node looks for. FastDDS then still listens on every interface, and lets
in whoever names this machine among its own static peers; so a profile binds what receives to
127.0.0.1. Another middleware keeps to its own reading of LOCALHOST.
"""

from collections.abc import MutableMapping
from pathlib import Path

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
PEERS = 'ROS_STATIC_PEERS'
PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
LOCALHOST, NETWORK = (
    Path(__file__).with_name(f'fastdds_{name}.xml') for name in ('localhost', 'network')
)


def keep_to_localhost(environment: MutableMapping[str, str]) -> None:
    """Set what is not set yet; a profile of ours follows the range, another one stays."""
    reach = environment.get(RANGE) or 'LOCALHOST'
    environment[RANGE] = reach
    asked = reach != 'LOCALHOST' or environment.get(PEERS)
    if Path(environment.get(PROFILE, '')).name in ('', LOCALHOST.name, NETWORK.name):
        environment[PROFILE] = str(NETWORK if asked else LOCALHOST)
