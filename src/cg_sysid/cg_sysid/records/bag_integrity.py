"""Whether a bag may be given to a reader that trusts it: complete, undamaged, of bounded size.

`rosbags` reads what lengths and indices say and unpacks whatever it is given. So each file is
looked through first, within the limits of interfaces.md.
"""

import sqlite3
from pathlib import Path

import zstandard

from cg_description.reading import parse_yaml
from cg_sysid.errors import RecordingError
from cg_sysid.records.bag_metadata import compression_mode
from cg_sysid.records.mcap_records import LARGEST_CHUNK, MAGIC, is_bounded_zstd
from cg_sysid.records.mcap_scan import LARGEST_RATIO, Survey, messages, survey
from cg_sysid.records.recover import METADATA, needs_recovery

LOGS = ('.csv', '.mat', '.json')  # what an import is needed for
STEP = 1024 * 1024


def require_sound(path: Path) -> None:
    """Let a bag pass.

    Args:
        path: Bag directory or file, which exists.

    Raises:
        RecordingError: It is cut off, damaged or beyond a limit; the message tells where.
    """
    try:
        _require_sound(path)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None


def _require_sound(path: Path) -> None:
    if needs_recovery(path):
        raise unfinished(path)
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    packed_messages = False
    if path.is_dir():
        packed_messages = compression_mode(path / METADATA) == 'message'
    for file in files:
        if file.suffix == '.mcap':
            found = survey(file)
            if not found.sound:
                raise damaged(path, found)
            for channel in found.channels.values():
                for key, value in channel.metadata:
                    if key == 'offered_qos_profiles':
                        parse_yaml(value, f'{file}: {channel.topic}: {key}', RecordingError)
            if packed_messages:
                _require_bounded(file, (message.data for message in messages(found)))
        elif file.suffix == '.db3' and packed_messages:
            _require_bounded(file, _rows(file))
        elif file.suffix == '.zstd':
            _require_bounded_file(file)


def _rows(file: Path):
    try:
        with sqlite3.connect(f'{file.resolve().as_uri()}?mode=ro', uri=True) as database:
            for (data,) in database.execute('SELECT data FROM messages'):
                yield bytes(data)
    except (sqlite3.Error, TypeError) as error:
        raise RecordingError(f'{file}: not a readable rosbag2 recording ({error})') from None


def _require_bounded(file: Path, packed) -> None:
    for number, data in enumerate(packed):
        if not is_bounded_zstd(data):
            raise RecordingError(
                f'{file}: message {number} does not say to what it unpacks, or to more than '
                f'{LARGEST_CHUNK} bytes, which is the most allowed'
            )


def _require_bounded_file(file: Path) -> None:
    allowed = LARGEST_RATIO * file.stat().st_size + LARGEST_CHUNK
    total = 0
    try:
        with file.open('rb') as stream:
            unpacker = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK)
            reader = unpacker.stream_reader(stream, read_across_frames=True)
            while part := reader.read(STEP):
                total += len(part)
                if total > allowed:
                    raise RecordingError(f'{file}: unpacks to more than {allowed} bytes, '
                                         'which is the most allowed')  # fmt: skip
    except zstandard.ZstdError as error:
        raise RecordingError(f'{file}: does not unpack ({error})') from None


def damaged(path: Path, found: Survey) -> RecordingError:
    """The error of a file that is damaged inside, with the way out."""
    if found.gaps:
        gap = found.gaps[0]
        more = f', and {len(found.gaps) - 1} more places' if len(found.gaps) > 1 else ''
        what = f'damaged at bytes {gap.start} to {gap.stop} ({gap.reason}){more}'
    else:
        what = 'cut off'
    count = sum(found.counts.values())
    if count == 0:
        return RecordingError(
            f'{path}: {found.path.name} is {what}, and holds no message that can be read'
        )
    return RecordingError(
        f'{path}: {found.path.name} is {what}; make a bag of what is intact '
        f'({count} messages) with: python3 -m cg_sysid recover {path}'
    )


def no_bag(path: Path) -> RecordingError:
    """The error of what is no bag; of a log, with the way to make bags of it."""
    logs = [path] if path.is_file() else sorted(path.glob('*.*'))
    if any(log.suffix.lower() in LOGS for log in logs):
        kind = 'a log' if path.is_file() else 'a folder of logs'
        folder = path.parent if path.is_file() else path
        return RecordingError(
            f'{path}: {kind}, no bag; a mapping file says which column is which channel, then '
            f'`cg import MAPPING.yaml {folder} --out bags` makes bags of it '
            '(data.md, "Import of foreign logs")'
        )
    return RecordingError(
        f'{path}: not a bag; a directory with metadata.yaml and .mcap or .db3 files is needed'
    )


def unfinished(path: Path) -> RecordingError:
    """The error of a recording whose end was never written, with the way out."""
    if needs_recovery(path) and _begins_as_mcap(path):
        way_out = f'python3 -m cg_sysid recover {path}'
    elif path.is_dir() and any(path.glob('*.db3*')):
        way_out = f'ros2 bag reindex {path}'
    else:
        return no_bag(path)
    return RecordingError(
        f'{path}: the recording was cut off (its index or metadata.yaml is missing); '
        f'rebuild it with: {way_out}'
    )


def _begins_as_mcap(path: Path) -> bool:
    """Whether there is something to recover at all."""
    files = path.glob('*.mcap') if path.is_dir() else [path]
    for file in files:
        with file.open('rb') as stream:
            if stream.read(len(MAGIC)) == MAGIC:
                return True
    return False
