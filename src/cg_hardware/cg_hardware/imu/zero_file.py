"""The file that keeps the zero of the IMU from one start to the next."""

import math
import os
from datetime import datetime, timezone

import yaml

from cg_description.model_file import write_atomically
from cg_description.reading import parse_yaml, path_of, read_text
from cg_description.schema import Key, Mapping, Number, Text
from cg_hardware.imu.mounting import Mounting, Zero

FORMAT = 'cg_zero/1'
SCHEMA = Mapping({
    'format': Key(Text((FORMAT,))),
    'zero_rad': Key(Number(-math.pi, math.pi), 'lean that is upright', unit='rad'),
}, further=True)  # fmt: skip


def read_zero(path: str) -> float:
    """The zero in rad that a file keeps; 0 where there is no such file.

    Raises:
        ValueError: naming the file and what is wrong in it.
    """
    file = path_of(path)
    if not file.exists():
        return 0.0
    return SCHEMA.of(parse_yaml(read_text(file), str(file)), str(file))['zero_rad']


def write_zero(path: str, mounting: Mounting, zero: Zero) -> None:
    """Keep a zero, with when it was taken, by whom, and how still the legs were."""
    record = {
        'format': FORMAT, 'zero_rad': zero.angle, 'axis': mounting.axis, 'sign': mounting.sign,
        'still_rad': zero.still, 'samples': zero.samples,
        'taken_at': datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ'),
        'taken_by': os.environ.get('USER', 'unknown'),
    }  # fmt: skip
    write_atomically(path_of(path), yaml.safe_dump(record, sort_keys=False))
