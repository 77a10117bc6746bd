"""The simulated machine apart from ROS: settings, loading, recording note, pace."""

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_description.reading import parse_yaml, path_of, read_text
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_interfaces.settings import Settings, setting
from cg_interfaces.stamps import NS_PER_S

SOFTWARE = 'compass-gait 0.2.0'
CATCH_UP = 2.0  # simulated s per s that a late machine takes at most
LOCKSTEP_EPOCH_NS = NS_PER_S  # simulated time starts at 1 s: a stamp of zero means "unset"


@dataclass(frozen=True)
class SimulationSettings(Settings):
    """Parameters of the simulation node."""

    model_file: str = setting(
        '', 'model to simulate, a file or a name; empty for the nominal compass gait'
    )
    setup: str = setting('', 'what was done to the rig: YAML text, or a file that holds it')
    seed: int = setting(0, 'seed of the sensor noise', minimum=0)
    sample_rate_hz: float = setting(
        500.0, 'rate of measurement and torque latching', unit='Hz', minimum=10.0, maximum=2000.0
    )
    mode: str = setting(
        'real_time',
        'clock of the machine: its own, or one tick per answered measurement',
        choices=('real_time', 'lockstep'),
    )
    initial_state: tuple[float, ...] = setting(
        (),
        'coordinates of the set-up, then their rates, as in conventions.md; empty for rest '
        'at zero [rad, rad/s]',
    )
    duration: float = setting(
        0.0, 'length of the run; 0 for as long as the node lives', unit='s', minimum=0.0
    )
    torque_limit: float = setting(
        0.0, 'saturation of the drive; 0 takes the limit of the model', unit='N m', minimum=0.0
    )
    stale_after: float = setting(
        0.02,
        'real time: age beyond which a command counts as lost and the torque is zero',
        unit='s',
        minimum=0.001,
        maximum=10.0,
    )
    answer_timeout: float = setting(
        5.0,
        'lock-step: longest wait for the answer to a measurement before the run is given up; for '
        'the first it is peer_timeout',
        unit='s',
        minimum=0.01,
        maximum=600.0,
    )
    peer_timeout: float = setting(
        20.0,
        'longest wait, at the start, for recorders and (lock-step) a controller and its answer',
        unit='s',
        minimum=0.1,
        maximum=600.0,
    )
    await_answer: bool = setting(
        False,
        'real time: repeat the first measurement until a command answers it, and only then let '
        'time run, as lock-step does; a robot that falls by itself needs its controller',
    )
    pushes: tuple[float, ...] = setting(
        (),
        'instants and horizontal impulses at the hip, in turn: t1, P1, t2, P2, ... [s, N s]',
    )
    recorders: int = setting(
        0,
        'recorders that must have subscribed to every topic before the first sample, and '
        'that a lock-step run never outpaces',
        minimum=0,
        maximum=10,
    )
    minimum_step: float = setting(
        0.1, 'set-up with on_blocks false: least step that lands', unit='m', minimum=0.0
    )
    fall_angle: float = setting(
        0.0,
        'compass gait with both legs free: lean of the stance leg at which the robot has fallen, '
        'which ends the run; 0: it never has',
        unit='rad',
        minimum=0.0,
    )
    outcome_file: str = setting(
        '', 'with fall_angle: file that gets how the robot fared, as JSON; empty for none'
    )
    experiment: str = setting('', 'name of the experiment, for the recording note')
    note_model_file: str = setting(
        '',
        'model file that the recording note names, where the machine deviates from it on '
        'purpose; empty for model_file',
    )
    closed_loop: bool = setting(
        False, 'for the recording note: a feedback controller makes the torque'
    )
    notes: str = setting('', 'free text for the recording note')
    autostart: bool = setting(True, 'configure and activate without being asked')
    exit_when_done: bool = setting(False, 'end the process after `duration` or a failure')

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.pushes) % 2:
            raise ValueError(
                f'pushes has {len(self.pushes)} numbers; an instant and an impulse for each push'
            )

    def pushes_at(self, tick: int) -> float:
        """Impulse in N s that hits the hip before that sample."""
        return sum(
            impulse
            for instant, impulse in zip(self.pushes[::2], self.pushes[1::2], strict=True)
            if round(instant * self.sample_rate_hz) == tick
        )


def model_file_of(name: str) -> Path:
    """The model file to use, by path or name; empty means the nominal compass gait."""
    return model_path(name or NOMINAL_MODEL)


def read_setup(text: str) -> Setup:
    """Set-up from YAML text, or from the file of that name.

    Raises:
        ValueError: naming what is wrong.
    """
    source = text
    if text and '\n' not in text and ':' not in text:
        source = read_text(path_of(text))
    return Setup.from_dict(parse_yaml(source, 'setup'))


def build_plant(settings: SimulationSettings, model: Model, setup: Setup) -> Plant:
    """The machine in its first state."""
    state = np.array(settings.initial_state) if settings.initial_state else None
    return Plant(
        model,
        setup,
        initial_state=state,
        sample_time=1.0 / settings.sample_rate_hz,
        seed=settings.seed,
        minimum_step=settings.minimum_step,
    )


def check_fall_angle(settings: SimulationSettings, mechanism: str, setup: Setup) -> None:
    """Refuse a fall angle for a machine that has no stance leg to lean.

    Raises:
        ValueError: naming what it is instead.
    """
    if settings.fall_angle == 0.0:
        return
    if mechanism != 'compass_gait' or setup.fixture != 'none':
        raise ValueError(
            f'fall_angle is {settings.fall_angle:g} rad, which needs a compass gait with both '
            f'legs free; this is a {mechanism} with fixture {setup.fixture}'
        )


def noise_variances(model: Model) -> dict[str, float]:
    """Channel -> variance of its noise, in the channel's unit squared."""
    return {
        channel: sensor['noise'].value ** 2
        for channel, sensor in model.sensors.items()
        if 'noise' in sensor
    }


def recording_note(
    settings: SimulationSettings, mechanism: str, setup: Setup, channels: list[str], zeroed_at: str
) -> str:
    """The YAML text of `/experiment`: interfaces.md, "The recording note"."""
    path = model_file_of(settings.note_model_file or settings.model_file)
    rates = settings.initial_state[len(settings.initial_state) // 2 :]
    note = {
        'format': 'cg_recording/1',
        'experiment': settings.experiment or 'unnamed',
        'mechanism': mechanism,
        'setup': setup.to_dict(),
        'nominal_rate_hz': settings.sample_rate_hz,
        'sensor_zeros': {name: 0.0 for name in channels if name.endswith('angle')},
        'zeroed_at': zeroed_at,
        'initial_state': 'moving' if any(rates) else 'rest',
        'model_file': path.name,
        'model_sha256': hashlib.sha256(path.read_bytes()).hexdigest(),
        'software': SOFTWARE,
        'closed_loop': settings.closed_loop,
        'notes': settings.notes,
    }
    return yaml.safe_dump(note, sort_keys=False, allow_unicode=True)


def ticks_of(duration: float, rate_hz: float) -> int | None:
    """Samples in a run of that many s; None for an endless one."""
    return math.ceil(duration * rate_hz - 1e-9) if duration > 0.0 else None


class Pace:
    """Which samples are due on a clock, and how late they were taken.

    A late machine catches up: no sample is ever left out, lateness is counted instead. It does so
    at `CATCH_UP` times the speed of the clock, so that controllers keep up and the loop stays
    closed meanwhile.
    """

    def __init__(self, rate_hz: float, start_ns: int):
        self.period_ns = round(NS_PER_S / rate_hz)
        self.start_ns = start_ns
        self.earliest_ns = start_ns
        self.taken = 0
        self.worst_ns = 0
        self.late = 0

    @property
    def next_ns(self) -> int:
        """When the next sample is to be taken."""
        return max(self.start_ns + self.taken * self.period_ns, self.earliest_ns)

    def lateness(self, now_ns: int) -> int:
        """How long the next sample has been due, in ns."""
        return now_ns - self.start_ns - self.taken * self.period_ns

    def take(self, now_ns: int) -> bool:
        """Take the next sample if it is due."""
        if now_ns < self.next_ns:
            return False
        lateness = self.lateness(now_ns)
        self.earliest_ns = now_ns + round(self.period_ns / CATCH_UP)
        self.taken += 1
        self.worst_ns = max(self.worst_ns, lateness)
        self.late += lateness > self.period_ns
        return True

    def forget(self) -> None:
        """Start counting lateness anew."""
        self.worst_ns = 0
        self.late = 0
