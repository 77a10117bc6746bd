"""Bytes and frames that no device sends: the parser of the IMU's line, and the drive's messages.

    ./cg exec python bench/fuzz_wires.py [--inputs 1000000] [--seed 1] [--write FILE]

Inputs are seeded: random bytes, true replies with bits flipped, cut, doubled and shuffled; frames
of every length, with random and with nearly true contents. What counts is that nothing is raised,
that a parser holds no more than one reply, that only possible numbers come out, and the longest
time for one input.
"""

import argparse
import math
import random
import struct
import threading
import time
from collections import deque
from pathlib import Path

from cg_hardware.drive import cia402
from cg_hardware.drive.can_drive import ANSWER, CanDrive, Scale
from cg_hardware.emulators.gx3_device import Gx3Device
from cg_hardware.imu import gx3


def serial_inputs(rng: random.Random, count: int):
    """Chunks of a serial line."""
    device = Gx3Device()
    device.receive(gx3.continuous_command(), 0.0)
    for k in range(count):
        true = device.sample(k * 0.002, rng.uniform(-3, 3), 0.1, 0.2, (0.0, 1.0, 0.0))
        kind = rng.randrange(5)
        if kind == 0:
            yield rng.randbytes(rng.randrange(64))
        elif kind == 1:
            damaged = bytearray(true)
            damaged[rng.randrange(len(damaged))] ^= 1 << rng.randrange(8)
            yield bytes(damaged)
        elif kind == 2:
            yield true[rng.randrange(len(true)) :] + true[: rng.randrange(len(true))]
        elif kind == 3:
            # A right sum behind wrong numbers.
            yield gx3.closed(b'\xcf' + rng.randbytes(28))
        else:
            yield true + true


def fuzz_serial(count: int, seed: int) -> tuple[int, float]:
    """Readings that came out, longest time for one input in s."""
    parser, readings, longest = gx3.Parser(), 0, 0.0
    for data in serial_inputs(random.Random(seed), count):
        began = time.perf_counter()
        found = parser.feed(data, 0)
        longest = max(longest, time.perf_counter() - began)
        readings += len(found)
        assert len(parser._buffer) < max(gx3.LENGTHS.values())
        for reading in found:
            assert all(abs(x) <= gx3.TURN for x in reading.euler)
            assert all(abs(x) <= gx3.FASTEST for x in reading.rates)
    return readings, longest


def bare_drive() -> CanDrive:
    """A drive without a bus: what comes in from one, and nothing else."""
    drive = object.__new__(CanDrive)
    drive.node, drive._wall_ns, drive.scale = 1, time.time_ns, Scale(40.0)
    drive.answers, drive._asked = deque(maxlen=1000), deque(maxlen=8)
    drive._lock, drive._heard = threading.Lock(), threading.Event()
    drive._inputs, drive._emergency, drive._last, drive._answered = 0, '', None, 0.0
    return drive


def fuzz_frames(count: int, seed: int) -> tuple[int, float]:
    """Answers that were believed, longest time for one frame in s."""
    rng, drive, believed, longest = random.Random(seed), bare_drive(), 0, 0.0
    for _ in range(count):
        data = rng.randbytes(rng.randrange(9))
        if rng.random() < 0.3:
            data = ANSWER.pack(rng.randrange(1 << 16), rng.randrange(-(1 << 31), 1 << 31),
                               rng.randrange(-(1 << 15), 1 << 15))  # fmt: skip
        drive._asked.append(time.time_ns())
        drive.answers.clear()
        began = time.perf_counter()
        drive._on_answer(0x181, bytearray(data), 0.0)
        drive._on_inputs(0x281, bytearray(data), 0.0)
        longest = max(longest, time.perf_counter() - began)
        for answer in drive.answers:
            believed += 1
            assert isinstance(answer.state, cia402.State)
            assert math.isfinite(answer.torque)
            assert abs(answer.counts) <= 1 << 31
            (word,) = struct.unpack('<H', data[:2])
            assert answer.state == cia402.state_of(word)
    return believed, longest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--inputs', type=int, default=1_000_000)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    lines = ['| what | inputs | that were believed | longest, ms |', '|---|---:|---:|---:|']
    for name, fuzz in (('bytes of the IMU', fuzz_serial), ('frames of the drive', fuzz_frames)):
        believed, longest = fuzz(options.inputs, options.seed)
        lines.append(f'| {name} | {options.inputs} | {believed} | {1e3 * longest:.2f} |')
        print(lines[-1], flush=True)
    if options.write:
        options.write.write_text('\n'.join([
            '# Bytes and frames that no device sends', '',
            f'Command: `./cg exec python bench/fuzz_wires.py --seed {options.seed}`. Nothing was '
            'raised, nothing impossible came out. The longest time holds what the host did '
            'meanwhile.', '', *lines, '',
        ]))  # fmt: skip


if __name__ == '__main__':
    main()
