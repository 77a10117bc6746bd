"""Channels: which field of which topic is which measured quantity (interfaces.md).

A channel is one scalar signal with a standard name. A topic feeds one or several channels; its
extractor takes a message to the channels' values, and its composer goes the other way. Both
work on any object that has the fields of the ROS message: those of `rosbags`, or of rclpy.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, isfinite, sin, sqrt
from typing import TYPE_CHECKING, Any

from cg_interfaces import topics

if TYPE_CHECKING:
    from cg_dynamics.mechanisms import Mechanism as Body

JOINT_STATE = 'sensor_msgs/msg/JointState'
TRAJECTORY_STATE = 'control_msgs/msg/JointTrajectoryControllerState'
IMU = 'sensor_msgs/msg/Imu'
STRING = 'std_msgs/msg/String'

ROTOR = 'hip_rotor'  # joint of /state behind the two legs, where the drive springs

# Kind of a sensor of a joint -> field of the JointState that it fills.
SENSOR_FIELDS = {'encoder': 'position', 'tachometer': 'velocity'}

QUATERNION_NORM_TOLERANCE = 1e-2  # [1]; a drive that never filled the field sends norm 0


@dataclass(frozen=True)
class Channel:
    """One scalar signal.

    Attributes:
        name: Name of the channel, such as `hip_angle`.
        unit: SI unit.
        field: Field of the message: `position`, `velocity`, `effort` of a JointState,
            `pitch` or `pitch_rate` of an Imu.
        joint: Name of the joint inside a JointState; empty for an Imu.
    """

    name: str
    unit: str
    field: str
    joint: str = ''

    @property
    def place(self) -> str:
        """The field as a reader of the message would write it, such as `position[hip]`."""
        return f'{self.field}[{self.joint}]' if self.joint else self.field


@dataclass(frozen=True)
class Topic:
    """One topic of a mechanism and the channels that it feeds.

    Attributes:
        name: Topic name.
        msgtype: Message type, such as `sensor_msgs/msg/JointState`.
        frame_id: Frame written into the header.
        channels: Channels fed by the topic.
        required: Whether a recording without this topic is useless.
    """

    name: str
    msgtype: str
    frame_id: str
    channels: tuple[Channel, ...]
    required: bool = False


@dataclass(frozen=True)
class Mechanism:
    """The topics of one mechanism, inputs apart from outputs.

    `told` is what drives are told that follow positions: their efforts are torques beyond that.
    It counts only in recordings that say so.

    The torque command carries the same channels as the applied torque. It is the input only
    where there is no applied torque, or on request. Where there is neither, the effort of the
    joints on /joint_states is.
    """

    name: str
    torque: Topic
    command: Topic
    extra_inputs: tuple[Topic, ...]
    outputs: tuple[Topic, ...]
    told: Topic | None = None

    @property
    def topics(self) -> dict[str, Topic]:
        """Every topic by its name."""
        every = (self.torque, self.command, *self.extra_inputs, *self.outputs)
        return {topic.name: topic for topic in every}

    @property
    def topics_with_effort(self) -> dict[str, Topic]:
        """Every topic by its name, the torque channels also on /joint_states."""
        found = self.topics
        if states := found.get(topics.JOINT_STATES):
            both = (*states.channels, *self.torque.channels)
            found[topics.JOINT_STATES] = replace(states, channels=both)
        return found

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of the torque messages, in model order."""
        return tuple(channel.joint for channel in self.torque.channels)

    @property
    def measurement(self) -> str:
        """The topic that completes a measurement, and that a controller answers."""
        return self.outputs[0].name

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the torque channels, in model order."""
        return tuple(channel.name for channel in self.torque.channels)

    @property
    def extra_input_names(self) -> tuple[str, ...]:
        """Names of the inputs that are no torque, such as `drive_enabled`."""
        return tuple(c.name for topic in self.extra_inputs for c in topic.channels)

    @property
    def told_names(self) -> tuple[str, ...]:
        """Names of the positions and rates that drives may be told."""
        told = self.told.channels if self.told else ()
        return tuple(c.name for c in told if c.name not in self.input_names)

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the measured channels, in model order."""
        return tuple(c.name for topic in self.outputs for c in topic.channels)

    def position_of(self, torque: str) -> str:
        """The channel that measures where the joint of a torque is; empty if none does."""
        joint = self.channel(torque).joint
        measured = (c for topic in self.outputs for c in topic.channels)
        fits = (c.name for c in measured if (c.joint, c.field) == (joint, 'position'))
        return next(fits, '')

    def channel(self, name: str) -> Channel:
        """The channel of that name.

        Raises:
            ValueError: This mechanism has no such channel.
        """
        for topic in (*self.topics.values(), *([self.told] if self.told else [])):
            for channel in topic.channels:
                if channel.name == name:
                    return channel
        known = (*self.input_names, *self.extra_input_names, *self.output_names)
        msg = f'{self.name} has no channel {name!r}; it has {", ".join(known)}'
        raise ValueError(msg)


def _torque_topics(frame_id: str, channels: tuple[Channel, ...]) -> tuple[Topic, Topic]:
    """The applied torque and the torque command, which share their channels."""
    return (
        Topic(topics.APPLIED_TORQUE, JOINT_STATE, frame_id, channels, required=True),
        Topic(topics.TORQUE_COMMAND, JOINT_STATE, frame_id, channels),
    )


def _drive_enabled(frame_id: str) -> Topic:
    """The switch of the motor drive: 1 while it holds the motor's terminals, 0 while open."""
    channel = Channel('drive_enabled', '1', 'position', 'enabled')
    return Topic(topics.DRIVE_ENABLED, JOINT_STATE, frame_id, (channel,))


def _define_mechanisms() -> dict[str, Mechanism]:
    """The table of interfaces.md."""
    hip = (Channel('hip_torque', 'N m', 'effort', 'hip'),)
    joint = (Channel('torque', 'N m', 'effort', 'joint'),)
    two_joints = (
        Channel('shoulder_torque', 'N m', 'effort', 'shoulder'),
        Channel('elbow_torque', 'N m', 'effort', 'elbow'),
    )
    imu = (
        Channel('imu_angle', 'rad', 'pitch'),
        Channel('imu_rate', 'rad/s', 'pitch_rate'),
    )
    hip_angle = (Channel('hip_angle', 'rad', 'position', 'hip'),)
    angle = (Channel('angle', 'rad', 'position', 'joint'),)
    two_angles = (
        Channel('shoulder_angle', 'rad', 'position', 'shoulder'),
        Channel('elbow_angle', 'rad', 'position', 'elbow'),
    )
    mechanisms = (
        Mechanism(
            'compass_gait',
            *_torque_topics('hip', hip),
            (_drive_enabled('hip'),),
            (
                Topic(topics.IMU, IMU, 'imu_link', imu),
                Topic(topics.HIP_ENCODER, JOINT_STATE, 'hip', hip_angle),
            ),
        ),
        Mechanism(
            'pendulum',
            *_torque_topics('joint', joint),
            (_drive_enabled('joint'),),
            (Topic(topics.JOINT_STATES, JOINT_STATE, 'joint', angle),),
        ),
        Mechanism(
            'double_pendulum',
            *_torque_topics('base', two_joints),
            (_drive_enabled('base'),),
            (Topic(topics.JOINT_STATES, JOINT_STATE, 'base', two_angles),),
        ),
    )
    return {mechanism.name: mechanism for mechanism in mechanisms}


MECHANISMS = _define_mechanisms()


def mechanism(name: str) -> Mechanism:
    """The mechanism of that name.

    One that has no row in the table has the topics of any machine of joints: torques, a switch of
    its drive, and its encoders and tachometers on /joint_states.

    Raises:
        ValueError: No such mechanism; the message lists those there are.
    """
    if name in MECHANISMS:
        return MECHANISMS[name]
    from cg_dynamics.mechanisms import MECHANISMS as BODIES  # symbols: nodes start without

    if name not in BODIES:
        from cg_description.reading import shown

        msg = f'unknown mechanism {shown(name)}; known are {", ".join({**MECHANISMS, **BODIES})}'
        raise ValueError(msg)
    return _of_joints(BODIES[name])


def interface(body: 'Body') -> Mechanism:
    """The mechanism of a model's body: its row of the table, or what its joints tell.

    Raises:
        ValueError: It has no row, and a sensor that is none of a joint.
    """
    return MECHANISMS.get(body.name) or _of_joints(body)


def _of_joints(body: 'Body') -> Mechanism:
    """The topics of a machine of joints, each output that of an encoder or a tachometer.

    The sensor of a joint that is driven has its name, any other that of its coordinate.
    """
    import casadi as ca

    frame = next(iter(body.joints)) if len(body.joints) == 1 else 'base'
    torques = tuple(
        Channel(channel, unit, 'effort', joint)
        for channel, unit, joint in zip(body.inputs, body.input_units, body.joints, strict=True)
    )
    count = len(body.coordinates)
    rows = [tuple(float(i == k) for i in range(count)) for k in range(count)]
    joint_of = dict(zip(rows, body.coordinates, strict=True))
    joint_of |= {tuple(row): joint for joint, row in body.joints.items()}
    q, v = ca.SX.sym('q', count), ca.SX.sym('v', count)
    ideal = body.sensors(q, v)
    measured = []
    for channel, unit in zip(body.outputs, body.output_units, strict=True):
        field = SENSOR_FIELDS.get(body.sensor_kinds[channel])
        slope = ca.jacobian(ideal[channel], v if field == 'velocity' else q)
        row = tuple(ca.evalf(slope).full()[0]) if slope.is_constant() else ()
        if field is None or row not in joint_of:
            msg = (
                f'{body.name}: output {channel!r} is no encoder or tachometer of a joint; its '
                'topics need a row in cg_interfaces/channels.py'
            )
            raise ValueError(msg)
        measured.append(Channel(channel, unit, field, joint_of[row]))
    return Mechanism(
        body.name,
        *_torque_topics(frame, torques),
        (_drive_enabled(frame),),
        (Topic(topics.JOINT_STATES, JOINT_STATE, frame, tuple(measured)),),
        _told(body, frame, torques),
    )


def _told(body: 'Body', frame: str, torques: tuple[Channel, ...]) -> Topic | None:
    """What drives that follow positions are told: where to be, how fast, and a torque more."""
    channels = []
    for torque in torques:
        unit = 'm' if body.slides(torque.joint) else 'rad'
        for name, field in zip(body.told(torque.joint), ('position', 'velocity'), strict=False):
            channels.append(
                Channel(name, unit if field == 'position' else f'{unit}/s', field, torque.joint)
            )
    if not channels:
        return None
    return Topic(topics.JOINT_COMMANDS, JOINT_STATE, frame, (*channels, *torques))


def pitch_from_quaternion(x: float, y: float, z: float, w: float) -> float:
    """Pitch about +y of a body that does not roll, whatever its heading.

    Gravity seen from the body is (-sin(pitch), 0, cos(pitch)), so that heading drops out and
    the full circle is resolved.

    Returns:
        Pitch in rad, in (-pi, pi].
    """
    return atan2(2.0 * (w * y - x * z), 1.0 - 2.0 * (x * x + y * y))


def extract(message: Any, topic: Topic) -> dict[str, float]:
    """Values of a topic's channels in one message.

    A value that the message declares absent (covariance[0] = -1 in an Imu, a joint that is not
    listed, a field of the JointState left empty) is left out of the answer.

    Returns:
        Channel name -> value in the channel's unit. May hold NaN where the message does.

    Raises:
        ValueError: The message contradicts itself (an orientation that is no unit quaternion,
            fewer values than joint names).
    """
    return EXTRACTORS[topic.msgtype](message, topic)


def _extract_joint_state(message: Any, topic: Topic) -> dict[str, float]:
    fields = {channel.field: getattr(message, channel.field) for channel in topic.channels}
    return _by_joint(list(message.name), fields, topic)


def _by_joint(
    names: list[str], fields: Mapping[str, Sequence[float]], topic: Topic
) -> dict[str, float]:
    """Values of a topic's channels from fields that hold one for each joint, or none."""
    values = {}
    for channel in topic.channels:
        field = fields[channel.field]
        if channel.joint not in names or len(field) == 0:
            continue
        index = names.index(channel.joint)
        if index >= len(field):
            msg = f'{channel.field} holds {len(field)} values for {len(names)} joint names'
            raise ValueError(msg)
        values[channel.name] = float(field[index])
    return values


def _extract_imu(message: Any, topic: Topic) -> dict[str, float]:
    values = {}
    for channel in topic.channels:
        if channel.field == 'pitch' and message.orientation_covariance[0] != -1.0:
            q = message.orientation
            norm = sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
            if isfinite(norm) and abs(norm - 1.0) > QUATERNION_NORM_TOLERANCE:
                msg = f'orientation has norm {norm:.3g}; a unit quaternion is needed'
                raise ValueError(msg)
            values[channel.name] = pitch_from_quaternion(q.x, q.y, q.z, q.w)
        if channel.field == 'pitch_rate' and message.angular_velocity_covariance[0] != -1.0:
            values[channel.name] = float(message.angular_velocity.y)
    return values


# Field of a JointState -> what it is called in a point of a trajectory.
POINT_FIELDS = {'position': 'positions', 'velocity': 'velocities', 'effort': 'effort'}


def _extract_trajectory_state(message: Any, topic: Topic) -> dict[str, float]:
    """What a controller of trajectories told its joints at that instant."""
    told = {field: getattr(message.reference, name) for field, name in POINT_FIELDS.items()}
    return _by_joint(list(message.joint_names), told, topic)


EXTRACTORS: dict[str, Callable[[Any, Topic], dict[str, float]]] = {
    JOINT_STATE: _extract_joint_state,
    IMU: _extract_imu,
    TRAJECTORY_STATE: _extract_trajectory_state,
}


def quaternion_from_pitch(pitch: float) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w) of a rotation by `pitch`, in rad, about +y."""
    return 0.0, sin(pitch / 2.0), 0.0, cos(pitch / 2.0)
