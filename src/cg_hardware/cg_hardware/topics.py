"""Names that the hardware's topics use, per mechanism: docs/interfaces.md, "Topics"."""

JOINTS = {
    'compass_gait': ('hip',),
    'pendulum': ('joint',),
    'double_pendulum': ('shoulder', 'elbow'),
}
TORQUE_FRAME = {'compass_gait': 'hip', 'pendulum': 'joint', 'double_pendulum': 'base'}

IMU = '/imu'
HIP_ENCODER = '/hip_encoder'
HIP_COUNTS = '/hip_encoder/counts'
JOINT_STATES = '/joint_states'
TORQUE_COMMAND = '/torque_command'
TORQUE_REQUEST = '/torque_request'
APPLIED_TORQUE = '/applied_torque'
FOOT_CONTACT = '/foot_contact/{leg}'
EXPERIMENT = '/experiment'
RECORDER_PROGRESS = '/recorder/progress'
CLOCK = '/clock'
DIAGNOSTICS = '/diagnostics'

# The topic that completes a measurement, and that a controller answers.
MEASUREMENT = {
    'compass_gait': IMU,
    'pendulum': JOINT_STATES,
    'double_pendulum': JOINT_STATES,
}


def joints_of(mechanism: str) -> tuple[str, ...]:
    """Joint names of the torque messages of a mechanism.

    Raises:
        ValueError: for a mechanism without a row in the table.
    """
    if mechanism not in JOINTS:
        raise ValueError(f'mechanism {mechanism!r} has no topics; known are {", ".join(JOINTS)}')
    return JOINTS[mechanism]
