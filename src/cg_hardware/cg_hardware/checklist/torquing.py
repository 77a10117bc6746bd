"""Steps with torque, all of it small: its sign, its limit, and whatever takes it off."""

import math
from collections.abc import Callable

import numpy as np

from cg_hardware.checklist import measuring
from cg_hardware.checklist.measuring import Heard
from cg_hardware.checklist.plan import Judged, Numbers, Plan, all_well, rounded, settle
from cg_hardware.checklist.robot import Hands, Refused, Robot, Torque

FAR = 0.6  # rad the hip may go while it is torqued
INERTIA = (0.33, 3.0)  # measured over expected
FINE = 0.05  # N m of a drive's rounding, and 5 % of a limit
STALE_SLACK = 3  # cycles beyond the drive's own patience
LATEST_STOP = 30.0  # ms from the button to zero torque
LATEST_FAULT = 500.0  # ms until the gate says that something is wrong
STOP_TORQUE = 0.25  # share of the small torque that acts when it is taken off
PULL_WITHIN = 20.0  # s for a plug to be pulled, and to be put back


def _too_far(heard: Heard) -> bool:
    hip = heard['hip_angle'].values
    return len(hip) > 0 and bool(abs(hip[-1] - hip[0]) > FAR)


def _torqued(
    robot: Robot,
    limit: float,
    seconds: float,
    torque: Torque,
    enough: Callable[[Heard], bool] = lambda heard: False,
) -> Heard:
    """What is heard while a torque acts.

    Args:
        robot: The robot.
        limit: Of the gate meanwhile, N m.
        seconds: How long, at most.
        torque: In N m over the time in s.
        enough: Ends it early.

    Raises:
        Refused: The torque was taken off meanwhile, by the gate or the drive.
    """
    robot.change('safety_gate', 'torque_limit', limit)
    robot.take_control()

    def given_up(heard: Heard) -> bool:
        return robot.stage.startswith('fault') or bool(np.any(heard['enabled'].values[-1:] == 0))

    heard = robot.listen(
        seconds, torque, lambda heard: enough(heard) or _too_far(heard) or given_up(heard)
    )
    if given_up(heard):
        drive = robot.device('drive')
        raise Refused(
            'the torque was taken off while it was tried: the gate says '
            f'{robot.stage}, the drive {drive.state if drive else "nothing"}'
        )
    return heard


def measure_torque(robot: Robot, plan: Plan) -> Numbers:
    """The hip's answer to small pulses, and what the model's would be to the same."""
    settle(robot)
    heard = _torqued(
        robot, plan.torque, measuring.LENGTH, lambda time: measuring.pulses(plan.torque, time)
    )
    applied, hip = heard['applied'], heard['hip_angle']
    if len(hip) < measuring.FEWEST or len(applied) < measuring.FEWEST:
        raise Refused('encoder and applied torque were not heard')
    step = float(np.median(np.diff(hip.time)))
    start = max(applied.stamp_ns[0], hip.stamp_ns[0])
    stop = min(applied.stamp_ns[-1], hip.stamp_ns[-1])
    stamps = start + np.arange(int((stop - start) / 1e9 / step)) * round(1e9 * step)
    held = np.searchsorted(applied.stamp_ns, stamps, side='right') - 1
    torques = applied.values[held]
    angles = np.interp(stamps - start, hip.stamp_ns - start, hip.values)
    found = measuring.response_of((stamps - start) / 1e9, angles, torques)
    expected = measuring.expected_response(plan.model, plan.setup, torques, step)
    return rounded({
        'torque_applied': float(np.abs(torques).max()),
        'travel_rad': found.travel,
        'inverse_inertia': found.inverse_inertia,
        'inverse_inertia_spread': found.spread,
        'expected_inverse_inertia': expected.inverse_inertia if expected.clear else math.nan,
        'far': float(_too_far(heard)),
    })  # fmt: skip


def judge_torque(numbers: Numbers, plan: Plan) -> Judged:
    """Positive torque accelerates the hip positively, and by about as much as the model says."""
    response = measuring.Response(
        numbers['inverse_inertia'], numbers['inverse_inertia_spread'], numbers['travel_rad']
    )
    found = response.inverse_inertia
    expected, applied = numbers['expected_inverse_inertia'], numbers['torque_applied']
    if applied < 0.5 * plan.torque:
        return Judged(False, f'the drive applied {applied:.2g} N m of {plan.torque:g} N m')
    if not response.clear:
        return Judged(
            False,
            f'the hip does not answer {plan.torque:g} N m (it went {response.travel:.3f} rad): is '
            'it held, or its friction larger? Ask for more by --torque',
        )
    if found < 0:
        return Judged(
            False, 'positive torque turns the inner legs backward: change the sign of --drive-sign'
        )
    if numbers['far']:
        return Judged(False, f'the hip went further than {FAR} rad; the torque was taken off')
    if math.isnan(expected):
        return Judged(
            True, f'the sign is right; in the model, friction holds against {plan.torque:g} N m'
        )
    ratio = expected / found
    return all_well(
        not INERTIA[0] < ratio < INERTIA[1]
        and f'the inertia is {ratio:.2g} times the expected one: look at --gear, the rated torque '
        'of the drive, and --setup',
        fine=f'the sign is right; the inertia is {ratio:.2f} times the expected one',
    )


def measure_limit(robot: Robot, plan: Plan) -> Numbers:
    """Ask for twice what the gate is to pass, to and fro."""
    limit = 0.5 * plan.torque
    heard = _torqued(robot, limit, 0.6, lambda t: 2.0 * limit if t % 0.2 < 0.1 else -2.0 * limit)
    return rounded({
        'limit': limit, 'asked': 2.0 * limit,
        'commanded': float(np.abs(heard['command'].values).max(initial=0.0)),
        'applied': float(np.abs(heard['applied'].values).max(initial=0.0)),
    })  # fmt: skip


def judge_limit(numbers: Numbers, plan: Plan) -> Judged:
    """The limit is reached, by command and drive, and not exceeded."""
    limit = numbers['limit']
    room = FINE * (1.0 + limit)
    wrong = []
    for name in ('commanded', 'applied'):
        if numbers[name] > limit + room:
            wrong.append(f'{numbers[name]:.3g} N m were {name}, the limit is {limit:g} N m')
        elif numbers[name] < limit - room:
            wrong.append(f'only {numbers[name]:.3g} N m of {limit:g} N m were {name}')
    return all_well(
        *wrong, fine=f'{numbers["asked"]:g} N m were asked for, {numbers["applied"]:.3g} N m acted'
    )


def _acting(robot: Robot, plan: Plan) -> Torque:
    """A torque acts when this returns; go on with what it gives."""
    small = STOP_TORQUE * plan.torque

    def torque(time: float) -> float:
        return small if time % 0.4 < 0.2 else -small

    def acts(heard: Heard) -> bool:
        return bool(np.any(np.abs(heard['applied'].values[-20:]) > FINE))

    if not acts(_torqued(robot, plan.torque, 1.0, torque, acts)):
        raise Refused('no torque acted before it was to be taken off')
    return torque


def _taken_off(robot: Robot, plan: Plan, do: Callable[[], None], still: bool) -> Numbers:
    """Time from what is done to zero torque, and to the fault that the gate tells.

    Args:
        robot: The robot.
        plan: Of the checklist.
        do: What takes the torque off.
        still: Whether requests go on.
    """
    torque: Torque | None = _acting(robot, plan)
    since = robot.now_ns()
    do()
    torque = torque if still else None
    robot.listen(LATEST_FAULT / 1e3, torque, lambda _: robot.stage.startswith('fault'), more=True)
    fault = (robot.now_ns() - since) / 1e6 if robot.stage.startswith('fault') else math.inf
    heard = robot.listen(0.1, torque, more=True)
    numbers = rounded({
        'zero_after_ms': measuring.until_zero_ms(heard['applied'], since),
        'fault_after_ms': fault,
    })  # fmt: skip
    numbers['stage'] = robot.stage
    try:
        robot.press('/safety_gate/arm')
        numbers['armed_again'] = True
    except Refused:
        numbers['armed_again'] = False
    return numbers


def _judge_taken_off(numbers: Numbers, latest_ms: float) -> Judged:
    zero = numbers['zero_after_ms']
    return all_well(
        zero > latest_ms
        and (f'torque was zero after {zero:.3g} ms; {latest_ms:.3g} ms are allowed'
             if math.isfinite(zero) else 'the torque stayed'),
        not numbers['stage'].startswith('fault')
        and f'the robot is {numbers["stage"]}, and not in fault',
        numbers['armed_again'] and 'it could be armed again without a reset',
        fine=f'torque was zero after {zero:.3g} ms; {numbers["stage"]}',
    )  # fmt: skip


def measure_stale(robot: Robot, plan: Plan) -> Numbers:
    """Requests stop; the command grows old."""
    patience = float(robot.setting('drive', 'stale_after'))
    numbers = _taken_off(robot, plan, lambda: None, still=False)
    cycle = 1.0 / float(robot.setting('drive', 'sample_rate_hz'))
    numbers['allowed_ms'] = round(1e3 * (patience + STALE_SLACK * cycle), 3)
    return numbers


def measure_gone(robot: Robot, plan: Plan) -> Numbers:
    """The controller is gone, publisher and all."""
    patience = float(robot.setting('drive', 'stale_after'))
    cycle = 1.0 / float(robot.setting('drive', 'sample_rate_hz'))
    numbers = _taken_off(robot, plan, robot.leave, still=False)
    numbers['allowed_ms'] = round(1e3 * (patience + STALE_SLACK * cycle), 3)
    return numbers


def judge_stale(numbers: Numbers, plan: Plan) -> Judged:
    """Zero within the drive's patience and three cycles."""
    return _judge_taken_off(numbers, numbers['allowed_ms'])


def measure_stop_service(robot: Robot, plan: Plan) -> Numbers:
    """The emergency stop by its service, while a controller goes on asking."""
    return _taken_off(robot, plan, lambda: _pressed(robot), still=True)


def _pressed(robot: Robot) -> None:
    robot.press('/safety_gate/stop')


def measure_stop_topic(robot: Robot, plan: Plan) -> Numbers:
    """The emergency stop by its topic, while a controller goes on asking."""
    return _taken_off(robot, plan, robot.stop_by_topic, still=True)


def judge_stop(numbers: Numbers, plan: Plan) -> Judged:
    """Zero at once, fault, and latched."""
    return _judge_taken_off(numbers, LATEST_STOP)


def _pulled(
    robot: Robot, plan: Plan, pull: Hands, back: Hands, what: str, channel: str
) -> Numbers:
    """A plug is pulled while a small torque acts, and put back."""
    torque = _acting(robot, plan)
    robot.say(f'pull the plug of the {what} now')
    robot.ask('', pull)
    heard = robot.listen(PULL_WITHIN, torque, lambda _: robot.stage.startswith('fault'))
    silent = robot.listen(0.2, torque)[channel]
    numbers: Numbers = {
        'stage': robot.stage,
        'silent': len(silent) == 0,
        'torque_after': float(np.abs(heard['applied'].values[-1:]).max(initial=0.0)),
    }
    robot.ask(f'Put the plug of the {what} back.', back)
    after = robot.listen(PULL_WITHIN, torque, lambda heard: len(heard[channel]) > 100)
    numbers['back'] = len(after[channel]) > 100
    numbers['torque_after_back'] = float(np.abs(after['applied'].values).max(initial=0.0))
    return numbers


def measure_imu_plug(robot: Robot, plan: Plan) -> Numbers:
    """The IMU's plug."""
    return _pulled(robot, plan, ((0.0, 'imu_unplug'),), ((0.0, 'imu_plug'),), 'IMU', 'imu_angle')


def measure_bus_plug(robot: Robot, plan: Plan) -> Numbers:
    """The plug of the drive's bus."""
    return _pulled(
        robot, plan, ((0.0, 'can_unplug'),), ((0.0, 'can_plug'),), "drive's bus", 'hip_angle'
    )


def judge_plug(numbers: Numbers, plan: Plan) -> Judged:
    """Silent, in fault, back when it is plugged in, and no torque by itself."""
    if not numbers['silent']:
        return Judged(False, 'nothing fell silent: was the plug pulled?')
    return all_well(
        not numbers['stage'].startswith('fault') and f'the robot is {numbers["stage"]}',
        numbers['torque_after_back'] > 0 and 'torque came back by itself',
        not numbers['back'] and 'it was not heard again with the plug back',
        fine=f'{numbers["stage"]}; heard again, and no torque by itself',
    )
