"""The nodes of a robot whose IMU and drive hang on wires: the same above them as in simulation.

    ros2 run cg_bringup robot --imu /dev/ttyACM0 --interface socketcan --channel can0
    ros2 run cg_bringup robot --emulated     # at a desk, with emulated devices on the wires

    ros2 run cg_bringup robot --emulated inner_fixed   # the inner legs clamped, as in experiments

robot.launch.py starts the same nodes. Nothing moves before a person arms the robot. The gate
listens to `balance`, or to the experimenter, who carries out checklist and experiments.
"""

import argparse
import contextlib
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

from cg_bringup.balancing import FALLEN
from cg_bringup.runs import NodeOf
from cg_bringup.supervisor import ProcessDied, supervised
from cg_dynamics.stop_request import Stopped
from cg_hardware.drive.settings import read_settings
from cg_interfaces import topics

RATES = 200.0, 1000.0  # Hz: at less, a command that comes a cycle late would count as lost
OFF = 0.020  # s after the last command, at which the torque is zero
SLACK = 0.003  # s of them that the drive node may be late
MISSING = 0.1  # s without requests after which a person must look; busy hosts miss 30 ms
BLIND = 0.02  # s without the encoder
OWNERS = 'balance', 'experimenter'  # whom the gate may listen to
NEXT = (
    'nothing moves yet. Read /robot_state; call /imu/zero and /drive/zero (legs upright and '
    'still; or /drive/home, /drive/index_by_hand), /safety_gate/arm, /drive/enable. '
    '/safety_gate/stop is the emergency stop'
)
FREE = 'free'


@dataclass(frozen=True)
class RobotOptions:
    """What the launch file is told.

    Attributes:
        rate: Of measurements, commands and the drive's cycles, in Hz.
        imu: Serial line of the IMU.
        baud: Of it, bit/s.
        axis: Angle of the IMU that is the lean: roll, pitch or yaw.
        imu_sign: 1.0, or -1.0 where it counts a forward lean negative.
        zero_file: Keeps the IMU's zero; empty for none.
        driver: Kind of drive: cia402, or one of yours.
        interface: python-can's name of the CAN adapter.
        channel: Of the adapter.
        drive: Number of the drive on the bus.
        drive_sign: 1.0, or -1.0 where its torque turns the joint backward.
        gear: Torque at the joint per torque of the motor.
        counts_per_turn: Of the encoder, per turn of the joint.
        torque_limit: In N m.
        drive_zero_file: Keeps the zero of the hip; empty for none.
        drive_settings: YAML file with more parameters of the drive node; they come before these.
        model: Model file of observer and controller; empty for the nominal one.
        epsilon: Of the observer, s.
    """

    rate: float = 500.0
    imu: str = '/dev/ttyACM0'
    baud: int = 921_600
    axis: str = 'pitch'
    imu_sign: float = 1.0
    zero_file: str = ''
    driver: str = 'cia402'
    interface: str = 'socketcan'
    channel: str = 'can0'
    drive: int = 1
    drive_sign: float = 1.0
    gear: float = 1.0
    counts_per_turn: float = 20_000.0
    torque_limit: float = 40.0
    drive_zero_file: str = ''
    drive_settings: str = ''
    model: str = ''
    epsilon: float = 0.2


def asks_as(owner: str) -> tuple[tuple[str, str], ...]:
    """Remapping by which a controller asks the gate as that owner."""
    return ((topics.TORQUE_COMMAND, f'{topics.TORQUE_REQUEST}/{owner}'),)


def robot_nodes(options: RobotOptions) -> dict[str, NodeOf]:
    """Node name -> what to start, in the order of ending.

    Raises:
        ValueError: The file of the drive's settings or the rate cannot be used.
    """
    slowest, fastest = RATES
    if not slowest <= options.rate <= fastest:
        raise ValueError(
            f'rate is {options.rate:g} Hz; allowed is {slowest:g} to {fastest:g}: the torque must '
            f'be zero {1e3 * OFF:g} ms after the last command'
        )
    rate = {'sample_rate_hz': options.rate}
    more = read_settings(options.drive_settings) if options.drive_settings else {}
    gate = rate | {'torque_limit': options.torque_limit}
    model = rate | {'model_file': options.model}
    return {
        'drive': NodeOf('cg_hardware', 'drive_node', gate | {
            'stale_after': OFF - SLACK - 1 / options.rate, 'driver': options.driver,
            'interface': options.interface, 'channel': options.channel, 'node_id': options.drive,
            'sign': options.drive_sign, 'gear': options.gear,
            'counts_per_turn': options.counts_per_turn, 'zero_file': options.drive_zero_file,
        } | more),
        'imu': NodeOf('cg_hardware', 'imu_node', {
            'port': options.imu, 'baud': options.baud, 'rate_hz': options.rate,
            'axis': options.axis, 'sign': options.imu_sign, 'zero_file': options.zero_file,
        }),
        'balance': NodeOf('cg_control', 'balance_node', model, asks_as('balance')),
        'safety_gate': NodeOf('cg_hardware', 'safety_gate_node', gate | {
            'arming': True, 'fall_angle': FALLEN, 'stale_after': MISSING,
            'owners': list(OWNERS), 'owner': OWNERS[0],
        }),
        'observer': NodeOf('cg_estimation', 'observer_node', model | {
            'epsilon': options.epsilon, 'longest_blind': BLIND,
        }),
    }  # fmt: skip


TOLD = {
    'rate': 'of measurements, commands and the cycles of the drive, Hz',
    'imu': 'serial line of the IMU',
    'baud': 'of it, bit/s',
    'axis': 'angle of the IMU that is the lean: roll, pitch or yaw',
    'imu_sign': '1, or -1 where the IMU counts a forward lean negative',
    'zero_file': 'keeps the zero of the IMU; empty for none',
    'driver': 'kind of drive: cia402, or one of yours (cg_hardware/drive/drivers.py)',
    'interface': "python-can's name of the CAN adapter: socketcan, slcan, ...",
    'channel': 'of the adapter',
    'drive': 'number of the drive on the bus',
    'drive_sign': '1, or -1 where its torque turns the joint backward',
    'gear': 'torque at the joint per torque of the motor',
    'counts_per_turn': 'of the encoder, per turn of the joint',
    'torque_limit': 'N m',
    'drive_zero_file': 'keeps the zero of the hip; empty for none',
    'drive_settings': 'YAML file: more parameters of the drive node, before those given here',
    'model': 'model of observer and controller, a file or a name; empty: nominal',
    'epsilon': 'time constant of the observer, s',
}


@contextlib.contextmanager
def emulated_devices(folder: Path, fixture: str = FREE) -> Iterator[None]:
    """Emulated devices whose wires end in a folder, while the context lasts."""
    words = []
    if fixture != FREE:
        words = ['--setup', f'fixture: {fixture}', '--state', '0', '0']
    process = subprocess.Popen(
        [sys.executable, '-m', 'cg_hardware.emulators.robot', str(folder), *words],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        assert process.stdout is not None
        if process.stdout.readline() != 'ready\n':
            raise OSError('the emulated devices did not start')
        yield
    finally:
        process.kill()
        process.communicate()


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup robot`."""
    parser = argparse.ArgumentParser(prog='robot', description=__doc__.splitlines()[0])
    for field in fields(RobotOptions):
        parser.add_argument(
            f'--{field.name.replace("_", "-")}', type=type(field.default), default=field.default,
            help=f'{TOLD[field.name]} [{field.default}]',
        )  # fmt: skip
    parser.add_argument(
        '--emulated',
        nargs='?',
        const=FREE,
        choices=(FREE, 'inner_fixed', 'outer_fixed'),
        help='no robot is there: emulated devices on pty and CAN, the robot free or in a fixture',
    )
    given = vars(parser.parse_args(args))
    emulated = given.pop('emulated')
    try:
        with tempfile.TemporaryDirectory(prefix='cg_wires_') as directory:
            if emulated:
                wires = {name: f'{directory}/{name}' for name in ('imu', 'can')}
                given |= {'imu': wires['imu'], 'interface': 'slcan', 'channel': wires['can']}
            devices: contextlib.AbstractContextManager = contextlib.nullcontext()
            if emulated:
                devices = emulated_devices(Path(directory), emulated)
            with devices, supervised(robot_nodes(RobotOptions(**given))) as supervisor:
                print(f'robot: {NEXT}', flush=True)
                supervisor.wait('drive')
    except ProcessDied as error:
        print(f'robot: {error}', file=sys.stderr)
        return 1
    except Stopped as stopped:
        return stopped.status
    except (ValueError, OSError) as error:
        print(f'robot: {error}', file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
