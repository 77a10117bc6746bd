"""The classes of faults of a robot on its wires: how each is made, undone, and what is to come.

zero       the torque is off in time, and no other one comes before a person has looked
rule       the same, but the next good command acts again, as how_to/own_hardware.md has it
balance    nothing that a robot should mind: it stands on
either     the torque is zero, or the robot stands; no torque acts that is old

Where nothing is done to it, which is a class as well, one sees what a busy host does by itself.
"""

import contextlib
import math
import os
import resource
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from random import Random
from typing import Any

from std_msgs.msg import Bool
from wires_rig import ROOT, Rig, load
from wires_rivals import ASKED, REQUESTED

from cg_bringup.runs import NodeOf
from cg_interfaces import topics
from cg_sysid.records.recover import JOURNAL_NAME, recover

NODES = 'drive', 'imu', 'observer', 'balance', 'safety_gate'
RIVALS = str(ROOT / 'bench/wires_rivals.py')
FOR_EVER = 10**9  # samples or frames
DRIVE_FAULTS = 0x2310, 0x3210, 0x4210, 0x7305, 0x8611  # current, voltage, heat, encoder, error
DISK = 96 << 20  # bytes of the disk that is recorded on
BUSY = 10  # processes
CLOSING = 30.0  # s that a recorder may take to end


@dataclass(frozen=True)
class Fault:
    """One class.

    Attributes:
        name: For people.
        expects: zero, rule, balance or either.
        inflict: Makes it, of the rig and what was drawn; the instant in ns if not at once.
        undo: Takes it away again.
        draw: What is random about it.
        lasts: S that it is watched.
        setup: Of the rig that it needs, of SETUPS.
        examine: What else there is to say of it, once it is over and before it is undone.
        crowds: Whether it takes the processors itself; then devices have their own meanwhile.
    """

    name: str
    expects: str
    inflict: Callable[..., int | None]
    undo: Callable[[Rig], Any] = lambda rig: None
    draw: Callable[[Random], tuple] = lambda random: ()
    lasts: float = 0.3
    setup: str = 'plain'
    examine: Callable[[Rig], dict[str, Any]] = field(default=lambda rig: {})
    crowds: bool = False


def ask(words: str) -> Callable[..., None]:
    """Of the emulated devices."""
    return lambda rig, *sizes: rig.robot.ask(words.format(*sizes))


def whole(low: int, high: int) -> Callable[[Random], tuple]:
    """A whole number, both ends included."""
    return lambda random: (random.randint(low, high),)


def spread(low: float, high: float) -> Callable[[Random], tuple]:
    """A number, every power of ten as likely as the next."""
    return lambda random: (round(10 ** random.uniform(math.log10(low), math.log10(high)), 4),)


def either_way(low: float, high: float) -> Callable[[Random], tuple]:
    """The same with a sign."""
    drawn = spread(low, high)
    return lambda random: (random.choice((-1, 1)) * drawn(random)[0],)


# Wires

BALANCE = {'expects': 'balance', 'lasts': 1.5}
NOTHING = Fault('nothing', inflict=lambda rig: None, **BALANCE)
IMU_BACK = ask('imu_noise 0')
ON_WIRES = [
    Fault('IMU silent', 'zero', ask('imu_silent'), ask('imu_back')),
    Fault('IMU unplugged', 'zero', ask('imu_unplug'), ask('imu_plug')),
    Fault('IMU frozen', 'zero', ask('imu_frozen'), ask('imu_frozen')),
    *(
        Fault(f'IMU: {told}', 'zero', ask(f'{word} {FOR_EVER}'), IMU_BACK)
        for told, word in (
            ('noise only', 'imu_noise'), ('every sample cut off', 'imu_short'),
            ('every sum wrong', 'imu_flip'), ('no numbers (NaN)', 'imu_nan'),
        )
    ),
    Fault('IMU: 1 to 60 bytes of garbage', inflict=ask('imu_garbage {}'), draw=whole(1, 60),
          **BALANCE),
    Fault('IMU: 1 to 3 samples cut off', inflict=ask('imu_short {}'), draw=whole(1, 3), **BALANCE),
    Fault('IMU: 1 to 3 sums wrong', inflict=ask('imu_flip {}'), draw=whole(1, 3), **BALANCE),
    Fault('IMU: its clock jumps', 'either', ask('imu_jump {}'), draw=either_way(5e-3, 3000.0),
          lasts=1.5),
    Fault('bus silent', 'zero', ask('can_silent'), ask('can_back')),
    Fault('bus unplugged', 'zero', ask('can_unplug'), ask('can_plug')),
    Fault('bus: noise only', 'zero', ask(f'can_noise {FOR_EVER}'), ask('can_noise 0')),
    Fault("bus: the host's heartbeat lost", 'zero', ask('heartbeat_silent'),
          ask('heartbeat_back')),
    Fault('bus: 1 to 40 bytes of garbage', inflict=ask('can_garbage {}'), draw=whole(1, 40),
          **BALANCE),
    Fault('bus: 1 to 40 frames of others', inflict=ask('can_foreign {}'), draw=whole(1, 40),
          **BALANCE),
    Fault('bus: 1 to 3 frames lost', inflict=ask('can_lose {}'), draw=whole(1, 3), **BALANCE),
    Fault('drive: a fault of its own', 'zero', ask('drive_fault {}'),
          draw=lambda random: (random.choice(DRIVE_FAULTS),)),
    Fault('drive switched off', 'zero', ask('drive_off'), ask('drive_on')),
]  # fmt: skip


# Nodes


def send(name: str, number: signal.Signals) -> Callable[..., None]:
    """A signal to a node."""
    return lambda rig, *sizes: os.kill(rig.supervisor.processes[name].pid, number)


def held_up(rig: Rig, seconds: float) -> None:
    """The controller stands still for a moment."""
    pid = rig.supervisor.processes['balance'].pid
    os.kill(pid, signal.SIGSTOP)
    rig.person.wait(seconds)
    os.kill(pid, signal.SIGCONT)


OF_NODES = [
    *(
        Fault(f'{name.replace("_", " ")} {told}', 'zero', send(name, number), undo(name))
        for name in NODES
        for told, number, undo in (
            ('killed', signal.SIGKILL, lambda name: lambda rig: rig.start(name)),
            ('stopped, continued', signal.SIGSTOP,
             lambda name: lambda rig: rig.go_on()),
            ('restarted', signal.SIGTERM, lambda name: lambda rig: rig.start(name)),
        )
    ),
    Fault('balance held up for 30 to 80 ms', 'rule', held_up,
          draw=lambda random: (round(random.uniform(0.03, 0.08), 4),), lasts=1.5),
]  # fmt: skip


# Topics


def speak(topic: str, hz: float) -> Callable[..., int]:
    """A second publisher; the instant at which it had found everybody who listens."""

    def inflict(rig: Rig) -> int:
        listeners = rig.person.node.count_subscribers(topic)
        return int(rig.ask(rig.helper(RIVALS, 'rival'), f'speak {topic} {listeners} {hz}'))

    return inflict


def fall_silent(rig: Rig) -> None:
    """The second publisher is gone."""
    rig.ask(rig.helper(RIVALS, 'rival'), 'quiet')


def spoil(how: str) -> Callable[..., None]:
    """Requests, on their way from the controller to the gate."""

    def inflict(rig: Rig, *sizes: float) -> None:
        rig.ask(rig.helper(RIVALS, 'relay'), how.format(*sizes))

    return inflict


def press_stop(rig: Rig) -> None:
    """The emergency stop, by its topic."""
    rig.person.stop.publish(Bool(data=True))


def let_stop_go(rig: Rig) -> None:
    """The emergency stop is not pressed any more."""
    rig.person.stop.publish(Bool(data=False))


RELAYED = {'undo': spoil('well'), 'setup': 'relayed'}
ON_TOPICS = [
    Fault('second publisher of the request', 'zero', speak(REQUESTED, 500.0),
          fall_silent, setup='rival'),
    Fault('second publisher of the command', 'rule', speak(topics.TORQUE_COMMAND, 500.0),
          fall_silent, setup='rival'),
    Fault('flood of requests', 'zero', speak(REQUESTED, 0.0), fall_silent, setup='rival',
          crowds=True),
    Fault('flood of commands', 'rule', speak(topics.TORQUE_COMMAND, 0.0), fall_silent,
          setup='rival', crowds=True),
    Fault('request: NaN', 'zero', spoil('nan'), **RELAYED),
    Fault('request: of another joint', 'zero', spoil('joint'), **RELAYED),
    # The gate stops for what is older than 0.1 s; before that the drive lets no torque act.
    Fault('request: stamp 25 to 90 ms old', 'rule', spoil('old {}'), draw=spread(0.025, 0.09),
          **RELAYED),
    Fault('request: stamp 0.12 s to 1 h old', 'zero', spoil('old {}'), draw=spread(0.12, 3600.0),
          **RELAYED),
    Fault('request: stamp 10 ms to 1 h ahead', 'zero', spoil('ahead {}'),
          draw=spread(0.01, 3600.0), **RELAYED),
    Fault('emergency stop by topic', 'zero', press_stop, let_stop_go),
    Fault('emergency stop by service', 'zero',
          lambda rig: rig.person.call('/safety_gate/stop') and None),
]  # fmt: skip


# The host


class SmallDisk:
    """A disk that can be filled: a tmpfs where one may be mounted, or a limit of file sizes."""

    def __init__(self, path: Path):
        self.path, self.ballast = path, path / 'ballast'
        mount = ['mount', '-t', 'tmpfs', '-o', f'size={DISK}', 'none', str(path)]
        try:
            self.mounted = subprocess.run(mount, capture_output=True).returncode == 0
        except OSError:
            self.mounted = False

    @property
    def bag(self) -> Path:
        """What is recorded."""
        return self.path / 'bag'

    def fill(self, left: int, process: subprocess.Popen) -> None:
        """Only so many bytes are left from now on, for the process that records."""
        if not self.mounted:
            size = (self.bag / JOURNAL_NAME).stat().st_size + left
            resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (size, size))
            return
        with self.ballast.open('wb') as file:
            for _ in range(100):  # the recorder may have taken some of it in between
                room = os.statvfs(self.path)
                with contextlib.suppress(OSError):
                    free = room.f_bavail * room.f_frsize
                    os.posix_fallocate(file.fileno(), 0, max(1, free - left))
                    break

    def empty(self) -> None:
        """Somebody makes room."""
        self.ballast.unlink(missing_ok=True)

    def close(self) -> None:
        """Nothing is left."""
        if self.mounted:
            subprocess.run(['umount', '-l', str(self.path)], check=True)
        shutil.rmtree(self.path, ignore_errors=True)


def fill_disk(rig: Rig, left: int) -> None:
    """It is full, but for so many bytes."""
    rig.beside['said'] = rig.log.stat().st_size
    rig.beside['disk'].fill(left, rig.supervisor.processes['recorder'])


def examine_recording(rig: Rig) -> dict[str, Any]:
    """How the recorder ended, and what there is of its recording once there is room again."""
    process, disk = rig.supervisor.processes['recorder'], rig.beside['disk']
    rig.person.until(lambda: process.poll() is not None, CLOSING)
    with rig.log.open() as log:
        log.seek(rig.beside['said'])
        said = log.read()
    errors = [x for x in said.splitlines() if '[recorder]' in x and '[ERROR]' in x]
    written = sum(f.stat().st_size for f in disk.bag.rglob('*') if f.is_file())
    disk.empty()
    try:
        messages = recover(disk.bag).messages
    except (OSError, ValueError) as error:
        messages, errors = 0, [*errors, str(error)]
    return {
        'status': process.returncode, 'errors': errors, 'traceback': 'Traceback' in said,
        'written': written, 'recovered': messages,
    }  # fmt: skip


def record_again(rig: Rig) -> None:
    """With a new bag."""
    bag = rig.beside['disk'].bag
    shutil.rmtree(bag, ignore_errors=True)
    rig.start('recorder')
    journal = bag / JOURNAL_NAME
    rig.person.until(lambda: journal.exists() and journal.stat().st_size > 100_000)


def be_busy(rig: Rig, seconds: float, impulse: float) -> None:
    """Others work, and somebody pushes."""
    with load(BUSY):
        rig.person.wait(seconds / 2)
        rig.robot.ask(f'push {impulse}')
        rig.person.wait(seconds / 2)


OF_THE_HOST = [
    Fault('disk full while recording', inflict=fill_disk, undo=record_again,
          draw=lambda random: (random.randint(0, 200_000),), setup='recorded',
          examine=examine_recording, expects='balance', lasts=2.0),
    Fault(f'{BUSY} busy processes', 'either', be_busy,
          draw=lambda random: (
              round(random.uniform(2.0, 5.0), 3),
              round(random.choice((-1, 1)) * random.uniform(0.1, 0.4), 3),
          ), lasts=0.0, crowds=True),
]  # fmt: skip

FAULTS = {f.name: f for f in (NOTHING, *ON_WIRES, *OF_NODES, *ON_TOPICS, *OF_THE_HOST)}


def of_nodes(told: str) -> tuple[str, ...]:
    """What becomes of a node, for each of them."""
    return tuple(f'{name.replace("_", " ")} {told}' for name in NODES)


# Kind -> the faults that are of it.
KINDS: dict[str, tuple[str, ...]] = {
    'nothing is done': (NOTHING.name,),
    'a device falls silent': ('IMU silent', 'bus silent'),
    'unplugged, plugged in': ('IMU unplugged', 'bus unplugged'),
    'garbage and cut-off frames': (
        'IMU: noise only', 'IMU: every sample cut off', 'IMU: 1 to 60 bytes of garbage',
        'IMU: 1 to 3 samples cut off', 'bus: noise only', 'bus: 1 to 40 bytes of garbage',
    ),
    'wrong sums, no numbers': (
        'IMU: every sum wrong', 'IMU: 1 to 3 sums wrong', 'IMU: no numbers (NaN)',
    ),
    'frozen device': ('IMU frozen',),
    'clock jumps': ('IMU: its clock jumps',),
    'frames lost, frames of others': (
        'bus: 1 to 3 frames lost', 'bus: 1 to 40 frames of others',
    ),
    'heartbeat lost': ("bus: the host's heartbeat lost",),
    'fault of the drive': ('drive: a fault of its own', 'drive switched off'),
    'node killed': of_nodes('killed'),
    'node stopped, continued': (
        *of_nodes('stopped, continued'), 'balance held up for 30 to 80 ms',
    ),
    'node restarted': of_nodes('restarted'),
    'two publishers': ('second publisher of the request', 'second publisher of the command'),
    'flood of messages': ('flood of requests', 'flood of commands'),
    'spoilt requests': tuple(f.name for f in ON_TOPICS if f.name.startswith('request:')),
    'emergency stop': ('emergency stop by topic', 'emergency stop by service'),
    'disk full': ('disk full while recording',),
    'busy host': (f'{BUSY} busy processes',),
}  # fmt: skip


# What a robot needs for them


@contextmanager
def plain() -> Iterator[dict[str, Any]]:
    """As robot.launch.py has it."""
    yield {}


@contextmanager
def with_rival() -> Iterator[dict[str, Any]]:
    """Somebody is there who may speak out of turn."""
    yield {'begin': lambda rig: rig.helper(RIVALS, 'rival')}


@contextmanager
def relayed() -> Iterator[dict[str, Any]]:
    """Requests go through somebody who may spoil them."""

    def change(nodes: dict[str, NodeOf]) -> None:
        nodes['balance'] = replace(nodes['balance'], remappings=((topics.TORQUE_COMMAND, ASKED),))

    yield {'change': change, 'begin': lambda rig: rig.helper(RIVALS, 'relay', between=True)}


@contextmanager
def recorded() -> Iterator[dict[str, Any]]:
    """A recorder beside the robot, on a small disk."""
    disk = SmallDisk(Path(tempfile.mkdtemp(prefix='cg_disk_')))

    def change(nodes: dict[str, NodeOf]) -> None:
        disk.empty()
        shutil.rmtree(disk.bag, ignore_errors=True)  # of the robot before
        bag = {'bag': str(disk.bag)}
        nodes['recorder'] = NodeOf('cg_sysid', 'recorder_node', bag, ending=CLOSING)

    try:
        yield {'change': change, 'begin': lambda rig: rig.beside.update(disk=disk)}
    finally:
        disk.close()


SETUPS = {'plain': plain, 'rival': with_rival, 'relayed': relayed, 'recorded': recorded}
