"""The file that keeps the zero of the IMU from one start to the next."""

import math
import os

import yaml

from cg_description.model_file import write_atomically
from cg_description.reading import parse_yaml, path_of, read_text
from cg_description.schema import Key, Mapping, Number, Text
from cg_hardware.imu.mounting import Mounting, Zero

FORMAT = 'cg_zero/1'
SCHEMA = Mapping({
    'format': Key(Text((FORMAT,))),
    'zero_rad': Key(Number(-math.pi, math.pi), 'lean that is upright', unit='rad'),
    'taken_at': Key(Text(), 'ISO 8601', default=''),
}, further=True)  # fmt: skip


def read_zero(path: str) -> tuple[float, str]:
    """The zero in rad that a file keeps, and when it was taken; 0 and '' where there is none.

    Raises:
        ValueError: naming the file and what is wrong in it.
    """
    file = path_of(path) if path else None
    if file is None or not file.exists():
        return 0.0, ''
    found = SCHEMA.of(parse_yaml(read_text(file), str(file)), str(file))
    return found['zero_rad'], found['taken_at']


def write_zero(path: str, mounting: Mounting, zero: Zero, taken_at: str) -> None:
    """Keep a zero, with when it was taken, by whom, and how still the legs were."""
    record = {
        'format': FORMAT, 'zero_rad': zero.angle, 'axis': mounting.axis, 'sign': mounting.sign,
        'still_rad': zero.still, 'samples': zero.samples,
        'taken_at': taken_at,
        'taken_by': os.environ.get('USER', 'unknown'),
    }  # fmt: skip
    write_atomically(path_of(path), yaml.safe_dump(record, sort_keys=False))
