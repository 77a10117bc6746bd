"""Where the hip's zero is on the counts of the drive, and the file that keeps how it was found.

An incremental encoder begins anew when its drive wakes up. The record then only says what was
done; the zero itself is known again once somebody takes it. An absolute encoder keeps its counts,
and the zero of the file holds.
"""

import os
from dataclasses import asdict, dataclass
from datetime import datetime, timezone

import yaml

from cg_description.model_file import write_atomically
from cg_description.reading import DocumentError, parse_yaml, path_of, read_text

FORMAT = 'cg_encoder_zero/1'
PARALLEL = 'legs parallel'  # how a zero is taken without an index
LARGEST = 2**31
# What a file says besides, for people.
KEPT = {'how': str, 'method': int, 'offset_rad': float, 'taken_at': str, 'taken_by': str}


@dataclass(frozen=True)
class EncoderZero:
    """A zero.

    Attributes:
        zero_counts: Of the drive where the hip's angle is zero.
        how: `legs parallel`, `homing` or `index by hand`.
        method: Of the homing, 0 where there was none.
        offset_rad: Of the zero from the index; 0 where there was none.
        taken_at: UTC, ISO 8601.
        taken_by: User.
    """

    zero_counts: int
    how: str = ''
    method: int = 0
    offset_rad: float = 0.0
    taken_at: str = ''
    taken_by: str = ''

    @classmethod
    def now(cls, zero_counts: int, how: str, method: int = 0, offset_rad: float = 0.0):
        """One that is taken now, by whoever runs this."""
        at = datetime.now(timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')
        return cls(zero_counts, how, method, offset_rad, at, os.environ.get('USER', 'unknown'))

    def save(self, path: str) -> None:
        """Keep it.

        Raises:
            OSError: The file cannot be written.
        """
        record = {'format': FORMAT} | asdict(self)
        write_atomically(path_of(path), yaml.safe_dump(record, sort_keys=False))

    def __str__(self) -> str:
        method = f' by method {self.method}' if self.method else ''
        offset = '' if self.how == PARALLEL else f', {self.offset_rad:g} rad from the index'
        return f'zero at {self.zero_counts} counts ({self.how}{method}{offset}, {self.taken_at})'


def read_zero(path: str) -> EncoderZero | None:
    """The zero that a file keeps; None where there is no such file.

    Raises:
        DocumentError: naming the file and what is wrong in it.
    """
    file = path_of(path)
    if not file.exists():
        return None
    found = parse_yaml(read_text(file), str(file))
    found = found if isinstance(found, dict) else {}
    if found.get('format') != FORMAT:
        raise DocumentError(f'{file}: format must be {FORMAT}')
    counts = found.get('zero_counts')
    if type(counts) is not int or not abs(counts) < LARGEST:
        raise DocumentError(f'{file}: zero_counts must be a whole number below 2^31')
    told = {k: found[k] for k, kind in KEPT.items() if isinstance(found.get(k), kind)}
    return EncoderZero(counts, **told)
