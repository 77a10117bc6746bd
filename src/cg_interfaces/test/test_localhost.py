"""DDS is on this machine only, unless the environment asks for more."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cg_interfaces.domains import own_domain
from cg_interfaces.localhost import LOCALHOST, NETWORK, PEERS, PROFILE, RANGE, keep_to_localhost

# A node as `run` starts it, without a shell that prepared anything. It prints the addresses and
# ports on which it receives: DDS has these by rule, below those that Linux hands out to senders.
NODE = """
import os, sys
import rclpy
from cg_interfaces import ros
from cg_interfaces.settings import Settings

def receivers():
    mine = set()
    for name in os.listdir('/proc/self/fd'):
        try:
            mine.add(os.readlink(f'/proc/self/fd/{name}'))
        except OSError:
            pass
    for line in open('/proc/self/net/udp').readlines()[1:]:
        words = line.split()
        address, port = (bytes.fromhex(part) for part in words[1].split(':'))
        port = int.from_bytes(port, 'big')
        if f'socket:[{words[9]}]' in mine and port < 32768:
            yield '.'.join(str(byte) for byte in reversed(address)), port

class Ears(rclpy.node.Node):
    finished = False

    def __init__(self):
        super().__init__('ears')

    def poll(self):
        for address, port in receivers():
            print(address, port)
        self.finished = True
        return 0.0

sys.exit(ros.run(Ears, Settings, []))
"""


@pytest.mark.parametrize(
    ('given', 'reach', 'profile'),
    [
        ({}, 'LOCALHOST', LOCALHOST),
        ({RANGE: ''}, 'LOCALHOST', LOCALHOST),
        ({RANGE: 'LOCALHOST', PROFILE: str(NETWORK)}, 'LOCALHOST', LOCALHOST),
        ({RANGE: 'SUBNET'}, 'SUBNET', NETWORK),
        ({RANGE: 'SUBNET', PROFILE: str(LOCALHOST)}, 'SUBNET', NETWORK),
        ({PEERS: '10.0.0.7'}, 'LOCALHOST', NETWORK),
        ({PROFILE: '/mine.xml'}, 'LOCALHOST', Path('/mine.xml')),
    ],
)
def test_only_who_asks_leaves_the_machine(given, reach, profile):
    environment = dict(given)
    keep_to_localhost(environment)
    assert environment == given | {RANGE: reach, PROFILE: str(profile)}


def receivers(**given):
    """Addresses on which a node receives."""
    pytest.importorskip('rclpy')
    with own_domain() as domain:
        kept = {k: v for k, v in os.environ.items() if k not in (RANGE, PEERS, PROFILE)}
        done = subprocess.run(
            [sys.executable, '-c', NODE], env=kept | {'ROS_DOMAIN_ID': str(domain)} | given,
            capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
    found = dict(line.split()[::-1] for line in done.stdout.splitlines())
    assert found, 'the node receives nowhere'
    return set(found.values())


@pytest.mark.skipif(not Path('/proc/self/net/udp').exists(), reason='sockets are read from /proc')
def test_nobody_from_outside_reaches_a_node():
    assert receivers() == {'127.0.0.1'}
    assert '0.0.0.0' in receivers(**{RANGE: 'SUBNET'})


def test_the_shell_chooses_as_nodes_do():
    """tools/env.sh sets the same, for commands that are not ours."""
    root = Path(__file__).resolve().parents[3]
    if not (root / 'tools' / 'env.sh').is_file():
        pytest.skip('the package is not in its workspace')
    for given in ({}, {RANGE: 'SUBNET'}, {PEERS: '10.0.0.7'}, {PROFILE: '/mine.xml'}):
        kept = {k: v for k, v in os.environ.items() if k not in (RANGE, PEERS, PROFILE)}
        script = f'. {root}/tools/env.sh && echo "${RANGE} ${PROFILE}"'
        done = subprocess.run(
            ['bash', '-c', script], env=kept | given, capture_output=True, text=True, check=True
        )
        expected = dict(given)
        keep_to_localhost(expected)
        reach, profile = done.stdout.split()
        assert (reach, Path(profile).name) == (expected[RANGE], Path(expected[PROFILE]).name)
        assert Path(profile).is_file() or profile == '/mine.xml'
