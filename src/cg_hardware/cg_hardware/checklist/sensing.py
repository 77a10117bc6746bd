"""Steps without torque: devices, stamps, zeros, axes and signs, foot switches."""

import math

import numpy as np

from cg_hardware.checklist import measuring
from cg_hardware.checklist.measuring import Heard
from cg_hardware.checklist.plan import (
    STATED,
    WITHIN,
    Judged,
    Numbers,
    Plan,
    all_well,
    rounded,
    settle,
)
from cg_hardware.checklist.robot import Hands, Robot, Skipped
from cg_hardware.imu.mounting import STILL
from cg_interfaces import topics

# Topic -> the channels that are heard on it.
CHANNELS = {
    topics.IMU: ('imu_angle', 'imu_rate'),
    topics.HIP_ENCODER: ('hip_angle',),
    topics.APPLIED_TORQUE: ('applied',),
    topics.TORQUE_COMMAND: ('command',),
    topics.DRIVE_ENABLED: ('enabled',),
    topics.FOOT_CONTACT.format(leg='inner'): ('inner_foot',),
    topics.FOOT_CONTACT.format(leg='outer'): ('outer_foot',),
}
DEVICES = ('imu', 'drive')

TOLD_S = 2.5  # s in which devices tell of themselves: /diagnostics come once a second
HEARD_S = 8.0  # s more that a busy computer is given for it
OFF_RATE = 0.01  # of the stated rate
MOST_MISSING = 0.01  # share of samples
MOST_JITTER = 0.25  # of a period: spread of the periods
OLDEST = 20.0  # ms from a stamp to its receipt
AHEAD = 1.0  # ms that a stamp may lie after its receipt
LARGEST_DRIFT = 200.0  # ppm: a quartz has 20 to 100
DRIFT_S = 5.0  # s of samples before a drift is asked for
STILL_S = 1.5  # s that legs are watched for stillness
RATE_ZERO = 0.02  # rad/s that a gyroscope may tell of legs that stand
BAD_ZERO = 3e-3  # rad of an angle after its zero
BY_EYE = 0.05  # rad by which a person misses parallel legs
BY_INDEX = 'homing', 'index by hand'  # words of the drive for a zero that stays
LEANED = 0.15  # rad that a person must lean or turn a leg
HELD = 0.5  # s that is listened to after it
GYRO = 0.2  # share by which the turned rate may miss the angle
SCALE = 0.3  # share by which the encoder may miss the IMU


def measure_devices(robot: Robot, plan: Plan) -> Numbers:
    """Who publishes what, and what devices say of themselves."""
    robot.listen(TOLD_S)
    robot.listen(HEARD_S, until=lambda _: all(map(robot.device, DEVICES)), more=True)
    nodes = {topic: robot.publishers_of(topic) for topic in CHANNELS}
    found: Numbers = {topic: ', '.join(names) or 'nobody' for topic, names in nodes.items()}
    found['publishers'] = {topic: len(names) for topic, names in nodes.items()}
    for name in DEVICES:
        device = robot.device(name)
        found[name] = 'not heard' if device is None else device.state
        found[f'{name}_well'] = device is not None and (device.well or name == 'drive')
        found[f'{name}_identity'] = device.identity if device else ''
    found['stage'] = robot.stage
    return found


def judge_devices(numbers: Numbers, plan: Plan) -> Judged:
    """One publisher for each topic that must be there, devices without error, a gate."""
    needed = [t for t in CHANNELS if not t.startswith('/foot_contact')]
    wrong = [
        f'{topic} is published by {numbers[topic]}; one node is needed'
        for topic in needed if numbers['publishers'][topic] != 1
    ]  # fmt: skip
    wrong += [f'{name}: {numbers[name]}' for name in DEVICES if not numbers[f'{name}_well']]
    if not numbers['stage']:
        wrong.append('no safety gate says in which stage the robot is')
    elif numbers['stage'].startswith('unconfigured'):
        wrong.append(f'the safety gate says {numbers["stage"]}')
    who = '; '.join(
        f'{name}: {numbers[f"{name}_identity"] or "does not say who it is"}' for name in DEVICES
    )
    return all_well(*wrong, fine=who)


def measure_rates(robot: Robot, plan: Plan) -> Numbers:
    """Rate, jitter and missing samples of IMU and encoder, by their stamps."""
    heard = robot.listen(4.0)
    found: Numbers = {}
    for channel, (node, name) in STATED.items():
        found |= rounded(measuring.rate_of(heard[channel]), f'{channel}_')
        found[f'{channel}_stated_hz'] = float(robot.setting(node, name))
    return found


def judge_rates(numbers: Numbers, plan: Plan) -> Judged:
    """Rates are the stated ones, few samples are missing, stamps are even."""
    wrong, fine = [], []
    for channel in STATED:
        rate, stated = numbers[f'{channel}_rate_hz'], numbers[f'{channel}_stated_hz']
        missing, jitter = numbers[f'{channel}_missing'], numbers[f'{channel}_jitter_ms']
        if abs(rate - stated) > OFF_RATE * stated:
            wrong.append(f'{channel} comes at {rate:.4g} Hz, {stated:g} Hz are stated')
        elif missing > MOST_MISSING:
            wrong.append(f'{channel} lacks {100 * missing:.2g} % of its samples')
        elif jitter > MOST_JITTER * 1e3 / stated:
            wrong.append(f'the stamps of {channel} are uneven by {jitter:.2g} ms')
        fine.append(f'{channel} {rate:.4g} Hz, even to {jitter:.2g} ms')
    return all_well(*wrong, fine='; '.join(fine))


def measure_clocks(robot: Robot, plan: Plan) -> Numbers:
    """Drift of the IMU's clock, and how old samples are when they are heard."""
    heard = robot.listen(DRIFT_S)
    imu = robot.device('imu')
    found = rounded({
        f'{channel}_age_ms': measuring.rate_of(heard[channel])['age_ms'] for channel in STATED
    })  # fmt: skip
    found['drift_ppm'] = imu.number('clock_drift_ppm') if imu else math.nan
    found['clock_jumps'] = imu.number('clock_jumps') if imu else math.nan
    return found


def judge_clocks(numbers: Numbers, plan: Plan) -> Judged:
    """Stamps are the host's, and the IMU's quartz is one."""
    drift = numbers['drift_ppm']
    wrong = [
        f'stamps of {channel} are {age:.3g} ms old when they come'
        for channel in STATED
        if not -AHEAD <= (age := numbers[f'{channel}_age_ms']) <= OLDEST
    ]
    if abs(drift) > LARGEST_DRIFT:
        wrong.append(f'the clock of the IMU drifts by {drift:.3g} ppm')
    told = 'the IMU tells no drift' if math.isnan(drift) else f'the IMU drifts by {drift:.3g} ppm'
    ages = ', '.join(f'{c} {numbers[f"{c}_age_ms"]:.2g} ms' for c in STATED)
    return all_well(*wrong, fine=f'{told}; heard after: {ages}')


# What a person does to legs without torque


def measure_zero(robot: Robot, plan: Plan) -> Numbers:
    """Stillness; then the zeros are taken, and looked at."""
    settle(robot)
    heard = robot.listen(STILL_S)
    found = {
        'imu_still_mrad': 1e3 * float(np.std(heard['imu_angle'].values)),
        'hip_still_mrad': 1e3 * float(np.std(heard['hip_angle'].values)),
        'imu_rate_mean': float(np.mean(heard['imu_rate'].values)),
        'imu_rate_noise': float(np.std(heard['imu_rate'].values)),
    }
    drive = robot.device('drive')
    by_index = drive is not None and any(way in drive.values.get('zero', '') for way in BY_INDEX)
    robot.press('/imu/zero')
    if not by_index:  # which is more exact than a person
        robot.press('/drive/zero')
    heard = robot.listen(STILL_S)
    found['imu_angle_after'] = float(np.mean(heard['imu_angle'].values))
    found['hip_angle_after'] = float(np.mean(heard['hip_angle'].values))
    return rounded(found) | {'hip_by_index': by_index}


def judge_zero(numbers: Numbers, plan: Plan) -> Judged:
    """Legs stood still, and both angles are zero."""
    still, hip = numbers['imu_still_mrad'], numbers['hip_still_mrad']
    rate = numbers['imu_rate_mean']
    return all_well(
        max(still, hip) > 1e3 * STILL
        and f'the legs moved: by {still:.2g} mrad (IMU), {hip:.2g} mrad (encoder)',
        abs(rate) > RATE_ZERO and f'the gyroscope tells {rate:.3g} rad/s of legs that stand',
        *(
            abs(numbers[f'{channel}_after'])
            > (BY_EYE if channel == 'hip_angle' and numbers['hip_by_index'] else BAD_ZERO)
            and f'{channel} is {numbers[f"{channel}_after"]:.4f} rad after its zero'
            for channel in STATED
        ),
        fine=f'still to {still:.2g} mrad (IMU) and {hip:.2g} mrad (encoder), the gyroscope tells '
        f'{1e3 * rate:.2g} mrad/s; '
        + (
            'the zero of the hip is that of its index'
            if numbers['hip_by_index']
            else 'both zeros are taken'
        ),
    )


def _while_moved(robot: Robot, channel: str) -> Heard:
    """What is heard while a person moves a leg, and a little longer."""
    robot.listen(WITHIN, until=lambda heard: abs(measuring.moved(heard[channel])) > LEANED)
    return robot.listen(HELD, more=True)


def measure_imu_axis(robot: Robot, plan: Plan) -> Numbers:
    """Which axis the lean is about, by the IMU node; its sign and the gyroscope's, by /imu."""
    robot.press('/imu/find_axis')
    heard = _while_moved(robot, 'imu_angle')
    robot.listen(1.5)  # until /diagnostics tell what was found
    imu = robot.device('imu')
    values = imu.values if imu else {}
    return {
        'lean_rad': round(measuring.moved(heard['imu_angle']), 4),
        'turned_rad': round(measuring.integral(heard['imu_rate']), 4),
        'hip_moved_rad': round(measuring.moved(heard['hip_angle']), 4),
        'set': f'{values.get("axis", "?")} {values.get("sign", "?")}',
        'found': values.get('found', ''),
    }


def judge_imu_axis(numbers: Numbers, plan: Plan) -> Judged:
    """Forward is positive, about the axis that is set, for angle and rate alike."""
    lean, turned = numbers['lean_rad'], numbers['turned_rad']
    found, fitting = numbers['found'], numbers['found'] == numbers['set']
    if found and not fitting:
        axis, _, sign = found.partition(' ')
        return Judged(False, f'the lean is about {axis}: set --axis {axis} --imu-sign {sign}')
    if abs(lean) < LEANED:
        return Judged(False, f'the lean went {lean:.2f} rad at most; {LEANED} rad are needed')
    return all_well(
        lean < 0 and 'a forward lean counts negative: change the sign of --imu-sign',
        abs(turned - lean) > GYRO * abs(lean)
        and f'the gyroscope turned {turned:.2f} rad where the angle went {lean:.2f} rad',
        fine=f'leant {lean:+.2f} rad, the gyroscope agrees to '
        f'{100 * abs(turned - lean) / abs(lean):.1f} %',
    )


TURN = (
    f'Within {WITHIN:g} s of your answer hold the outer legs and move the inner legs ahead of '
    'them by about 0.3 rad; or the outer legs back, if the inner legs are clamped.'
)
TURNED: Hands = ((0.5, 'lean 0.3'),)


def measure_encoder(robot: Robot, plan: Plan) -> Numbers:
    """How far encoder and IMU went while the inner legs were moved ahead of the outer."""
    settle(robot)
    robot.ask(TURN, TURNED)
    heard = _while_moved(robot, 'hip_angle')
    return {
        'hip_moved_rad': round(measuring.moved(heard['hip_angle']), 4),
        'lean_rad': round(measuring.moved(heard['imu_angle']), 4),
    }


def judge_encoder(numbers: Numbers, plan: Plan) -> Judged:
    """It grows when the inner legs go ahead, and as far as the IMU where that moved as well."""
    hip, lean = numbers['hip_moved_rad'], numbers['lean_rad']
    if abs(hip) < LEANED:
        return Judged(False, f'the encoder went {hip:.2f} rad at most; {LEANED} rad are needed')
    if hip < 0:
        return Judged(False, 'the encoder counts backward: change the sign of --counts-per-turn')
    if abs(lean) < LEANED:
        return Judged(True, f'the encoder went {hip:+.2f} rad; its scale was not compared')
    ratio = abs(hip / lean)
    return all_well(
        abs(ratio - 1.0) > SCALE
        and f'the encoder went {ratio:.2f} times as far as the IMU: look at --counts-per-turn',
        fine=f'the encoder went {hip:+.2f} rad, {ratio:.2f} times as far as the IMU',
    )


FEET = 'inner_foot', 'outer_foot'


def measure_feet(robot: Robot, plan: Plan) -> Numbers:
    """Both states of both switches."""

    def both(heard: Heard) -> bool:
        return all(len(np.unique(heard[foot].values > 0)) == 2 for foot in FEET)

    heard = robot.listen(WITHIN, until=both)
    if not any(len(heard[foot]) for foot in FEET):
        raise Skipped('nothing publishes /foot_contact: the drive has no foot switches')
    return {
        f'{foot}_{word}': bool(np.any((heard[foot].values > 0) == closed))
        for foot in FEET for word, closed in (('opened', False), ('closed', True))
    }  # fmt: skip


def judge_feet(numbers: Numbers, plan: Plan) -> Judged:
    """Each was seen open and closed."""
    wrong = [
        f'{name.replace("_", " ", 1).replace("_", " never ")}'
        for name, seen in numbers.items() if not seen
    ]  # fmt: skip
    return all_well(*wrong, fine='both switches open and close')
