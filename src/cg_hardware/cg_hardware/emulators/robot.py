"""The compass gait that is not there, behind an IMU and a drive that are not there either.

    python -m cg_hardware.emulators.robot FOLDER [--model NAME] [--setup YAML] [--state X ...]

makes FOLDER/imu, the serial line of a 3DM-GX3-25, and FOLDER/can, a serial CAN adapter with a
CiA 402 drive behind it. A person holds the robot, and lets it go when its drive becomes enabled;
from then on it stands or falls by what the drive is told. Time is this process's own, and runs as
fast as real.

Faults, and what hands do, are asked for on standard input or on the pipe FOLDER/hands, one a line,
with a number where one is needed:

    imu_silent  imu_back  imu_frozen  imu_garbage N  imu_cut N  imu_unplug  imu_plug
    imu_noise N  imu_short N  imu_flip N  imu_nan N (the next N samples are noise, lose their end,
    have a bit that is wrong, or a number that is none)  imu_jump T (its timer jumps by T s)
    can_silent  can_back  can_garbage N  can_unplug  can_plug  can_lose N  can_noise N (the next N
    frames of the drive are lost, or noise)  can_foreign N (frames of other devices)
    heartbeat_silent  heartbeat_back (the host's)
    lean A (a person leans the inner legs by A rad)  foot_inner 1  foot_outer 0 (their switches)
    drive_fault CODE  drive_off  drive_on  drive_volts V  drive_degc T  drive_lacks INDEX
    usb_ms T (the IMU's bytes go out every T ms)  can_jitter_ms T  push P (N s at the hip)
    let_go  hold  turn A (a person opens the hip by A rad more, while the robot is held)
    stand (a person holds it and puts it back to where it began)  report

`report` prints one line of JSON: the time, and the instant on the clock of the day at which it
began (`epoch_ns`), the state of the drive, its torque and every change of it since the last
report, its outputs, the lean of the stance leg, how far it went, the hip angle, and how long the
host held the emulation up since the last report (`late`, s): what was measured meanwhile says
little. `--trace FILE` writes down what went and came, a line each, instants in ns on the clock of
the day:

    sample INSTANT SENT PITCH (of the IMU, rad)
    command CAME TORQUE (per mille of rated)    sync CAME ACTING (the same, from now on)
"""

import argparse
import contextlib
import gc
import json
import math
import os
import random
import select
import struct
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

import numpy as np

from cg_description.paths import model_path
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_hardware.emulators.cia402_device import Cia402Device
from cg_hardware.emulators.gx3_device import TIMER_HZ, Gx3Device, closed
from cg_hardware.emulators.wires import HANDS, Pty, SerialCan
from cg_hardware.simulation import read_setup
from cg_interfaces.priority import take_priority

STEP = 0.002  # s of the body, and of its sensors
PRIORITY = -19  # niceness, where it may be had
BEHIND = 0.5  # s that the emulation may be late before it lets time go
DRIFT = 40e-6  # of the IMU's quartz
WRAPS_SOON = 4_294_000_000  # ticks: the counter begins anew within the first half minute
LEANING = 0.5  # rad/s at which a person leans the legs
SHELL = 12_345  # counts at which the encoder wakes up
INDEX = 0.06  # rad of the hip at which the encoder has its index
BY_HAND = 0.3  # rad/s at which a person turns the hip
LEGS = ('q_inner', 'q_outer')
FOOT_BITS = {'inner': 1 << 16, 'outer': 1 << 17}  # of the drive's inputs, a foot switch each
GIMBAL = (0.012, -0.7)  # rad: roll and yaw of an IMU that is mounted as people mount things
FLOOR = 0.6  # rad from where it stood, from where a person picks it up
HEARTBEAT = 0x77F  # of the host
FRAME_BYTES = 22  # of a drive's answer on the serial line
FOREIGN = range(0x400, 0x500)  # identifiers that no device of this bus has


class EmulatedRobot:
    """Body and devices.

    Args:
        folder: Gets the ends of the wires.
        model: Of the body.
        setup: What was done to the rig.
        state: Free coordinates and their rates at the start, rad and rad/s.
        seed: Of the sensors' noise, of jitter and garbage.
    """

    def __init__(
        self, folder: Path, model: Model, setup: Setup, state: Sequence[float], seed: int = 1
    ):
        self._plant = Plant(model, setup, np.array(state), STEP, seed)
        resolution = model.sensors['hip_angle'].get('resolution')
        self._count = resolution.value if resolution else 2 * math.pi / 20_000
        self._random = random.Random(seed)
        self._folder = folder
        self.imu_line: Pty | None = Pty(folder / 'imu')
        self.can_line: Pty | None = Pty(folder / 'can')
        self._can = SerialCan(self.can_line)
        self.imu = Gx3Device(drift=DRIFT, timer=WRAPS_SOON)
        self._index = SHELL + round(INDEX / self._count)
        self.drive = self._new_drive()
        self._greeted = False
        # Where a person leads the legs, rad by name, while the robot is held.
        self._goal: dict[str, float] = {}
        self._start = self._angles
        self._enabled = False
        self._hip, self._hip_rate = self._plant.measure().outputs['hip_angle'], 0.0
        self._held = True
        self._silent: set[str] = set()
        self._usb_s = self._jitter_s = 0.0
        self._lean_to = self._leant = 0.0  # by a person, rad
        self._pressed: dict[str, float] = {}  # foot switches, by a person
        self._waiting = b''
        self._flushed = 0.0
        self._late_frames: list[tuple[float, tuple[int, bytes]]] = []
        self._bad_samples = self._bad_frames = '', 0  # kind, and how many more
        self.begun = time.monotonic()  # instant of time zero
        self.trace: TextIO | None = None
        self._samples: list[tuple[float, bytes, float]] = []  # not due yet: s, bytes, pitch in rad
        self._unsent: list[tuple[int, float]] = []  # samples: instant in ns, pitch in rad
        self.farthest = self.late = 0.0
        self.ticks = 0

    def _new_drive(self) -> Cia402Device:
        turn = round(2 * math.pi / self._count)
        return Cia402Device(counts=self._index, index=self._index, turn=turn)

    @property
    def now(self) -> float:
        """Time of the body in s."""
        return self.ticks * STEP

    @property
    def epoch_ns(self) -> int:
        """Instant of time zero, on the clock of the day."""
        return time.time_ns() - round(1e9 * (time.monotonic() - self.begun))

    @property
    def lean(self) -> float:
        """Lean of the stance leg in rad; 0 of one that is held."""
        if self._plant.setup.fixture != 'none':
            return 0.0
        return float(self._plant.state[STANCES.index(self._plant.stance)])

    def move(self) -> None:
        """Move the body on by STEP, to where it is next; what is sampled there is due then."""
        enabled = self.drive.state == 'operation enabled'
        if enabled and not self._enabled:
            self._held = False
        self._enabled = enabled
        if not self._held:
            self._goal = {}
            self._plant.latch(np.array([self.drive.acting * self.drive.rated * 1e-6]))
            try:
                self._plant.advance()
            except SimulationError:
                self._held = True  # it lies on the floor
            self.farthest = max(self.farthest, abs(self.lean))
        elif self._goal:
            self._lead()
        self.ticks += 1
        measured = self._plant.measure()
        outputs = measured.outputs
        self._lean(outputs)
        self._hip_rate = (outputs['hip_angle'] - self._hip) / STEP
        self._hip = outputs['hip_angle']
        self.drive.inputs = sum(
            FOOT_BITS[leg]
            for leg, force in (measured.contact | self._pressed).items()
            if force > 0.0
        )
        if self.ticks % max(1, round(self.imu.period / STEP)) == 0:
            rates = (0.0, outputs['imu_rate'], 0.0)
            roll, yaw = GIMBAL
            sample = self.imu.sample(self.now, roll, outputs['imu_angle'], yaw, rates)
            if sample:
                on_line = self._on_a_bad_line(sample)
                self._samples.append((self.now, on_line, outputs['imu_angle']))

    @property
    def _angles(self) -> dict[str, float]:
        """Of the legs that are free, rad by name."""
        names, state = self._plant.state_names, self._plant.state
        return {n: float(x) for n, x in zip(names, state, strict=True) if n in LEGS}

    def _lead(self) -> None:
        """A person moves the legs a step towards where they are to be."""
        there, step = self._angles, BY_HAND * STEP
        moved = {
            name: min(max(goal, there[name] - step), there[name] + step)
            for name, goal in self._goal.items()
        }
        self._plant.place(moved)
        if moved == self._goal:
            self._goal = {}

    def _on_a_bad_line(self, sample: bytes) -> bytes:
        """What becomes of a sample of the IMU on its way."""
        kind, left = self._bad_samples
        if not sample or left <= 0:
            return sample
        self._bad_samples = kind, left - 1
        if kind == 'imu_noise':
            return self._random.randbytes(len(sample))
        if kind == 'imu_short':
            return sample[: self._random.randrange(len(sample))]
        if kind == 'imu_nan':
            return closed(sample[:5] + struct.pack('>f', math.nan) + sample[9:-2])
        at = self._random.randrange(1, len(sample))
        wrong = sample[at] ^ 1 << self._random.randrange(8)
        return sample[:at] + bytes([wrong]) + sample[at + 1 :]

    def _lean(self, outputs: dict[str, float]) -> None:
        """What sensors tell of inner legs that a person leans, while the outer stay."""
        step = min(max(self._lean_to - self._leant, -LEANING * STEP), LEANING * STEP)
        self._leant += step
        outputs['imu_angle'] += self._leant
        outputs['imu_rate'] += step / STEP
        outputs['hip_angle'] += self._leant

    def serve(self, now: float) -> None:
        """Answer what came in on the wires, and send what is due.

        Args:
            now: Time in s since the start.
        """
        # The encoder is read at the SYNC, between two steps of the body; the next one is known.
        hip = self._hip + self._hip_rate * min(max(now - self.now, -STEP), STEP)
        self.drive.counts = SHELL + round(hip / self._count)
        self._serve_can(now)
        self._serve_imu(now)

    def _serve_can(self, now: float) -> None:
        frames = self._can.receive() if self.can_line is not None else []
        if 'heartbeat' in self._silent:
            frames = [frame for frame in frames if frame[0] != HEARTBEAT]
        answers = []
        for cob, data in frames:
            answers += self.drive.receive(cob, data, now)
            if self.trace is not None:
                self._trace_frame(cob, data)
        if self._can.opened and not self._greeted:
            self._greeted = True
            answers += self.drive.power_on()
        answers += self.drive.step(now)
        if 'can' in self._silent or self.can_line is None:
            return
        kind, left = self._bad_frames
        bad, self._bad_frames = answers[:left], (kind, max(0, left - len(answers)))
        if bad and kind == 'can_noise':
            self.can_line.write(self._random.randbytes(len(bad) * FRAME_BYTES))
        for frame in answers[len(bad) :]:
            late = self._random.uniform(0.0, self._jitter_s) if self._jitter_s else 0.0
            self._late_frames.append((now + late, frame))
        due = [frame for at, frame in self._late_frames if at <= now]
        self._late_frames = [(at, frame) for at, frame in self._late_frames if at > now]
        self._can.send(due)

    def _trace_frame(self, cob: int, data: bytes | None) -> None:
        assert self.trace is not None
        if cob == 0x200 + self.drive.node and data:
            target = struct.unpack('<h', data[2:4])[0]
            self.trace.write(f'command {time.time_ns()} {target}\n')
        elif cob == 0x080:
            self.trace.write(f'sync {time.time_ns()} {self.drive.acting}\n')

    def _serve_imu(self, now: float) -> None:
        due = [sample for sample in self._samples if sample[0] <= now]
        del self._samples[: len(due)]
        if self.imu_line is None:
            return
        self._waiting += b''.join(sent for _, sent, _ in due)
        if self.trace is not None:
            epoch_ns = self.epoch_ns
            self._unsent += [(epoch_ns + round(1e9 * at), pitch) for at, _, pitch in due]
        self._waiting += self.imu.receive(self.imu_line.read(), now)
        if 'imu' in self._silent:
            self._waiting = b''
        elif self._waiting and now - self._flushed >= self._usb_s:
            self._flushed = now
            self.imu_line.write(self._waiting)
            self._waiting = b''
            if self.trace is not None:
                for instant, pitch in self._unsent:
                    self.trace.write(f'sample {instant} {time.time_ns()} {pitch!r}\n')
            self._unsent = []

    def ask(self, line: str, now: float) -> str:
        """Carry out a line of standard input; what to print, if anything.

        Args:
            line: What is asked for.
            now: Time in s since the start, as of `serve`: that of a body that is late lies behind.
        """
        word, *rest = line.split()
        number = float(int(rest[0], 0) if rest[0].startswith('0x') else rest[0]) if rest else 0.0
        if word == 'report':
            return self._report(now)
        device, _, what = word.partition('_')
        if what in ('silent', 'back'):
            (self._silent.add if what == 'silent' else self._silent.discard)(device)
        elif word == 'imu_frozen':
            self.imu.frozen = not self.imu.frozen
        elif word == 'imu_garbage':
            self._waiting += self._random.randbytes(int(number))
        elif word == 'imu_cut':
            self._waiting = self._waiting[int(number) :]
        elif word in ('imu_noise', 'imu_short', 'imu_flip', 'imu_nan'):
            self._bad_samples = word, int(number)
        elif word == 'imu_jump':
            self.imu.timer += round(number * TIMER_HZ)
        elif word == 'imu_unplug' and self.imu_line is not None:
            self.imu_line.close()
            self.imu_line = None
        elif word == 'imu_plug':
            self.imu_line = Pty(self._folder / 'imu')
            self.imu = Gx3Device(drift=DRIFT, timer=self._random.randrange(1 << 32))
        elif word == 'can_unplug' and self.can_line is not None:
            self.can_line.close()
            self.can_line = None
        elif word == 'can_plug':
            self.can_line = Pty(self._folder / 'can')
            self._can = SerialCan(self.can_line)
        elif word == 'can_garbage' and self.can_line is not None:
            self.can_line.write(self._random.randbytes(int(number)))
        elif word in ('can_lose', 'can_noise'):
            self._bad_frames = word, int(number)
        elif word == 'can_foreign' and self.can_line is not None:
            self._can.send(
                [
                    (
                        self._random.choice(FOREIGN),
                        self._random.randbytes(self._random.randrange(9)),
                    )
                    for _ in range(int(number))
                ]
            )
        elif word == 'drive_fault':
            emergency = self.drive.fault(int(number), now)
            if self.can_line is not None:
                self._can.send(emergency)
        elif word == 'drive_off':
            self.drive.dead = True
            self.drive.log.append((now, 0))
            self.drive.acting = 0
        elif word == 'drive_on':
            log, self.drive = self.drive.log, self._new_drive()
            self.drive.log = log
            self._greeted = False
        elif word == 'drive_volts':
            self.drive.voltage = round(1000 * number)
        elif word == 'drive_degc':
            self.drive.temperature = round(10 * number)
        elif word == 'drive_lacks':
            self.drive.missing = frozenset((int(number), sub) for sub in range(9))
        elif word == 'turn':
            outer = self._goal.get('q_outer', self._angles['q_outer'])
            self._goal = {**self._goal, 'q_outer': outer - number}
        elif word == 'usb_ms':
            self._usb_s = number / 1000
        elif word == 'can_jitter_ms':
            self._jitter_s = number / 1000
        elif word == 'push':
            self._plant.push(number)
        elif word == 'lean':
            self._lean_to = number
        elif device == 'foot':
            self._pressed[what] = number
        elif word == 'stand':
            self._held, self._goal = True, self._start
            self._plant.place({
                name: min(max(angle, self._goal[name] - FLOOR), self._goal[name] + FLOOR)
                if math.isfinite(angle) else self._goal[name]
                for name, angle in self._angles.items()
            })  # fmt: skip
        elif word in ('hold', 'let_go'):
            self._held = word == 'hold'
        else:
            return json.dumps({'error': f'{line.strip()!r} is nothing that can be asked for'})
        return ''

    def _report(self, now: float) -> str:
        changes = self.drive.log.copy()
        self.drive.log.clear()
        late, self.late = self.late, 0.0
        return json.dumps({
            'time': now, 'epoch_ns': self.epoch_ns,
            'state': self.drive.state, 'acting': self.drive.acting,
            'changes': changes, 'outputs': self.drive.outputs, 'lean': self.lean,
            'farthest': self.farthest, 'hip': self._hip, 'held': self._held, 'late': late,
        })  # fmt: skip


def open_hands(folder: Path) -> int:
    """The pipe by which others than the parent ask for something."""
    path = folder / HANDS
    path.unlink(missing_ok=True)
    os.mkfifo(path)
    return os.open(path, os.O_RDWR | os.O_NONBLOCK)  # it never comes to its end


def main() -> int:
    """Entry point of `python -m cg_hardware.emulators.robot`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('folder', type=Path)
    parser.add_argument('--model', default='compass_gait_flexible')
    parser.add_argument('--setup', default='stance: inner', help='YAML text or a file')
    parser.add_argument(
        '--state', type=float, nargs='+', default=[0.05, 0.05, 0.0, 0.0],
        help='free coordinates and their rates at the start, rad and rad/s',
    )  # fmt: skip
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--trace', type=Path, help='file for what went and came')
    options = parser.parse_args()
    try:
        model = Model.load(model_path(options.model))
        setup = read_setup(options.setup)
        robot = EmulatedRobot(options.folder, model, setup, options.state, options.seed)
        robot.trace = options.trace.open('w', buffering=1 << 16) if options.trace else None
    except (ValueError, OSError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    with contextlib.suppress(PermissionError):
        os.setsid()  # unless it leads a group already; it ends with its standard input
    take_priority(PRIORITY)  # devices have a processor of their own
    gc.freeze()
    os.set_blocking(sys.stdin.fileno(), False)
    hands = open_hands(options.folder)
    print('ready', flush=True)
    robot.begun, words = time.monotonic(), {sys.stdin.fileno(): '', hands: ''}
    while True:
        now = time.monotonic() - robot.begun
        if now - robot.now > BEHIND:
            robot.begun += now - robot.now  # a host that slept: time goes on from here
        if now >= robot.now:
            robot.late = max(robot.late, now - robot.now)
            robot.move()
        wires = [wire for wire in (robot.can_line, robot.imu_line) if wire is not None]
        # Late or not: what hands do must not wait for a host that has time.
        heard, _, _ = select.select([*wires, *words], [], [], max(0.0, robot.now - now))
        robot.serve(time.monotonic() - robot.begun)
        for source in set(words) & set(heard):
            said = os.read(source, 65536)
            if not said:
                if robot.trace is not None:
                    robot.trace.close()
                return 0
            *lines, words[source] = (words[source] + said.decode()).split('\n')
            for line in filter(str.strip, lines):
                if answer := robot.ask(line, time.monotonic() - robot.begun):
                    print(answer, flush=True)


if __name__ == '__main__':
    raise SystemExit(main())
