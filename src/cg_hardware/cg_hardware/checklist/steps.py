"""The steps of the checklist, in order, as data: what is asked, measured, judged."""

from cg_hardware.checklist import sensing, torquing
from cg_hardware.checklist.plan import WITHIN, Step

STEPS = (
    Step('devices', 'devices found', '', sensing.measure_devices, sensing.judge_devices),
    Step('rates', 'rates and jitter of stamps', '', sensing.measure_rates, sensing.judge_rates),
    Step('clocks', 'clock drift', '', sensing.measure_clocks, sensing.judge_clocks),
    Step(
        'zero', 'stillness and zeros',
        'Stand or hang the legs upright and parallel, and let them rest.',
        sensing.measure_zero, sensing.judge_zero, ((0.0, 'lean 0'),),
    ),
    Step(
        'imu_axis', 'axis and sign of the IMU',
        f'Within {WITHIN:g} s of your answer lean the inner legs forward by about 0.3 rad, and '
        'hold them.',
        sensing.measure_imu_axis, sensing.judge_imu_axis, sensing.TURNED, ('zero',),
    ),
    Step(
        'encoder', 'sign of the encoder',
        'Bring the legs back, upright and parallel, and let them rest.',
        sensing.measure_encoder, sensing.judge_encoder, ((0.0, 'lean 0'),),
    ),
    Step(
        'feet', 'foot switches',
        f'Within {WITHIN:g} s of your answer press the switch of the inner feet and let it go, '
        'then that of the outer feet.',
        sensing.measure_feet, sensing.judge_feet,
        ((0.2, 'foot_inner 0'), (0.5, 'foot_inner 1'), (0.8, 'foot_outer 1'),
         (1.1, 'foot_outer 0')),
    ),
    Step(
        'torque', 'sign of the torque',
        'Hold the robot as --setup says, let the legs rest, and keep your hands away: the hip is '
        'going to be torqued. Have a hand on the switch of the power.',
        torquing.measure_torque, torquing.judge_torque, ((0.0, 'lean 0'),),
        ('encoder',), torque=True,
    ),
    Step('limit', 'torque limit of the gate', '',
         torquing.measure_limit, torquing.judge_limit,
         needs=('torque',), torque=True),
    Step('stale', 'stale command', '',
         torquing.measure_stale, torquing.judge_stale,
         needs=('torque',), torque=True),
    Step('gone', 'controller unplugged', '',
         torquing.measure_gone, torquing.judge_stale,
         needs=('torque',), torque=True),
    Step('stop_service', 'emergency stop by service', '',
         torquing.measure_stop_service, torquing.judge_stop,
         needs=('torque',), torque=True),
    Step('stop_topic', 'emergency stop by topic', '',
         torquing.measure_stop_topic, torquing.judge_stop,
         needs=('torque',), torque=True),
    Step('imu_plug', 'plug of the IMU',
         'A small torque is going to act. When it does, pull the plug of the IMU.',
         torquing.measure_imu_plug, torquing.judge_plug, needs=('torque',), torque=True),
    Step('bus_plug', "plug of the drive's bus",
         "A small torque is going to act. When it does, pull the plug of the drive's bus.",
         torquing.measure_bus_plug, torquing.judge_plug, needs=('torque',), torque=True),
)  # fmt: skip
NAMES = tuple(step.name for step in STEPS)
