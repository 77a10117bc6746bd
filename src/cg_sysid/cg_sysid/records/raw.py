"""Raw recordings: every sample as it stands in the file, nothing repaired."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cg_description.schema import (
    NAME,
    Anything,
    Flag,
    Key,
    ListOf,
    MapOf,
    Mapping,
    Number,
    Text,
    Whole,
)
from cg_dynamics.rig import Setup
from cg_interfaces.channels import Mechanism, mechanism
from cg_sysid.errors import RecordingError

NOTE_FORMAT = 'cg_recording/1'
# What a note says of the checklist of the robot: cg_hardware.checklist.record.reference.
CHECKLIST = Mapping({
    'file': Key(Text(), default=''),
    'sha256': Key(Text(), default=''),
    'date': Key(Text(), default=''),
    'passed': Key(Whole(0), default=0),
    'of': Key(Whole(0), default=0),
    'failed': Key(ListOf(Text()), default=()),
    'not_checked': Key(ListOf(Text()), default=()),
}, fill=False)  # fmt: skip
# interfaces.md, "The recording note". The set-up has a reader of its own.
NOTE = Mapping({
    'format': Key(Text((NOTE_FORMAT,)), default=NOTE_FORMAT),
    'experiment': Key(Text(), default=''),
    'mechanism': Key(NAME, default=''),
    'setup': Key(Mapping({}, further=True), default={}),
    'nominal_rate_hz': Key(Number(0.0), default=0.0, unit='Hz'),
    'sensor_zeros': Key(MapOf(Number()), default={}),
    'zeroed_at': Key(Text(), default=''),
    'initial_state': Key(Text(('rest', 'moving', 'unknown')), default='unknown'),
    'model_file': Key(Text(), default=''),
    'model_sha256': Key(Text(), default=''),
    'software': Key(Text(), default=''),
    'recording': Key(Text(), default=''),
    'effort': Key(Text(('measured', 'commanded')), default='measured'),
    'effort_gain': Key(MapOf(Number()), default={}),
    'position_control': Key(Text(), default=''),
    'closed_loop': Key(Flag(), default=False),
    'notes': Key(Text(), default=''),
    'checklist': Key(CHECKLIST, default={}),
    'imported_from': Key(Mapping({}, further=True), default={}),
    'derived_channels': Key(MapOf(Anything()), default={}),
}, fill=False)  # fmt: skip


@dataclass(frozen=True)
class RawTopic:
    """The samples of one topic in the order in which they were recorded, nothing repaired.

    Attributes:
        name: Topic name.
        msgtype: Message type.
        stamp_ns: Header stamps in ns, shape (M,), int64.
        log_ns: Times at which the recorder received them in ns, shape (M,), int64.
        values: Channel -> values, shape (M,), NaN where the message holds NaN.
        absent: Channel -> whether the message declares the value absent, shape (M,).
    """

    name: str
    msgtype: str
    stamp_ns: np.ndarray
    log_ns: np.ndarray
    values: dict[str, np.ndarray]
    absent: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.stamp_ns)


@dataclass(frozen=True)
class RawRecording:
    """A recording as it stands in the file.

    Attributes:
        path: Where it was read from.
        note: The recording note, as read.
        mechanism: Topics of the robot; its name will do where it has a row in channels.py.
        topics: Topic name -> samples, of the topics that the mechanism knows.
        others: Names of the topics that the analysis does not use, with their message types.
    """

    path: str
    note: dict[str, Any]
    mechanism: Mechanism
    topics: dict[str, RawTopic]
    others: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if isinstance(self.mechanism, str):
            object.__setattr__(self, 'mechanism', mechanism(self.mechanism))

    @property
    def name(self) -> str:
        """Short name of the recording."""
        return Path(self.path).name

    @property
    def told(self) -> str:
        """Topic on which drives were told positions; empty if they were told torques."""
        return self.note.get('position_control') or ''

    @property
    def torque_topic(self) -> str | None:
        """The topic that the torque is read from; None if there is none."""
        if self.told:
            return self.told
        for topic in (self.mechanism.torque, self.mechanism.command):
            if topic.name in self.topics:
                return topic.name
        names = {*self.mechanism.input_names}
        return next((name for name, t in self.topics.items() if names & t.values.keys()), None)

    @property
    def setup(self) -> Setup:
        """What was done to the rig.

        Raises:
            RecordingError: The note's set-up is malformed.
        """
        try:
            return Setup.from_dict(self.note.get('setup') or {})
        except ValueError as error:
            raise RecordingError(f'{self.path}: note: {error}') from None
