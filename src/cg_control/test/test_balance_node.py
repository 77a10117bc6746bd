"""The balance node: answers every state, takes new weights as it runs, refuses impossible ones."""

import math
import resource
import time

import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from cg_control.balance_node import BalanceNode  # noqa: E402
from cg_control.balancing.balance import BalanceDesign  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import SENSOR_QOS, to_nanoseconds, to_stamp  # noqa: E402

pytestmark = pytest.mark.alone

T_NS = 2_000_000
START_NS = 1_000_000_000


class Bench:
    def __init__(self):
        self.executor = EventsExecutor()
        self.peer, self.balance = Node('peer'), BalanceNode()
        self.commands, self.reports = [], []
        self.state = self.peer.create_publisher(JointState, '/state', SENSOR_QOS)
        self.applied = self.peer.create_publisher(JointState, '/applied_torque', SENSOR_QOS)
        self.peer.create_subscription(
            JointState, '/torque_command', self.commands.append, SENSOR_QOS
        )
        self.peer.create_subscription(DiagnosticArray, '/diagnostics', self.on_report, 10)
        for node in (self.peer, self.balance):
            self.executor.add_node(node)
        self.until(
            lambda: (
                self.balance.publisher.get_subscription_count()
                and self.balance.diagnostics.get_subscription_count()
                and self.state.get_subscription_count()
                and self.applied.get_subscription_count()
            )
        )

    def on_report(self, message):
        status = message.status[0]
        self.reports.append((status.message, {v.key: v.value for v in status.values}))

    def until(self, condition):
        deadline = time.monotonic() + 20.0
        while not condition():
            assert time.monotonic() < deadline
            self.balance.poll()
            self.executor.spin_once(timeout_sec=0.01)

    def message(self, k=0, lean=0.01, rate=0.0, foot='inner_foot', names=('inner', 'outer')):
        message = JointState(name=list(names), position=[lean, lean], velocity=[rate, rate])
        message.header.stamp = to_stamp(START_NS + k * T_NS)
        message.header.frame_id = foot
        return message

    def ask(self, k, **state):
        message = self.message(k, **state)
        count = len(self.commands)
        self.state.publish(message)
        self.until(lambda: len(self.commands) > count)
        return self.commands[-1]

    def set(self, **values):
        return self.balance.set_parameters_atomically(
            [Parameter(n, value=v) for n, v in values.items()]
        )

    def close(self):
        for node in (self.peer, self.balance):
            self.executor.remove_node(node)
        self.balance.close()
        for node in (self.peer, self.balance):
            node.destroy_node()


@pytest.fixture
def bench():
    with own_domain():
        rclpy.init()
        bench = Bench()
        yield bench
        bench.close()
        rclpy.try_shutdown()


def test_answers_carry_the_stamp_and_the_sign_of_the_stance_leg(bench):
    signs = {}
    for foot in ('inner_foot', 'outer_foot'):
        for _ in range(30):
            command = bench.ask(len(bench.commands), foot=foot)
        signs[foot] = math.copysign(1.0, command.effort[0])
        assert to_nanoseconds(command.header.stamp) == START_NS + (len(bench.commands) - 1) * T_NS
    assert signs['inner_foot'] * signs['outer_foot'] < 0


@pytest.mark.parametrize(
    'wrong', [{'lean': math.nan}, {'foot': 'left_foot'}, {'names': ('inner', 'knee')}],
    ids=['nan', 'foot', 'names'],
)  # fmt: skip
def test_what_is_wrong_is_answered_with_zero_torque(bench, wrong):
    for k in range(20):
        command = bench.ask(k)
    assert command.effort[0] != 0.0
    assert bench.ask(20, **wrong).effort[0] == 0.0


def test_a_weight_is_taken_over_at_once_and_its_basin_is_sampled(bench):
    for k in range(200):
        before = bench.ask(k).effort[0]
    gain = bench.balance.controller.gains['inner'].copy()
    bound = bench.balance.controller.basins['inner'].bounds[0]
    assert bench.set(swing_scale=10.0, lean_scale=1.0, lean_rate_scale=10.0).successful
    first = bench.ask(200).effort[0]
    # Smoothly: one sample of the hand-over, 0.02 s, at most.
    assert abs(first - before) < 0.15 * abs(before)
    for k in range(201, 400):
        after = bench.ask(k).effort[0]
    assert abs(bench.balance.controller.gains['inner'][0]) < 0.8 * abs(gain[0])
    assert abs(after) < 0.8 * abs(before)
    # It balances on, and the basin of these gains follows.
    assert bench.balance.controller.mode == 'balancing'
    bench.until(lambda: bench.balance.controller.basins['inner'].bounds[0] != bound)


class Spent:
    """What this thread has used: CPU time in s, and how often it slept."""

    def __init__(self):
        self.cpu = time.thread_time()
        self.sleeps = resource.getrusage(resource.RUSAGE_THREAD).ru_nvcsw

    def used(self):
        now = Spent()
        return now.cpu - self.cpu, now.sleeps - self.sleeps


def test_a_change_of_a_weight_delays_no_answer(bench):
    """It neither computes for long in the thread of the loop nor waits for anybody.

    Whoever starts a process sleeps until it runs, and sampling a basin takes a second. The
    kernel counts both for this thread alone, so that it does not matter what else runs. The
    measure is the time that the gains alone take, so that the speed of the machine does not
    matter either: 1.7 times that was measured.
    """
    design = bench.balance.design
    gains = BalanceDesign(bench.balance.model, bench.balance.sample_time)
    used, alone = [], []
    for k in range(60):
        begun = Spent()
        gains.gains(design.controller.settings)
        alone.append(begun.used()[0])
        message = bench.message(k)
        begun = Spent()
        assert bench.set(lean_scale=0.075 if k % 2 else 0.1).successful
        bench.balance.on_state(message)
        design.collect()
        used.append(begun.used())
        assert design.controller.settings is bench.balance.declared.values
    seconds, sleeps = (sorted(column) for column in zip(*used, strict=True))
    # The quickest tenth: others may empty the caches of this core. And in nine of ten it never
    # sleeps: now and then it has to wait for a lock of the middleware.
    assert seconds[6] < 3.0 * sorted(alone)[6]
    assert sleeps[54] == 0


def test_weights_without_a_regulator_are_refused_and_nothing_changes(bench):
    before = bench.balance.controller.gains
    result = bench.set(torque_scale=1e-6)
    assert not result.successful
    assert 'no gains for the inner leg as stance' in result.reason
    result = bench.set(lean_scale=-1.0)
    assert 'lean_scale' in result.reason
    bench.ask(0)
    assert bench.balance.controller.gains == before
    assert bench.balance.declared.values.torque_scale == 40.0


def test_a_fall_is_reported_and_needs_arming(bench):
    for k in range(5):
        bench.ask(k)
    assert bench.ask(5, lean=0.6).effort[0] == 0.0
    bench.until(lambda: any('fallen' in text for text, _ in bench.reports))
    assert bench.set(armed=False).successful
    bench.ask(6)
    assert bench.set(armed=True).successful
    for k in range(7, 20):
        command = bench.ask(k)
    assert command.effort[0] != 0.0


def test_age_of_the_measurement_and_missed_deadlines_are_reported(bench):
    for k in range(40):
        command = bench.ask(k, lean=1e-4 * (k + 1))
        late = 3 if k == 30 else 1
        echo = JointState(name=['hip'], effort=command.effort)
        echo.header.stamp = to_stamp(START_NS + (k + late) * T_NS)
        bench.applied.publish(echo)
        count = len(bench.balance._ages)
        bench.until(lambda count=count: len(bench.balance._ages) > count)
    bench.until(lambda: bench.reports and 'age_max_ms' in bench.reports[-1][1])
    values = bench.reports[-1][1]
    assert values['age_p50_ms'] == '2.000'
    assert values['age_max_ms'] == '6.000'
    assert sum(int(v['missed_deadlines']) for _, v in bench.reports) == 1
