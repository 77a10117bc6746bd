"""ROS node of the IMU: a MicroStrain 3DM-GX3-25 on a serial line. Its bytes: imu/gx3.py.

Stamps are the instants of the samples: ticks of the device on the host's clock, drift and all
(imu/device_clock.py). A line that falls silent, a device that repeats itself, and a plug that is
pulled are told on /diagnostics; nothing is published until true samples come again, and the line
is opened anew by itself.

Stand the inner legs upright and call ~/zero. Which axis is along the hip, and with which sign:
stand them upright, call ~/find_axis, and lean them forward by 0.2 rad within 10 s; the log says
what to set. Another IMU needs no node of ours, only a driver that publishes
sensor_msgs/Imu, remapped to /imu (how_to/own_hardware.md).

out   /imu, /diagnostics
"""

import math
import time
from collections import deque
from dataclasses import dataclass

import serial
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from cg_hardware.imu import gx3
from cg_hardware.imu.device_clock import DeviceClock
from cg_hardware.imu.mounting import AXES, Mounting, MountingError, mounting_of, zero_of
from cg_hardware.imu.zero_file import read_zero, write_zero
from cg_interfaces import topics
from cg_interfaces.dates import iso_now
from cg_interfaces.ros import (
    MACHINE_QOS,
    DeclaredSettings,
    Throttled,
    publish_status,
    run,
    to_stamp,
)
from cg_interfaces.settings import Settings, setting

PATIENCE = 0.002  # s that a read waits for the first byte
RETRY = 0.5  # s between attempts to open the line
SILENCE = 0.1  # s without a sample after which the line counts as dead
BITS_PER_BYTE = 10  # of 8N1
ZERO_SAMPLES = 250  # half a second
PRIORITY = -10  # niceness, where it may be had
LEAN, LEAN_WITHIN = 0.2, 10.0  # rad, s: of a person who shows the axis


@dataclass(frozen=True)
class ImuSettings(Settings):
    """Parameters of the IMU node."""

    port: str = setting('/dev/ttyACM0', 'serial line of the IMU')
    baud: int = setting(921_600, 'of the line', unit='bit/s', minimum=9600, maximum=3_000_000)
    rate_hz: float = setting(500.0, 'of the samples', unit='Hz', minimum=1.0, maximum=1000.0)
    axis: str = setting('pitch', 'angle of the device that is the lean', choices=AXES)
    sign: float = setting(
        1.0, '1, or -1 where the device counts a forward lean negative', minimum=-1.0, maximum=1.0
    )
    latency: float = setting(
        0.0,
        'from the instant of a sample to its first byte on the line, by data sheet or measured',
        unit='s', minimum=0.0, maximum=0.1,
    )  # fmt: skip
    zero_file: str = setting(
        '', 'file that keeps the zero, YAML; empty: a zero is lost when the node ends'
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.sign) != 1.0:
            raise ValueError(f'sign is {self.sign:g}; it must be 1 or -1')
        gx3.sampling_command(self.rate_hz)

    @property
    def wire_s(self) -> float:
        """Time in s from the instant of a sample until its last byte is here, at least."""
        length = gx3.LENGTHS[gx3.EULER_AND_RATES]
        return self.latency + BITS_PER_BYTE * length / self.baud


class ImuNode(Node):
    """The IMU."""

    def __init__(self, **kwargs):
        super().__init__('imu', **kwargs)
        self.line: serial.Serial | None = None
        self.declared = DeclaredSettings(self, ImuSettings)
        self.settings: ImuSettings = self.declared.values
        zero, self.zeroed_at = read_zero(self.settings.zero_file)
        self.found: Mounting | None = None
        self.mounting = Mounting(self.settings.axis, self.settings.sign, zero)
        self.publisher = self.create_publisher(Imu, topics.IMU, MACHINE_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.create_service(Trigger, '~/zero', self.on_zero)
        self.create_service(Trigger, '~/find_axis', self.on_find_axis)
        self.message = Imu()
        self.message.header.frame_id = 'imu_link'
        self.message.linear_acceleration_covariance[0] = -1.0
        self.recent: deque[float] = deque(maxlen=ZERO_SAMPLES)  # angles in rad, signed, no zero
        self.parser = gx3.Parser()
        self.clock = DeviceClock(gx3.TICKS_PER_S, gx3.TICKS)
        self.problem = 'not opened yet'
        self._last_ticks: int | None = None
        self._last_stamp_ns = 0
        self._seen = time.monotonic()
        self._retry_at = 0.0
        self._next_diagnosis = time.monotonic() + 1.0
        self._published = self._repeated = self._told_bad = 0
        self._warn = Throttled(self.get_logger().warning)
        self._euler: tuple[float, float, float] | None = None
        self._upright: tuple[float, float, float] | None = None  # while an axis is sought
        self._lean_until = 0.0

    # The line

    def poll(self) -> float:
        """Read what there is, and publish it."""
        now = time.monotonic()
        if now >= self._next_diagnosis:
            self._publish_diagnostics(now)
        if self.line is None:
            if now >= self._retry_at:
                self._open(now)
            return 0.02
        try:
            data = self.line.read(1)
            data += self.line.read(self.line.in_waiting) if data else b''
        except (serial.SerialException, OSError, TypeError) as error:
            self._lose(f'{self.settings.port}: {error}')
            return 0.02
        for reading in self.parser.feed(data, time.time_ns()) if data else ():
            self._take(reading)
        if time.monotonic() - self._seen > SILENCE:
            self._lose(f'{self.settings.port}: no samples for {SILENCE:g} s')
        return 0.0

    def _open(self, now: float) -> None:
        self._retry_at = now + RETRY
        try:
            self.line = serial.Serial(
                self.settings.port, self.settings.baud, timeout=PATIENCE, write_timeout=0.1,
                exclusive=True,
            )  # fmt: skip
            self.line.write(gx3.STOP_COMMAND)
            self.line.reset_input_buffer()
            self.line.write(gx3.IDENTITY_COMMANDS)
            self.line.write(gx3.sampling_command(self.settings.rate_hz))
            self.line.write(gx3.continuous_command())
        except (serial.SerialException, OSError, ValueError) as error:
            self._lose(f'{self.settings.port}: {error}')
            return
        self.parser = gx3.Parser()
        self._told_bad = 0
        self.clock = DeviceClock(gx3.TICKS_PER_S, gx3.TICKS, self.settings.wire_s)
        self._last_ticks = None
        self._seen = time.monotonic()

    def _lose(self, problem: str) -> None:
        """Close the line; it is opened anew after a while."""
        if self.line is not None:
            try:
                self.line.close()
            except OSError:
                pass  # a plug that is pulled
        self.line = None
        self.problem = problem
        self._retry_at = time.monotonic() + RETRY
        self._warn(f'{problem}; nothing is published until samples come')

    def _take(self, reading: gx3.Reading) -> None:
        """Publish one reading."""
        if reading.ticks == self._last_ticks:
            self._repeated += 1
            self.problem = 'the device repeats itself'
            return  # and is lost as a silent one
        self._last_ticks = reading.ticks
        self._seen = time.monotonic()
        stamp_ns = self.clock.stamp(reading.ticks, reading.received_ns)
        if stamp_ns <= self._last_stamp_ns:
            return  # the clock was laid anew: time does not run backwards
        self._last_stamp_ns = stamp_ns
        self.problem = ''
        self._euler = reading.euler
        if self._upright is not None:
            self._find_axis(reading.euler)
        lean = self.mounting.lean(reading.euler)
        self.recent.append(lean + self.mounting.zero)
        self.message.header.stamp = to_stamp(stamp_ns)
        self.message.orientation.y = math.sin(0.5 * lean)
        self.message.orientation.w = math.cos(0.5 * lean)
        self.message.angular_velocity.y = self.mounting.rate(reading.rates)
        self.publisher.publish(self.message)
        self._published += 1

    # What people ask for

    def on_zero(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """The lean of the last half second is upright, if the legs stood still."""
        try:
            if self.problem:
                raise MountingError(self.problem)
            zero = zero_of(self.recent)
            zeroed_at = iso_now()
            if self.settings.zero_file:
                write_zero(self.settings.zero_file, self.mounting, zero, zeroed_at)
        except (MountingError, OSError) as error:
            response.success, response.message = False, f'no zero was taken: {error}'
            return response
        self.mounting = Mounting(self.mounting.axis, self.mounting.sign, zero.angle)
        self.zeroed_at = zeroed_at
        response.success = True
        response.message = (
            f'zero at {zero.angle:.5f} rad, from {zero.samples} samples, still to '
            f'{1e3 * zero.still:.2g} mrad'
        )
        self.get_logger().info(response.message)
        return response

    def on_find_axis(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """From now on a forward lean tells the axis along the hip and its sign."""
        response.success = not self.problem and self._euler is not None
        if response.success:
            self._upright, self._lean_until = self._euler, time.monotonic() + LEAN_WITHIN
            self.found = None
        response.message = self.problem or f'lean forward by 0.2 rad within {LEAN_WITHIN:g} s'
        return response

    def _find_axis(self, euler: tuple[float, float, float]) -> None:
        assert self._upright is not None
        moved = max(abs(a - b) for a, b in zip(euler, self._upright, strict=True))
        if moved < LEAN and time.monotonic() < self._lean_until:
            return
        try:
            self.found = found = mounting_of(self._upright, euler)
        except MountingError as error:
            self.get_logger().error(f'no axis was found: {error}')
        else:
            self.get_logger().info(
                f'the lean is {found.axis}: set axis {found.axis}, sign {found.sign:+g}'
            )
        self._upright = None

    def _publish_diagnostics(self, now: float) -> None:
        self._next_diagnosis = now + 1.0
        status = DiagnosticStatus(name='imu', hardware_id=self.settings.port)
        bad = self.parser.bad - self._told_bad
        status.level = DiagnosticStatus.WARN if bad else DiagnosticStatus.OK
        status.message = 'samples with wrong sums' if bad else 'sampling'
        if self.problem:
            status.level, status.message = DiagnosticStatus.ERROR, self.problem
        publish_status(self.diagnostics, status, {
            'samples_per_s': self._published, 'repeated': self._repeated, 'bad': bad,
            'bytes_skipped': self.parser.skipped,
            'clock_drift_ppm': f'{1e6 * self.clock.drift:.1f}',
            'clock_jumps': self.clock.jumps, 'zero_rad': f'{self.mounting.zero:.6f}',
            'zeroed_at': self.zeroed_at, 'axis': self.mounting.axis,
            'sign': f'{self.mounting.sign:+g}',
            'found': f'{self.found.axis} {self.found.sign:+g}' if self.found else '',
            **self.parser.identity,
        })  # fmt: skip
        self._published = self._repeated = 0
        self._told_bad = self.parser.bad

    def close(self) -> None:
        """Leave the device quiet."""
        if self.line is not None:
            try:
                self.line.write(gx3.STOP_COMMAND)
                self.line.close()
            except (serial.SerialException, OSError):
                pass  # a plug that is pulled


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_hardware imu_node`."""
    return run(ImuNode, ImuSettings, args, niceness=PRIORITY)


if __name__ == '__main__':
    raise SystemExit(main())
