"""The SROS2 policy: its form, and that it allows each node what it does and nothing else.

The form is that of the schema of ros2/sros2, policy version 0.2.0, said here in a table.
"""

import fnmatch
import importlib
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

POLICY = Path(__file__).resolve().parents[1] / 'security' / 'compass_gait.policy.xml'
# Element -> attributes that it must have, those that it may have, its children. None: text.
FORM = {
    'policy': ({'version'}, set(), {'enclaves'}),
    'enclaves': (set(), set(), {'enclave'}),
    'enclave': ({'path'}, set(), {'profiles'}),
    'profiles': (set(), {'type'}, {'profile'}),
    'profile': ({'ns', 'node'}, set(), {'topics', 'services', 'actions'}),
    'topics': (set(), {'publish', 'subscribe'}, {'topic'}),
    'services': (set(), {'reply', 'request'}, {'service'}),
    'actions': (set(), {'call', 'execute'}, {'action'}),
    'topic': (set(), set(), None),
    'service': (set(), set(), None),
    'action': (set(), set(), None),
}
KINDS = {
    'publish': 'publisher',
    'subscribe': 'subscriber',
    'reply': 'service',
    'request': 'client',
}
OPERATOR = 'operator'
CONTROLLERS = ('balance', 'excitation', 'playback', 'tree_controller', 'tvlqr')


def policy():
    return ET.parse(POLICY).getroot()


def allowed():
    """Node -> kind of use -> absolute names."""
    found = {}
    for enclave in policy().iter('enclave'):
        uses = found[enclave.get('path').rpartition('/')[2]] = {kind: set() for kind in KINDS}
        for profile in enclave.iter('profile'):
            for rules in profile:
                for kind in rules.attrib:
                    uses[kind] |= {e.text.replace('~', f'/{profile.get("node")}') for e in rules}
    return found


def test_the_file_has_the_form_of_the_schema():
    assert policy().tag == 'policy'
    assert policy().get('version') == '0.2.0'
    for element in policy().iter():
        needed, possible, children = FORM[element.tag]
        assert needed <= set(element.attrib) <= needed | possible, element.tag
        if children is None:
            assert len(element) == 0
            assert element.text == element.text.strip() != ''
            continue
        assert len(element) > 0, f'<{element.tag}> is empty'
        assert {child.tag for child in element} <= children
        assert not (element.text or '').strip()
        if possible and element.tag != 'profiles':
            assert element.attrib
            assert set(element.attrib.values()) == {'ALLOW'}
            names = [child.text for child in element]
            assert names == sorted(set(names))


def test_an_enclave_is_one_node_and_has_its_name():
    runs = importlib.import_module('cg_bringup.runs')
    paths = [enclave.get('path') for enclave in policy().iter('enclave')]
    assert len(set(paths)) == len(paths)
    for enclave in policy().iter('enclave'):
        (profile,) = enclave.iter('profile')
        assert profile.get('ns') == '/'
        assert runs.enclave_arguments(profile.get('node')) == ['--enclave', enclave.get('path')]


def test_only_the_gate_commands_the_drive_and_only_owners_ask_in_their_name():
    """Taken as DDS takes it, where an expression may have wildcards."""

    def may_publish(topic):
        return {
            node for node, uses in allowed().items()
            if any(fnmatch.fnmatchcase(topic, name) for name in uses['publish'])
        }  # fmt: skip

    assert may_publish('/torque_command') == {'safety_gate'}
    assert may_publish('/torque_request') == set(CONTROLLERS)
    for controller in CONTROLLERS:
        assert may_publish(f'/torque_request/{controller}') == {controller}


# What the nodes really do


@pytest.fixture(scope='module')
def used(tmp_path_factory):
    """Node -> kind of use -> absolute names, over all that the runners start."""
    rclpy = pytest.importorskip('rclpy')
    from cg_interfaces.domains import own_domain

    found = {}
    with own_domain():
        rclpy.init()
        try:
            # Some nodes look whether another machine speaks.
            stranger = rclpy.create_node('stranger')
            messages = importlib.import_module('sensor_msgs.msg')
            stranger.create_publisher(messages.JointState, '/applied_torque', 1)
            for name, node in started(str(tmp_path_factory.mktemp('bags') / 'bag')):
                try:
                    if name == 'simulation_node':
                        node.poll()
                    uses = found.setdefault(name, {kind: set() for kind in KINDS})
                    for kind, noun in KINDS.items():
                        ask = getattr(node, f'get_{noun}_names_and_types_by_node')
                        uses[kind] |= {topic for topic, _ in ask(name, '/')}
                finally:
                    getattr(node, 'close', lambda: None)()
                    node.destroy_node()
        finally:
            rclpy.try_shutdown()
    return found


def started(bag):
    """Node after node, as the runners and the launch files start them."""
    from cg_bringup import (
        balance_run,
        rebalance_run,
        recover_run,
        robot_run,
        runs,
    )

    asking = (('/torque_command', '/torque_request'),)
    recovery = recover_run.RecoverOptions(start='upright', bag=bag)
    recovery_nodes = recover_run.recover_nodes(recovery)
    lockstep = recover_run.RecoverOptions(start='upright', mode='lockstep')
    machine = recover_run.recover_nodes(lockstep)['simulation_node']
    by_hand = {
        'playback': runs.NodeOf('cg_control', 'playback_node', {}, asking),
        'excitation': runs.NodeOf('cg_sysid', 'excitation_node', {}, asking),
    }
    layouts = [
        robot_run.robot_nodes(robot_run.RobotOptions()),
        balance_run.balance_nodes(balance_run.BalanceOptions()),
        rebalance_run.rebalance_nodes(rebalance_run.RebalanceOptions()),
        recovery_nodes,
        {'simulation_node': machine},
        by_hand,
        {'experimenter': runs.NodeOf('cg_bringup', 'experimenter_node', {})},
    ]
    # Side by side behind a gate with owners.
    layout = {name: node for nodes in layouts for name, node in nodes.items()}
    owners = runs.NodeOf(
        'cg_hardware', 'safety_gate_node', {'owners': list(CONTROLLERS), 'owner': CONTROLLERS[0]}
    )
    layouts.append({'safety_gate': owners} | {
        name: runs.NodeOf(layout[name].package, layout[name].executable, {},
                          (('/torque_command', f'/torque_request/{name}'),))
        for name in CONTROLLERS
    })  # fmt: skip
    for nodes in layouts:
        for name, node in nodes.items():
            yield name, made(node)


def made(node):
    """The node object of what a runner would start as a process."""
    import rclpy
    from rclpy.parameter import Parameter

    module = importlib.import_module(f'{node.package}.{node.executable}')
    (kind,) = (
        c for c in vars(module).values()
        if isinstance(c, type) and issubclass(c, rclpy.node.Node)
        and c.__module__ == module.__name__
    )  # fmt: skip
    remapped = [word for a, b in node.remappings for word in ('-r', f'{a}:={b}')]
    return kind(
        parameter_overrides=[Parameter(name, value=v) for name, v in node.parameters.items()],
        cli_args=['--ros-args', *remapped],
    )


def test_every_node_of_the_suite_has_an_enclave(used):
    sources = Path(__file__).resolve().parents[2]
    modules = {f'{p.parent.name}.{p.stem}' for p in sources.glob('cg_*/cg_*/*_node.py')}
    assert len(used) == len(modules) or not modules, 'a node is started by no layout of this test'
    assert set(allowed()) == set(used) | {OPERATOR}


def test_a_node_may_do_what_it_does_and_no_more(used):
    rules = allowed()
    for node, uses in used.items():
        for kind in KINDS:
            missing, surplus = uses[kind] - rules[node][kind], rules[node][kind] - uses[kind]
            assert not missing, f'{node} may not {kind} {sorted(missing)}'
            assert not surplus, f'{node} needs not {kind} {sorted(surplus)}'


def test_a_person_sees_all_sets_all_and_moves_nothing(used):
    rules = allowed()[OPERATOR]
    topics = {name for uses in used.values() for name in uses['publish']}
    asked = {'/emergency_stop', '/cmd_vel', '/experiment'}  # what nodes hear from people
    heard = {name for uses in used.values() for name in uses['subscribe']}
    assert asked <= heard
    assert rules['subscribe'] == topics | asked
    assert rules['request'] == {name for uses in used.values() for name in uses['reply']}
    assert rules['publish'] == asked | {'/parameter_events', '/rosout'}


def test_what_the_command_line_itself_does_is_allowed_to_the_operator():
    rclpy = pytest.importorskip('rclpy')
    from cg_interfaces.domains import own_domain

    with own_domain():
        rclpy.init()
        try:
            name = '_ros2cli_4711'  # as ros2cli names its nodes
            node = rclpy.create_node(name, start_parameter_services=False)
            for kind, noun in KINDS.items():
                ask = getattr(node, f'get_{noun}_names_and_types_by_node')
                for topic, _ in ask(name, '/'):
                    rules = allowed()[OPERATOR][kind]
                    assert any(fnmatch.fnmatchcase(topic, rule) for rule in rules), topic
        finally:
            rclpy.try_shutdown()


@pytest.mark.parametrize('folder', ['', 'enclaves/compass_gait/playback'])
def test_a_node_without_keys_does_not_start(folder, tmp_path):
    """Nor one whose middleware has no security in it, as that of the wheels."""
    pytest.importorskip('rclpy')
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    secure = {
        'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce',
        'ROS_SECURITY_KEYSTORE': str(tmp_path),
    }  # fmt: skip
    done = subprocess.run(
        [sys.executable, '-m', 'cg_control.playback_node', '--ros-args', '--enclave',
         '/compass_gait/playback'],
        env=os.environ | secure, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert 'Traceback' not in done.stderr
    assert done.stderr.splitlines()[-1].startswith('error: ')
