"""Many robots walk at once under one law, each on its own ground, with its own errors and delay.

The robots move in vector C (flock.c), as those of `rollouts.py` do, with impacts located in time.
Laws are numpy over all robots, so that any law can be compared: `Following` is (FOL) of
trajectories.md as `Tracker` has it, `Constrained` virtual constraints, `Passive` no torque.
"""

import ctypes
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import LEAST_TURN, TrackingSettings
from cg_control.friction import friction_parameters, friction_torque
from cg_control.orbits.virtual_constraints import VirtualConstraints
from cg_control.trajectories.collocation import planning_model
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.rollout.compiler import shared_library
from cg_dynamics.rollout.vector_code import FLAGS, WIDTH, vector_code, vector_math
from cg_dynamics.walking.impact import impact_function
from cg_estimation.high_gain import sampled_gain

SAMPLE_TIME = 0.002  # s
FALLEN, SWUNG = 0.6, 2.0  # rad of the stance and of the swing leg, beyond which a robot is lost
SHORTEST = 0.1  # m of a step


class _Ground(ctypes.Structure):
    _fields_ = (
        ('slope', ctypes.c_void_p), ('rise', ctypes.c_void_p),
        ('minimum_step', ctypes.c_double), ('length_at', ctypes.c_long),
    )  # fmt: skip


class Physics:
    """The equations of a model, for many parameter vectors and states.

    Args:
        model: Four states, one torque.
    """

    def __init__(self, model: Model):
        self.nominal = parameter_vector(model, Setup())
        self.names = compile_model(model, Setup()).parameter_names
        self._library = _library(model)
        self._length_at = self.names.index('leg_length')

    def rows(self, count: int) -> np.ndarray:
        """The nominal parameters, so many times: (count, np)."""
        return np.tile(self.nominal, (count, 1))

    def move(self, leg, x, u, p, h, slope=None, rise=None) -> np.ndarray:
        """Move x (n, 4) in place; time left after a landing (n,), -1 where nobody landed.

        Without `slope` and `rise` nobody lands.
        """
        rest = np.empty(len(x))
        nowhere = np.zeros(len(x))
        lands = slope is not None
        for st in range(2):
            rows = np.flatnonzero(leg == st)
            y, v, q, t = (np.ascontiguousarray(a[rows], float) for a in (x, u, p, h))
            fall, up, left = (
                np.ascontiguousarray((a if lands else nowhere)[rows])
                for a in (slope if lands else nowhere, rise if lands else nowhere, rest)
            )
            ground = _Ground(
                fall.ctypes.data, up.ctypes.data, SHORTEST if lands else np.inf, self._length_at
            )
            self._library.flock_move(
                st,
                len(rows),
                *(a.ctypes.data for a in (y, v, q, t)),
                ctypes.addressof(ground),
                left.ctypes.data,
            )
            x[rows], rest[rows] = y, left
        return rest

    def land(self, leg, x, p) -> None:
        """The impact map of the ends of stance `leg`, in place on x (n, 4)."""
        for st in range(2):
            rows = np.flatnonzero(leg == st)
            y, q = (np.ascontiguousarray(a[rows], float) for a in (x, p))
            self._library.flock_land(st, len(rows), y.ctypes.data, q.ctypes.data)
            x[rows] = y

    def rates(self, leg, x) -> tuple[np.ndarray, np.ndarray]:
        """dx/dt of the nominal model without torque and with 1 N m, (n, 4) each."""
        idle, pushed = np.empty_like(x), np.empty_like(x)
        for st in range(2):
            rows = np.flatnonzero(leg == st)
            y, q = np.ascontiguousarray(x[rows]), self.rows(len(rows))
            a, b = np.empty_like(y), np.empty_like(y)
            self._library.flock_rates(st, len(rows), *(v.ctypes.data for v in (y, q, a, b)))
            idle[rows], pushed[rows] = a, b
        return idle, pushed


def _library(model: Model) -> ctypes.CDLL:
    if model.hash not in _libraries:
        _libraries[model.hash] = _built(model)
    return _libraries[model.hash]


_libraries: dict[str, ctypes.CDLL] = {}


def _built(model: Model) -> ctypes.CDLL:
    codes, constants = [], 1
    for number, leg in enumerate(STANCES):
        e = compile_model(model, Setup(stance=leg)).equations
        after = impact_function(model, leg)(e.x[:2], e.x[2:4], e.p)[0]
        functions = {
            'rates_': ca.Function('f', [e.x, e.u, e.p], [ca.densify(ca.cse(e.rates))]),
            'land_': ca.Function('land', [e.x, e.u, e.p], [ca.densify(ca.cse(after))]),
        }
        for name, function in functions.items():
            prepare = f'prepare_{"land_" if name == "land_" else ""}{number}'
            code, shared = vector_code(function, f'{name}{number}', prepare)
            codes.append(code)
            constants = max(constants, shared + 1)
    one = compile_model(model, Setup())
    sizes = {'WIDTH': WIDTH, 'NX': one.nx, 'NU': one.nu, 'NP': one.np, 'CONSTANTS': constants}
    source = '\n'.join([
        *(f'#define {name} {value}' for name, value in sizes.items()),
        vector_math(), *codes, (Path(__file__).parent / 'flock.c').read_text(),
    ])  # fmt: skip
    library = ctypes.CDLL(str(shared_library(source, FLAGS)))
    p, n, i = ctypes.c_void_p, ctypes.c_long, ctypes.c_int
    library.flock_move.argtypes = [i, n, p, p, p, p, p, p]
    library.flock_land.argtypes = [i, n, p, p]
    library.flock_rates.argtypes = [i, n, p, p, p, p]
    for name in ('flock_move', 'flock_land', 'flock_rates'):
        getattr(library, name).restype = None
    return library


def _jolt(model: Model, stance: str) -> ca.Function:
    e = compile_model(model, Setup(stance=stance)).equations
    lean = e.x[model.mechanism.bodies.index(stance)]
    jacobian = ca.jacobian(model.values['leg_length'] * ca.sin(lean), e.x[:2])
    return ca.Function('jolt', [e.x, e.p], [ca.solve(e.mass_matrix, jacobian.T)])


def pushed(model: Model, stance: str, x: np.ndarray, impulse: float) -> np.ndarray:
    """The state (4,) after a push at the hip, in N s, as `Plant.push` has it."""
    y = np.array(x, float)
    jump = _jolt(model, stance)(y, parameter_vector(model, Setup()))
    y[2:] += impulse * np.asarray(jump).ravel()
    return y


@dataclass
class Flock:
    """Robots at their starts, and what each has to deal with.

    Attributes:
        leg: That stands, index into STANCES, (B,).
        x: States, (B, 4).
        node: Of the orbit at which each starts,
        elapsed: since so many seconds, (B,).
        p: Parameter vectors, (B, np).
        slope: Fall of the ground ahead, rad, (B,).
        rise: The next foothold is so much higher at each landing, m, (B, any), repeated.
        delay: Of the torque, samples, (B,).
        compensates: Whether the friction that is known is given back, (B,).
        observed: Whether the state comes from the observer, with sensor noise, (B,).
        noise: White, on both rates that the law is told, rad/s, (B,).
    """

    leg: np.ndarray
    x: np.ndarray
    node: np.ndarray
    elapsed: np.ndarray
    p: np.ndarray
    slope: np.ndarray
    rise: np.ndarray
    delay: np.ndarray
    compensates: np.ndarray
    observed: np.ndarray
    noise: np.ndarray

    @classmethod
    def of(cls, physics: Physics, leg, x, node=0, elapsed=0.0) -> 'Flock':
        """Robots as they are known on even ground, their states known."""
        x = np.atleast_2d(np.array(x, float))
        n = len(x)
        whole, no = np.zeros(n, int), np.zeros(n, bool)
        return cls(
            whole + leg, x, whole + node, np.zeros(n) + elapsed, physics.rows(n), np.zeros(n),
            np.zeros((n, 1)), whole.copy(), ~no, no, np.zeros(n),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.x)

    def and_(self, *others: 'Flock') -> 'Flock':
        """All of them together."""
        flocks = (self, *others)
        wide = max(f.rise.shape[1] for f in flocks)
        for f in flocks:
            f.rise = np.tile(f.rise, (1, -(-wide // f.rise.shape[1])))[:, :wide]
        names = self.__dataclass_fields__
        return Flock(**{k: np.concatenate([getattr(f, k) for f in flocks]) for k in names})


class Passive:
    """No torque."""

    def begin(self, flock: Flock) -> None:
        """Before the first sample."""

    def torque(self, who, leg, x, taken, first: bool) -> np.ndarray:
        """Torque of the robots `who`, (n,)."""
        return np.zeros(len(who))


class Constrained:
    """Virtual constraints."""

    def __init__(self, constraints: VirtualConstraints, known: Model):
        self._law = constraints
        self._physics = Physics(planning_model(known, friction=False))
        self.limit = known.torque_limit

    def begin(self, flock: Flock) -> None:
        """Before the first sample."""

    def torque(self, who, leg, x, taken, first: bool) -> np.ndarray:
        """Torque of the robots `who`, (n,)."""
        idle, with_one = self._physics.rates(leg, x)
        u = np.empty(len(x))
        for st, name in enumerate(STANCES):
            mine = leg == st
            u[mine] = self._law.demanded(name, x[mine], idle[mine], with_one[mine])
        return np.clip(u + taken, -self.limit, self.limit)


class Following:
    """Nodes under feedback: `Tracker`, for many robots.

    Args:
        nodes: What is followed.
        known: The robot as it is known.
        settings: Remedy clock, event or phase.
        propagated: The phase moves by (TRV) of the model, and is corrected by the pull; else its
            rate without a pull is 1.
    """

    def __init__(
        self, nodes: Nodes, known: Model, settings: TrackingSettings, propagated: bool = False
    ):
        self.nodes, self.settings, self.limit = nodes, settings, known.torque_limit
        self.propagated = propagated
        self._edges = np.ascontiguousarray(nodes.edges)
        self._physics = Physics(planning_model(known, friction=False))

    def begin(self, flock: Flock) -> None:
        """Before the first sample."""
        self.node, self.elapsed = flock.node.copy(), flock.elapsed.copy()
        self._net = np.zeros(len(flock))  # torque that acted, without what friction takes
        self.rate, self.ahead = np.ones(len(flock)), np.zeros(len(flock))

    def _at(self, node, s) -> np.ndarray:
        e, s = self._edges[node], s[:, None]
        return e[:, 0] + s * (e[:, 1] + s * (e[:, 2] + s * e[:, 3]))

    def _ahead(self, node, s, x) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How much time the robots are ahead of the reference; n; 1 - n_s'(x - x0)."""
        d = x - self._at(node, s)[:, 1:5]
        normal, turning = np.moveaxis(self.nodes.surfaces[node], 1, 0)
        normal = normal + s[:, None] * turning
        turn = np.maximum(1.0 - (turning * d).sum(axis=1), LEAST_TURN)
        return (normal * d).sum(axis=1) / turn, normal, turn

    def _advance(self, who, leg, x) -> None:
        nodes, law = self.nodes, self.settings
        node, s = self.node[who], self.elapsed[who]
        if law.by_clock:
            s += SAMPLE_TIME
            while (over := nodes.impact[node] | (s >= nodes.span[node])).any():
                s = np.where(over & ~nodes.impact[node], s - nodes.span[node], s)
                node = np.where(over, nodes.planned[node], node)
        else:
            landed = nodes.stance[node] != leg
            rate = np.ones(len(who))
            if law.pulled:
                ahead, normal, turn = self._ahead(node, s, x)
                if self.propagated:
                    idle, with_one = self._physics.rates(leg, x)
                    f = idle + self._net[who, None] * (with_one - idle)
                    rate = (normal * f).sum(axis=1) / turn
                rate = rate + law.pulled * (ahead - rate * SAMPLE_TIME)
                rate = np.clip(rate, 1 / law.fastest, law.fastest)
                self.rate[who] = rate
            onto = landed & (nodes.landing[node] >= 0)
            s = np.where(onto, 0.0, np.where(landed, s, s + rate * SAMPLE_TIME))
            node = np.where(onto, nodes.landing[node], node)
            while (over := s >= nodes.span[node]).any():
                s = np.where(over, s - nodes.span[node], s)
                node = np.where(over, nodes.next[node], node)
        self.node[who], self.elapsed[who] = node, s

    def torque(self, who, leg, x, taken, first: bool) -> np.ndarray:
        """Torque of the robots `who`, (n,)."""
        if not first:
            self._advance(who, leg, x)
        node = self.node[who]
        at = self._at(node, self.elapsed[who])
        u = at[:, 0] - (at[:, 5:] * (x - at[:, 1:5])).sum(axis=1) + taken
        u = np.clip(u, -self.limit, self.limit)
        if not self.settings.by_clock:
            u[self.nodes.stance[node] != leg] = 0.0
        self._net[who] = u - taken
        return u


class Observers:
    """High-gain observers, as `HighGainObserver`, for many robots; sensors as the model has them.

    They begin at the true state.
    """

    def __init__(self, model: Model, epsilon: float, seed: int = 0):
        self._physics, self._epsilon = Physics(model), epsilon
        self._gain = sampled_gain(-1.0 + 0.0j, epsilon, SAMPLE_TIME)
        self._rng, sensors = np.random.default_rng(seed), model.sensors
        self._lean = sensors['imu_angle']['noise'].value
        self._hip = sensors['hip_angle']['noise'].value
        self._count = sensors['hip_angle']['resolution'].value

    def begin(self, leg: np.ndarray, x: np.ndarray) -> None:
        """At the true states."""
        self.leg, self.x = leg.copy(), x.copy()

    def step(self, which, leg, x, u) -> np.ndarray:
        """Estimates (n, 4) of robots `which`; x true states, u the torque that was held."""
        y, p = self.x[which], self._physics.rows(len(which))
        was = self.leg[which]
        self._physics.move(was, y, u, p, np.full(len(y), SAMPLE_TIME))
        new = was != leg
        if new.any():
            z = y[new]
            self._physics.land(was[new], z, p[new])
            y[new] = z
        n = len(which)
        lean = x[:, 0] + self._lean * self._rng.standard_normal(n) - y[:, 0]
        hip = x[:, 0] - x[:, 1] + self._hip * self._rng.standard_normal(n)
        hip = np.round(hip / self._count) * self._count - (y[:, 0] - y[:, 1])
        for i, error in enumerate((lean, lean - hip)):
            y[:, i] += self._gain[0] * error
            y[:, 2 + i] += self._gain[1] * error
        self.x[which], self.leg[which] = y, leg
        return y.copy()


@dataclass(frozen=True)
class Walked:
    """How robots fared: impacts, end in s, whether on their feet, largest torque: (B,) each."""

    impacts: np.ndarray
    time: np.ndarray
    standing: np.ndarray
    torque: np.ndarray


def walked(
    robot: Model,
    flock: Flock,
    law,
    steps: int,
    duration: float,
    known: Model | None = None,
    epsilon: float = 0.01,
    seed: int = 0,
    watch=None,
) -> Walked:
    """Let them walk until they have made so many steps, have fallen, or time is over.

    Args:
        robot: Its structure counts; parameters are those of the flock.
        flock: Is used up.
        law: Of the torque.
        steps: To make.
        duration: In s.
        known: What the controllers know; None: the robot with its own parameters.
        epsilon: Of the observers, s.
        seed: Of all noise.
        watch: Called with (time, who, leg, states) each sample.
    """
    known = known or robot
    physics, rng = Physics(robot), np.random.default_rng([seed, 1])
    friction, friction_p = friction_torque(known), friction_parameters(known)
    observers = Observers(known, epsilon, seed)
    n = len(flock)
    leg, x = flock.leg.copy(), flock.x.copy()
    impacts, time, torque = np.zeros(n, int), np.zeros(n), np.zeros(n)
    standing = np.ones(n, bool)
    held = np.zeros(n)
    late = np.zeros((n, int(flock.delay.max(initial=0)) + 1))
    seen = np.flatnonzero(flock.observed)
    place = np.full(n, -1)
    place[seen] = np.arange(len(seen))
    observers.begin(leg[seen], x[seen])
    law.begin(flock)
    who = np.arange(n)
    for tick in range(round(duration / SAMPLE_TIME)):
        told = x[who].copy()
        mine = flock.observed[who]
        if mine.any() and tick:
            some = who[mine]
            told[mine] = observers.step(place[some], leg[some], x[some], held[some])
        told[:, 2:] += flock.noise[who, None] * rng.standard_normal((len(who), 2))
        hip = (told[:, 0] - told[:, 1])[None], (told[:, 2] - told[:, 3])[None]
        taken = np.asarray(friction(*hip, friction_p)).ravel() * flock.compensates[who]
        u = law.torque(who, leg[who], told, taken, tick == 0)
        late[:, 1:] = late[:, :-1]
        late[who, 0] = u
        acts = late[who, flock.delay[who]]
        held[who] = u
        torque[who] = np.maximum(torque[who], np.abs(acts))
        y = x[who]
        hang = np.full(len(who), SAMPLE_TIME)
        turn = impacts[who] % flock.rise.shape[1]
        slope = np.tan(flock.slope[who])
        rest = physics.move(leg[who], y, acts, flock.p[who], hang, slope, flock.rise[who, turn])
        down = rest >= 0.0
        if down.any():
            some = who[down]
            leg[some] = 1 - leg[some]
            impacts[some] += 1
            z = y[down]
            turn = impacts[some] % flock.rise.shape[1]
            physics.move(
                leg[some], z, acts[down], flock.p[some], rest[down], slope[down],
                flock.rise[some, turn],
            )  # fmt: skip
            y[down] = z
        x[who] = y
        if watch is not None:
            watch(tick, who, leg, x, law)
        rows = np.arange(len(who))
        # Not a number is a fall, too.
        up = (np.abs(y[rows, leg[who]]) < FALLEN) & (np.abs(y[rows, 1 - leg[who]]) < SWUNG)
        time[who] = (tick + 1) * SAMPLE_TIME
        standing[who] = up
        who = who[up & (impacts[who] < steps)]
        if not len(who):
            break
    return Walked(impacts, time, standing, torque)
