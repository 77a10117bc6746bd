"""The metadata.yaml of a bag: whether rosbags, which takes it as it is, may be given it.

Names of files must be those of the bag's own folder, so that nothing is read that was not looked
through (bag_integrity.py). The form is that of every version of rosbag2.
"""

import re
from pathlib import Path, PurePath

from cg_description.reading import Limits, parse_yaml, path_below, read_text, shown
from cg_description.schema import Flag, Key, ListOf, Mapping, Number, Text, Whole
from cg_sysid.errors import RecordingError

LIMITS = Limits(size=1024 * 1024, depth=40, nodes=25_000)
STORAGE = {'mcap': '.mcap', 'sqlite3': '.db3'}  # storage plugin -> ending of its files
MODES = ('', 'none', 'file', 'message', 'NONE', 'FILE', 'MESSAGE')
ROS_NAME = Text(longest=255)
POLICIES = ('history', 'reliability', 'durability', 'liveliness')
TOPIC = Mapping({
    name: Key(ROS_NAME) for name in ('name', 'type', 'serialization_format')
}, further=True)  # fmt: skip
QOS = ListOf(Mapping({
    **{name: Key(Text(), default='unknown') for name in POLICIES},
    **{name: Key(Mapping({'sec': Key(Number()), 'nsec': Key(Number())}, further=True))
       for name in ('deadline', 'lifespan', 'liveliness_lease_duration')},
    'depth': Key(Whole(0)),
    'avoid_ros_namespace_conventions': Key(Flag()),
}, fill=False, further=True))  # fmt: skip
# What rosbags takes without a look, for every version of the format.
SCHEMA = Mapping({
    'rosbag2_bagfile_information': Key(Mapping({
        'version': Key(Whole(1)),
        'storage_identifier': Key(Text()),
        'relative_file_paths': Key(ListOf(Text())),
        'compression_format': Key(Text(), default=''),
        'compression_mode': Key(Text(MODES), default=''),
        'duration': Key(Mapping({'nanoseconds': Key(Number(0.0))}, further=True)),
        'starting_time': Key(Mapping({'nanoseconds_since_epoch': Key(Number())}, further=True)),
        'message_count': Key(Whole(0)),
        'topics_with_message_count': Key(ListOf(Mapping({
            'topic_metadata': Key(TOPIC), 'message_count': Key(Whole(0)),
        }, further=True))),
        'files': Key(ListOf(Mapping({'path': Key(Text())}, further=True)), default=()),
    }, further=True)),
}, further=True)  # fmt: skip


def compression_mode(file: Path) -> str:
    """How the bag is packed: '', 'none', 'file' or 'message'.

    Raises:
        RecordingError: Nobody should read this file; the message says what is wrong where.
    """
    tree = parse_yaml(read_text(file, RecordingError, LIMITS), str(file), RecordingError,
                      LIMITS)  # fmt: skip
    where = f'{file}: not a readable rosbag2 recording'
    checked = SCHEMA.of(tree, where, RecordingError)['rosbag2_bagfile_information']
    written = tree['rosbag2_bagfile_information']
    for key in ('compression_mode', 'files'):
        if written.get(key, '') is None:
            raise RecordingError(f'{where}: {key}: nothing stands there')
    _require_own_files(file, checked)
    for topic in written['topics_with_message_count']:
        _require_topic(topic['topic_metadata'], where)
    return checked['compression_mode'].lower()


def _require_topic(topic: dict, where: str) -> None:
    """Names that can be shown, and policies that are policies for the YAML of rosbags too."""
    for key in ('name', 'type'):
        if not isinstance(topic[key], str) or not topic[key].isprintable():
            raise RecordingError(f'{where}: {shown(topic[key])} is no {key} of a topic')
    place = f'{where}: {topic["name"]}: offered_qos_profiles'
    offered = topic.get('offered_qos_profiles')
    if isinstance(offered, str) and offered:  # a text of YAML in older bags
        offered = parse_yaml(offered, place, RecordingError)
    elif not offered:
        return
    QOS.of(offered, place, RecordingError)
    for profile in offered:
        for policy in POLICIES:
            given = profile.get(policy, 'unknown')
            if given is None or not re.fullmatch('[A-Za-z_]+|[0-9]', str(given)):
                raise RecordingError(f'{place}: {policy}: {shown(given)} is none')


def _require_own_files(metadata: Path, information: dict) -> None:
    """Every file that is named must be one that was looked through."""
    suffix = STORAGE.get(information['storage_identifier'])
    # Before version 4 the folder's own name came first.
    deepest = 1 if information['version'] >= 4 else 2
    named = {
        'relative_file_paths': information['relative_file_paths'],
        'files': [entry['path'] for entry in information['files']],
    }
    for key, names in named.items():
        for name in names:
            place = f'{metadata}: {key}'
            path_below(metadata.parent, name, place, RecordingError)
            own = len(PurePath(name).parts) <= deepest
            if not own or (suffix and not name.removesuffix('.zstd').endswith(suffix)):
                raise RecordingError(
                    f'{place}: {shown(name)} is no storage file of this bag; the name of one '
                    f'in its folder is needed, such as {metadata.parent.name}_0{suffix or ""}'
                )
