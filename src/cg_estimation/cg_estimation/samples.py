"""Messages of one instant come on several topics; here they become one measurement. No ROS.

A measurement is whole when its IMU, encoder and (if they are to tell the stance leg) foot contacts
are there, and the torque that the drive held since the one before is known. Whole ones are given
out at once and in order. One that stays in parts is given out as it is once PATIENCE newer IMU
samples have come: in lock-step, where nothing moves on without an answer, that never happens.

A machine that died may have owed the torque of its last sample. The next one, which repeats its
first measurement until somebody answers, is waited with no longer than PATIENCE repetitions.

Devices on wires of their own have stamps of their own, and no two of them meet. After ALONE IMU
samples without an encoder's of the same stamp each IMU sample is a measurement, at once: the last
reading of the encoder goes with it, and how old it is (`late`), so that whoever knows the rate can
bring it forward. Contacts and torque are the last ones.

The stance leg is the one that has just been loaded, or else the only one that is: when the swing
foot lands, both feet may be down for some samples, and the impact is at the first of them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

from cg_dynamics.rig import STANCES

PATIENCE = 2
ALONE = 20  # IMU samples in a row
LONGEST_NS = 10_000_000  # ns by which a reading of the encoder may be older than that of the IMU
KEPT = 64  # measurements in parts; more than that are of a clock that jumped


@dataclass
class Sample:
    """A measurement as it comes together.

    Attributes:
        stamp_ns: Its instant, ns.
        outputs: Channel -> reading.
        contact: Leg -> whether it is loaded.
        repeated: How often its IMU reading came again.
    """

    stamp_ns: int
    outputs: dict[str, float] = field(default_factory=dict)
    contact: dict[str, bool] = field(default_factory=dict)
    repeated: int = 0


@dataclass(frozen=True)
class Measurement:
    """What an estimator is told.

    Attributes:
        stamp_ns: Its instant, ns.
        torque: Held since the one before, N m.
        outputs: Channel -> reading, those that came.
        stance: Leg that stands; None where the contacts do not tell.
        late: Channel -> age in s of a reading that is older than the stamp; negative if newer.
    """

    stamp_ns: int
    torque: float
    outputs: dict[str, float]
    stance: str | None
    late: dict[str, float] = field(default_factory=dict)


class Gatherer:
    """Puts the parts together.

    Args:
        contacts: Whether the foot contacts tell the stance leg.
    """

    def __init__(self, contacts: bool = True):
        self.contacts = contacts
        self._waiting: dict[int, Sample] = {}
        self._last_ns: int | None = None
        self._torque, self._torque_ns = 0.0, -1
        self._pressed: dict[str, bool] = {}
        self._landed: list[str] = []
        self._alone = 0  # IMU samples without an encoder's, in a row
        self._encoder: tuple[int, float] | None = None  # stamp in ns, hip angle in rad
        self._ready: list[Measurement] = []

    @property
    def apart(self) -> bool:
        """Whether the devices have stamps of their own."""
        return self._alone >= ALONE

    def add(self, stamp_ns: int, outputs: dict[str, float]) -> None:
        """Readings of one instant."""
        if 'hip_angle' in outputs:
            self._encoder = stamp_ns, outputs['hip_angle']
        if self.apart:
            self._add_apart(stamp_ns, outputs)
            return
        sample = self._at(stamp_ns)
        if sample is not None:
            sample.repeated += 'imu_angle' in outputs and 'imu_angle' in sample.outputs
            sample.outputs |= outputs

    def add_contact(self, stamp_ns: int, leg: str, loaded: bool) -> None:
        """A foot contact."""
        if self.apart:
            self._landed += self._press({leg: loaded})
            return
        sample = self._at(stamp_ns)
        if sample is not None:
            sample.contact[leg] = loaded

    def add_torque(self, stamp_ns: int, torque: float) -> None:
        """The torque that the drive latched at that instant, N m."""
        if stamp_ns > self._torque_ns:
            self._torque, self._torque_ns = torque, stamp_ns

    def restart(self) -> None:
        """The clock has jumped back: forget what was."""
        self._waiting.clear()
        self._last_ns, self._torque, self._torque_ns = None, 0.0, -1
        self._pressed = {}
        self._alone, self._encoder = 0, None
        self._ready.clear()

    def due(self) -> Iterator[Measurement]:
        """The measurements that may be used now, in order."""
        while self._ready:
            yield self._ready.pop(0)
        while self._waiting:
            stamp_ns = min(self._waiting)
            sample = self._waiting[stamp_ns]
            newer = sum(
                1 + other.repeated
                for other in self._waiting.values()
                if other is not sample and 'imu_angle' in other.outputs
            )
            if not self._whole(sample) and newer < PATIENCE:
                return
            del self._waiting[stamp_ns]
            self._last_ns = stamp_ns
            if 'imu_angle' in sample.outputs:
                self._alone = 0 if 'hip_angle' in sample.outputs else self._alone + 1
            if sample.outputs:
                yield Measurement(stamp_ns, self._torque, sample.outputs, self._stance(sample))

    def _add_apart(self, stamp_ns: int, outputs: dict[str, float]) -> None:
        """A reading of a device that has stamps of its own."""
        if 'imu_angle' not in outputs or (self._last_ns is not None and stamp_ns <= self._last_ns):
            return
        if 'hip_angle' in outputs or (self._encoder is not None and self._encoder[0] == stamp_ns):
            self._alone = 0  # they meet after all
        self._waiting.clear()
        self._last_ns, late = stamp_ns, {}
        if self._encoder is not None and 'hip_angle' not in outputs:
            age_ns = stamp_ns - self._encoder[0]
            if abs(age_ns) <= LONGEST_NS:
                outputs = outputs | {'hip_angle': self._encoder[1]}
                late = {'hip_angle': age_ns / 1e9}
        self._ready.append(Measurement(stamp_ns, self._torque, outputs, self._told(), late))
        self._landed = []

    def _at(self, stamp_ns: int) -> Sample | None:
        if self._last_ns is not None and stamp_ns <= self._last_ns:
            return None
        if len(self._waiting) >= KEPT:
            del self._waiting[min(self._waiting)]
        return self._waiting.setdefault(stamp_ns, Sample(stamp_ns))

    def _whole(self, sample: Sample) -> bool:
        known = (
            self._last_ns is None
            or self._torque_ns >= self._last_ns
            or sample.repeated >= PATIENCE
        )
        return (
            known
            and {'imu_angle', 'hip_angle'} <= sample.outputs.keys()
            and (not self.contacts or len(sample.contact) == len(STANCES))
        )

    def _stance(self, sample: Sample) -> str | None:
        self._landed = self._press(sample.contact)
        return self._told()

    def _press(self, contact: dict[str, bool]) -> list[str]:
        """Note which feet are loaded; those that have just been."""
        before, self._pressed = self._pressed, self._pressed | contact
        return [leg for leg, on in self._pressed.items() if on and not before.get(leg, True)]

    def _told(self) -> str | None:
        """The leg that stands; None where the contacts do not tell."""
        loaded = [leg for leg, on in self._pressed.items() if on]
        told = self._landed if len(self._landed) == 1 else loaded
        return told[0] if self.contacts and len(told) == 1 else None
