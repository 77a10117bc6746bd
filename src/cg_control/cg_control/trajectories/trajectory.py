"""A planned motion: phases of one stance leg each, with feedback and cost to go, and its file.

Between knots the state is the cubic Hermite interpolant of states and rates, and the torque is
linear: what direct collocation means by them (trajectories.md, (HS)). Gains and cost to go
are linear in between. A file is JSON: every number is written with as many digits as bring it
back exactly, and the hash of the model says for which robot it was planned.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from cg_description.model_file import write_atomically
from cg_description.reading import JSON, parse_json, read_text
from cg_description.schema import Flag, Key, ListOf, Number, Text
from cg_description.schema import Mapping as Form
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

FORMAT = 'cg_trajectory/1'
ROWS = ListOf(ListOf(Number(), 1), 2)
SCHEMA = Form({
    'format': Key(Text((FORMAT,))),
    'model_hash': Key(Text(longest=100), 'of the model it was planned for'),
    'provenance': Key(Form({
        'slope': Key(Number(), default=0.0, unit='rad'),
        'friction': Key(Text(), default=''),
        'periodic': Key(Flag(), default=False),
    }, further=True, fill=False), default={}),
    'phases': Key(ListOf(Form({
        'stance': Key(Text(STANCES)),
        'time': Key(ListOf(Number(), 2), unit='s'),
        'states': Key(ROWS, unit='rad, rad/s'),
        'rates': Key(ROWS, unit='rad/s, rad/s^2'),
        'torque': Key(ListOf(Number(), 2), unit='N m'),
        'gains': Key(ROWS, default=()),
        'cost_to_go': Key(ListOf(ROWS, 2), default=()),
        'normals': Key(ROWS, default=()),
    }), 1)),
})  # fmt: skip


class TrajectoryError(ValueError):
    """A trajectory that cannot be used; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class Point:
    """A trajectory at one instant: state (nx,), torque in N m, gain (nx,), cost to go (nx, nx).

    And the normal of the transversal surface there, shape (nx,).
    """

    state: np.ndarray
    torque: float
    gain: np.ndarray
    cost_to_go: np.ndarray
    normal: np.ndarray


@dataclass(frozen=True)
class Phase:
    """One stance phase, both ends included; arrays are read-only.

    Attributes:
        stance: The leg pair that stands, 'inner' or 'outer'.
        time: Knots in s from the start of the trajectory, increasing, shape (n,).
        states: (q_inner, q_outer) and rates at the knots, shape (n, nx), rad and rad/s.
        rates: dx/dt at the knots, shape (n, nx).
        torque: Nominal hip torque at the knots, shape (n,), N m.
        gains: K of u = u0 - K (x - x0), shape (n, nx); zero without feedback.
        cost_to_go: S of x'Sx, shape (n, nx, nx); zero without feedback.
        normals: n of the transversal surfaces n'(x - x0) = 0, scaled so that n'dx0/dt = 1,
            shape (n, nx); zero without surfaces.
    """

    stance: str
    time: np.ndarray
    states: np.ndarray
    rates: np.ndarray
    torque: np.ndarray
    gains: np.ndarray = field(default_factory=lambda: np.zeros(0))
    cost_to_go: np.ndarray = field(default_factory=lambda: np.zeros(0))
    normals: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self):
        if self.stance not in STANCES:
            raise TrajectoryError(f'stance is {self.stance!r}; allowed are {", ".join(STANCES)}')
        for name in (f.name for f in fields(self)[1:]):
            try:
                object.__setattr__(self, name, np.array(getattr(self, name), float))
            except (TypeError, ValueError):
                raise TrajectoryError(f'{name} must be numbers, in rows of one length') from None
        n = np.size(self.time)
        nx = np.shape(self.states)[-1] if np.ndim(self.states) == 2 else 0
        shapes = {
            'time': (n,), 'states': (n, nx), 'rates': (n, nx), 'torque': (n,),
            'gains': (n, nx), 'cost_to_go': (n, nx, nx), 'normals': (n, nx),
        }  # fmt: skip
        for name, shape in shapes.items():
            array = getattr(self, name)
            if name in ('gains', 'cost_to_go', 'normals') and array.size == 0:
                array = np.zeros(shape)
            if array.shape != shape:
                raise TrajectoryError(f'{name} has shape {array.shape}, expected {shape}')
            if not np.isfinite(array).all():
                raise TrajectoryError(f'{name} must be finite numbers')
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if n < 2 or not (np.diff(self.time) > 0).all():
            raise TrajectoryError('time must hold at least two increasing instants')

    @property
    def start(self) -> float:
        """First instant in s."""
        return float(self.time[0])

    @property
    def end(self) -> float:
        """Last instant in s."""
        return float(self.time[-1])

    def at(self, t: float) -> Point:
        """The phase at an instant; before its start and after its end the nearest one."""
        i = min(max(int(np.searchsorted(self.time, t, side='right')) - 1, 0), len(self.time) - 2)
        h = self.time[i + 1] - self.time[i]
        s = min(max((t - self.time[i]) / h, 0.0), 1.0)
        r = 1.0 - s
        state = (
            (1 + 2 * s) * r**2 * self.states[i]
            + (1 + 2 * r) * s**2 * self.states[i + 1]
            + h * s * r * (r * self.rates[i] - s * self.rates[i + 1])
        )
        torque, *rest = (
            r * a[i] + s * a[i + 1]
            for a in (self.torque, self.gains, self.cost_to_go, self.normals)
        )
        return Point(state, float(torque), *rest)


@dataclass(frozen=True)
class Trajectory:
    """A planned motion; immutable, every change is a new one.

    Attributes:
        phases: Stance phases in order, each beginning where the last one ends; the state jumps
            there as the impact map says.
        model_hash: Of the model it was planned for (`Model.hash`).
        provenance: How it came about: task, cost, solver, software. JSON values.
    """

    phases: tuple[Phase, ...]
    model_hash: str
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, 'phases', tuple(self.phases))
        if not self.phases:
            raise TrajectoryError('a trajectory needs at least one phase')
        for before, after in zip(self.phases, self.phases[1:], strict=False):
            if before.end != after.start:
                raise TrajectoryError(
                    f'a phase ends at {before.end} s but the next begins at {after.start} s'
                )
            if before.stance == after.stance:
                raise TrajectoryError(f'stance stays {before.stance!r} across an impact')
            if before.states.shape[1] != after.states.shape[1]:
                raise TrajectoryError('phases differ in the number of states')

    @property
    def duration(self) -> float:
        """In s."""
        return self.phases[-1].end - self.phases[0].start

    @property
    def modes(self) -> tuple[str, ...]:
        """Stance leg of each phase."""
        return tuple(phase.stance for phase in self.phases)

    @property
    def impact_times(self) -> tuple[float, ...]:
        """Instants at which the stance leg changes, s."""
        return tuple(phase.end for phase in self.phases[:-1])

    @property
    def time(self) -> np.ndarray:
        """All knots in s; instants of impacts appear twice."""
        return np.concatenate([phase.time for phase in self.phases])

    @property
    def states(self) -> np.ndarray:
        """States at `time`."""
        return np.concatenate([phase.states for phase in self.phases])

    @property
    def torque(self) -> np.ndarray:
        """Torque at `time`, N m."""
        return np.concatenate([phase.torque for phase in self.phases])

    def index_at(self, t: float) -> int:
        """Index of the phase that is active at an instant."""
        return int(np.searchsorted(self.impact_times, t, side='right'))

    def at(self, t: float) -> Point:
        """The trajectory at an instant; at an impact, what is right after it."""
        return self.phases[self.index_at(t)].at(t)

    def with_phases(self, phases: tuple[Phase, ...], **provenance: Any) -> 'Trajectory':
        """This trajectory with other phases, and more to say where it comes from."""
        return replace(self, phases=phases, provenance={**self.provenance, **provenance})

    def require_model(self, model: Model) -> None:
        """Refuse a model that the trajectory was not planned for.

        Raises:
            TrajectoryError: naming both hashes.
        """
        if model.hash != self.model_hash:
            raise TrajectoryError(
                f'trajectory was planned for a model with hash {self.model_hash[:12]}, but '
                f'{model.name!r} has {model.hash[:12]}; plan it again for this model'
            )

    def text(self) -> str:
        """The text of the file."""
        phases = [
            {'stance': phase.stance}
            | {f.name: getattr(phase, f.name).tolist() for f in fields(Phase)[1:]}
            for phase in self.phases
        ]
        content = {
            'format': FORMAT,
            'model_hash': self.model_hash,
            'provenance': dict(self.provenance),
            'phases': phases,
        }
        return json.dumps(content, allow_nan=False) + '\n'

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_atomically(path, self.text())

    @classmethod
    def load(cls, path: str | Path, model: Model | None = None) -> 'Trajectory':
        """Read a file.

        Args:
            path: The file.
            model: The robot it is meant for; None: any.

        Raises:
            TrajectoryError: for a file that is none, or one of another model.
        """
        return cls.from_text(read_text(path, TrajectoryError, JSON), model, str(path))

    @classmethod
    def from_text(
        cls, text: str, model: Model | None = None, where: str = 'trajectory'
    ) -> 'Trajectory':
        """Read the text of a file, as it travels on a topic; otherwise as `load`."""
        content = SCHEMA.of(parse_json(text, where, TrajectoryError), where, TrajectoryError)
        try:
            trajectory = cls._from_content(content)
            if model is not None:
                trajectory.require_model(model)
        except TrajectoryError as error:
            raise TrajectoryError(f'{where}: {error}') from None
        return trajectory

    @classmethod
    def _from_content(cls, content: dict[str, Any]) -> 'Trajectory':
        phases = []
        for number, entry in enumerate(content['phases']):
            try:
                phases.append(Phase(**entry))
            except TrajectoryError as error:
                raise TrajectoryError(f'phases[{number}].{error}') from None
        return cls(tuple(phases), content['model_hash'], content['provenance'])
