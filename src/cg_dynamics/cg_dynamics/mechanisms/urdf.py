"""Any tree of joints on a fixed base, from its URDF: recursive Newton-Euler, link by link.

Each joint that moves carries a body: its child link and all links fixed to that. In the body's own
frame, with mass m, first moment h = m c and inertia I about the frame's origin,

    f = m a + dw x h + w x (w x h),    n = I dw + w x (I w) + h x a                      (NE)

where w, dw and a are the frame's angular velocity, angular acceleration and acceleration less
gravity. What a joint has to give is f along or n about its axis, once the bodies it carries have
been added up: tau = ID(q, v, dv/dt). M(q) comes from composite bodies (CRB). Both are checked
against MuJoCo and Drake (test_urdf_oracles.py).

The numbers of a body are how far its mass distribution is from that in the URDF, of which it is an
affine image, x -> c + G (t + D G^-1 (x - c)), and heavier by a ratio:

    m = mu m0,    c = c0 + G t,    S = G D D' G',    S0 = G G'                           (BODY)

with S the second moment of a unit mass about its centre and D upper triangular. G is the Cholesky
factor of S0, so that t and D count in radii of gyration. Whatever the numbers, real bodies have
them: this is the pseudo-inertia's Cholesky factor [Rucker & Wensing 2022, RA-L 7(2)], seen from
the URDF.
"""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from cg_description.robot_description import (
    Inertial,
    Joint,
    RobotDescription,
    parse,
    rotation,
)
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.mechanism import Kinematics, Mechanism, PointMass, Symbols
from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup

BELIEF = 0.15  # standard deviation of each of a body's numbers, [1]
NUMBERS = (
    # name, description, neutral value, range
    ('mass', 'mass over that in the URDF', 1.0, (1e-2, 1e2)),
    *((f'shift_{a}', f'centre of mass along {a}, in radii of gyration', 0.0, (-20.0, 20.0))
      for a in 'xyz'),
    *((f'stretch_{a}', f'extent along {a} over that in the URDF', 1.0, (2e-2, 50.0))
      for a in 'xyz'),
    *((f'shear_{a}', f'shear of the body in its {a} plane', 0.0, (-10.0, 10.0))
      for a in ('xy', 'xz', 'yz')),
)  # fmt: skip
THINNEST = 1e-3  # m, radius of gyration of a body that has none in its URDF
ROUNDED = 0.02  # share by which a principal moment may exceed the sum of the others by rounding
POSES, POSES_WITHIN = 16, 1.5  # poses for a mean inertia, and how far from zero, rad (m)
PROBES = 40  # motions at which the numbers are looked at that could matter
DETERMINED = 1e-8  # relative size of what a motion has to show of a number
# Mass in kg, first moment in kg m, (3, 1), and inertia about the origin of a link, (3, 3).
Mass = tuple[ca.SX, ca.SX, ca.SX]


class Urdf(Mechanism):
    """A robot by its description.

    Args:
        description: Links and joints.
        driven: Names of the joints and couplings that have a drive; by default all joints that
            move by themselves.
        rates: Whether rates of joints are measured too.
        couplings: Motor that turns with several joints, as those of a differential do -> joint ->
            rad that it turns, seen through its own gear, with each rad (m) of the joint.

    Raises:
        ModelError: if nothing moves, a driven or coupled joint does not, a coupling is none, or no
            real body has an inertia.
    """

    def __init__(
        self,
        description: RobotDescription,
        driven: Sequence[str] | None = None,
        rates: bool = False,
        couplings: Mapping[str, Mapping[str, float]] | None = None,
    ):
        self.name, self.dimensions = 'urdf', 3
        self.description, self.rates = description, rates
        self.couplings = {name: dict(ratios) for name, ratios in (couplings or {}).items()}
        self.moving = description.moving
        free = [joint.name for joint in description.independent]
        if not free:
            raise ModelError(f'URDF {description.name!r}: no joint moves')
        rows = {name: tuple(float(name == other) for other in free) for name in free}
        for name, ratios in self.couplings.items():
            rows[name] = self._coupled(name, ratios)
        self.driven = tuple(free if driven is None else driven)
        for name in self.driven:
            if name not in self.couplings and (stranger := description.stranger(name)):
                others = ', '.join(['', *self.couplings])
                raise ModelError(f'driven: {stranger}{others}')
        self.coordinates = tuple(free)
        self.joints = {name: rows[name] for name in self.driven}
        self.passive = {name: row for name, row in rows.items() if name not in self.driven}
        self.sliding = tuple(j.name for j in description.independent if j.slides)
        self.inputs = tuple(f'{name}_effort' for name in self.driven)
        units = ['m' if name in self.sliding else 'rad' for name in free]
        self.outputs = tuple(f'{name}_position' for name in free)
        self.output_units = tuple(units)
        self.sensor_kinds = dict.fromkeys(self.outputs, 'encoder')
        if rates:
            rates_of = tuple(f'{name}_velocity' for name in free)
            self.outputs += rates_of
            self.output_units += tuple(f'{unit}/s' for unit in units)
            self.sensor_kinds |= dict.fromkeys(rates_of, 'tachometer')
        self._bodies = _bodies(description)
        self.bodies = tuple(_place(description, joint) for joint in self.moving)
        self.parameters = (
            *(p for body in self._bodies for p in body.parameters()),
            Parameter('gravity', 'm/s^2', 'acceleration of gravity', 0.0, 30.0, 9.81, free=False),
        )
        self.parameters = self._determined()

    def _coupled(self, name: str, ratios: Mapping[str, float]) -> tuple[float, ...]:
        """The row of a coupling."""
        where = f'couplings.{name}'
        if name in (joint.name for joint in self.description.joints):
            raise ModelError(f'{where}: a joint has that name; give the motor another one')
        for joint in ratios:
            if stranger := self.description.stranger(joint):
                raise ModelError(f'{where}: {stranger}')
        if sum(ratio != 0 for ratio in ratios.values()) < 2:
            raise ModelError(f'{where}: two joints at least, each with a ratio that is not 0')
        return tuple(float(ratios.get(j.name, 0.0)) for j in self.description.independent)

    def slides(self, joint: str) -> bool:
        """Whether a joint moves along a line; the motor of a coupling turns."""
        return joint in self.sliding

    def inertia_at(self, joint: str) -> float:
        """By the URDF, the mean over some poses; of a coupling where its joints share the way."""
        row = np.array(self.all_joints[joint])
        way = row / (row @ row)
        return float(way @ self._inertia @ way)

    @cached_property
    def _inertia(self) -> np.ndarray:
        """Mean of the mass matrix over some poses, shape (n, n)."""
        q, n = ca.SX.sym('q', len(self.coordinates)), len(self.coordinates)
        numbers = {p.name: ca.SX(p.default) for p in self.parameters}
        matrix = ca.Function('mass_matrix', [q], [self.mass_matrix(q, numbers)])
        random = np.random.default_rng(0)
        poses = (random.uniform(-POSES_WITHIN, POSES_WITHIN, n) for _ in range(POSES))
        return np.mean([np.asarray(matrix(pose)) for pose in poses], axis=0)

    def told(self, joint: str) -> tuple[str, ...]:
        """What a drive is told that follows positions."""
        return f'{joint}_commanded_position', f'{joint}_commanded_velocity'

    # Models, sensors and compiled code of equal robots are the same.
    @cached_property
    def identity(self) -> str:
        """Name of this very robot: two that differ in a number or a joint have other ones."""
        said = f'{self._text}|{self.driven}|{self.rates}'
        if self.couplings:
            said += f'|{self.couplings}'
        return f'urdf:{hashlib.sha256(said.encode()).hexdigest()[:16]}'

    def __eq__(self, other):
        return isinstance(other, Urdf) and self.identity == other.identity

    def __hash__(self):
        return hash(self.identity)

    # Models travel between processes all the time, and what follows from a URDF takes a while.
    def __reduce__(self):
        couplings = tuple((name, tuple(own.items())) for name, own in self.couplings.items())
        return _known, (self._text, self.driven, self.rates, couplings)

    @cached_property
    def _text(self) -> str:
        return self.description.text()

    def robot(self):
        """Its URDF, and what that does not say."""
        every = self.driven == self.coordinates
        return {
            'urdf': self._text,
            'driven': None if every else list(self.driven),
            'rates': self.rates,
            'couplings': self.couplings or None,
        }

    def up(self, setup: Setup) -> ca.SX:
        """Against the set-up's gravity, in the frame of the root."""
        return ca.SX(ca.DM([-x / math.hypot(*setup.gravity) for x in setup.gravity]))

    def kinematics(self, setup: Setup) -> Kinematics:
        """All joints but those that the set-up locks."""
        locked = dict(setup.locked)
        for name in locked:
            if stranger := self.description.stranger(name):
                raise ModelError(f'setup.locked: {stranger}')
        free = [k for k, name in enumerate(self.coordinates) if name not in locked]
        if not free:
            raise ModelError('setup.locked: nothing is left to move')
        return Kinematics(
            tuple(self.coordinates[k] for k in free),
            ca.DM(np.eye(len(self.coordinates))[:, free]),
            ca.DM([locked.get(name, 0.0) for name in self.coordinates]),
        )

    def energies(self, q, v, p: Symbols, setup, up, foot=None):
        """T = v'M v / 2; V = sum m g (up . c)."""
        kinetic = ca.mtimes([v.T, self.mass_matrix(q, p), v]) / 2
        potential = ca.SX(0)
        frames = self._frames(q)
        for body, joint in zip(self._bodies, self.moving, strict=True):
            m, h, _ = body.symbols(p)
            turn, origin = frames[joint.child]
            potential += p['gravity'] * ca.dot(up, m * origin + ca.mtimes(turn, h))
        return kinetic, potential

    def point(self, body, distance, q, p, setup):
        """World position of the point of a link at `distance`, (x, y, z) in its frame."""
        turn, origin = self._frames(q)[body]
        return origin + ca.mtimes(turn, distance)

    def sensors(self, q, v):
        """Positions, and rates where they are measured."""
        read = dict(zip(self.outputs, ca.vertsplit(q), strict=False))
        if self.rates:
            read |= dict(zip(self.outputs[len(self.coordinates) :], ca.vertsplit(v), strict=True))
        return read

    def recursion(self, q, v, a, p: Symbols, up, loads=()):
        """(CRB) and (NE)."""
        return self.mass_matrix(q, p, loads), self.inverse_dynamics(q, v, a, p, up, loads)

    def inverse_dynamics(self, q, v, a, p: Symbols, up, loads: Sequence[PointMass] = ()):
        """Forces that an acceleration takes, by (NE), from the base out and back."""
        to_tree, _ = self._tree
        placed, place = self._placed(q), self._order
        v, a = ca.mtimes(to_tree, v), ca.mtimes(to_tree, a)
        still = ca.SX.zeros(3)
        motion = {self.description.root: (still, still, up * p['gravity'])}
        for joint in self.description.joints:
            w, dw, acceleration = motion[joint.parent]
            turn, origin = placed[joint.name]
            acceleration = acceleration + ca.cross(dw, origin) + ca.cross(w, ca.cross(w, origin))
            w, dw, acceleration = (ca.mtimes(turn.T, x) for x in (w, dw, acceleration))
            if joint.name in place:
                k, axis = place[joint.name], ca.DM(joint.axis)
                if joint.slides:
                    acceleration += axis * a[k] + 2 * ca.cross(w, axis) * v[k]
                else:
                    dw = dw + ca.cross(w, axis) * v[k] + axis * a[k]
                    w = w + axis * v[k]
            motion[joint.child] = w, dw, acceleration
        needs = dict.fromkeys(self.description.links, (still, still))
        masses = self._loaded(p, loads)
        needed = [ca.SX(0)] * len(self.moving)
        for joint in reversed(self.description.joints):
            force, moment = needs[joint.child]
            if joint.child in masses:
                m, h, inertia = masses[joint.child]
                w, dw, acceleration = motion[joint.child]
                force = force + m * acceleration + ca.cross(dw, h) + ca.cross(w, ca.cross(w, h))
                moment = (
                    moment
                    + ca.mtimes(inertia, dw)
                    + ca.cross(w, ca.mtimes(inertia, w))
                    + ca.cross(h, acceleration)
                )
            if joint.name in place:
                needed[place[joint.name]] = ca.dot(
                    ca.DM(joint.axis), force if joint.slides else moment
                )
            turn, origin = placed[joint.name]
            force, moment = ca.mtimes(turn, force), ca.mtimes(turn, moment)
            f, n = needs[joint.parent]
            needs[joint.parent] = f + force, n + moment + ca.cross(origin, force)
        return ca.mtimes(to_tree.T, ca.vertcat(*needed))

    def mass_matrix(self, q, p: Symbols, loads: Sequence[PointMass] = ()):
        """M(q) by (CRB): each joint moves all that it carries, as one body."""
        to_tree, _ = self._tree
        placed, place = self._placed(q), self._order
        carried = dict.fromkeys(self.description.links, _nothing()) | self._loaded(p, loads)
        matrix = ca.SX.zeros(len(self.moving), len(self.moving))
        above = {joint.child: joint for joint in self.description.joints}
        for joint in reversed(self.description.joints):
            m, h, inertia = carried[joint.child]
            if joint.name in place:
                k, axis = place[joint.name], ca.DM(joint.axis)
                if joint.slides:
                    force, moment = axis * m, ca.cross(h, axis)
                else:
                    force, moment = ca.cross(axis, h), ca.mtimes(inertia, axis)
                matrix[k, k] = ca.dot(axis, force if joint.slides else moment)
                down = joint
                while down.parent in above:
                    turn, origin = placed[down.name]
                    force, moment = ca.mtimes(turn, force), ca.mtimes(turn, moment)
                    moment = moment + ca.cross(origin, force)
                    down = above[down.parent]
                    if down.name in place:
                        axis = ca.DM(down.axis)
                        entry = ca.dot(axis, force if down.slides else moment)
                        matrix[k, place[down.name]] = matrix[place[down.name], k] = entry
            turn, origin = placed[joint.name]
            m0, h0, inertia0 = carried[joint.parent]
            moved = ca.mtimes(turn, h)
            arm, moment_arm = ca.skew(origin), ca.skew(moved)
            carried[joint.parent] = (
                m0 + m,
                h0 + moved + m * origin,
                inertia0
                + ca.mtimes([turn, inertia, turn.T])
                - m * ca.mtimes(arm, arm)
                - ca.mtimes(arm, moment_arm)
                - ca.mtimes(moment_arm, arm),
            )
        return ca.mtimes([to_tree.T, matrix, to_tree])

    def masses(self, p: Symbols) -> dict[str, Mass]:
        """Link -> what it weighs, with all that is fixed to it."""
        return {j.child: b.symbols(p) for j, b in zip(self.moving, self._bodies, strict=True)}

    def _loaded(self, p: Symbols, loads: Sequence[PointMass]) -> dict[str, Mass]:
        found, homes = self.masses(p), _homes(self.description)
        for load in loads:
            body, turn, origin = homes[load.body]
            place = ca.DM(origin) + ca.mtimes(ca.DM(turn), load.place)
            m, h, inertia = found.get(body, _nothing())
            arm = ca.skew(place)
            found[body] = (
                m + load.mass, h + load.mass * place, inertia - load.mass * ca.mtimes(arm, arm)
            )  # fmt: skip
        return found

    def joints_to(self, body: str) -> tuple[str, ...]:
        """Joints that move a body, the one at the base first; of those that follow their leaders.

        Args:
            body: Of `bodies`.
        """
        above = {joint.child: joint for joint in self.description.joints}
        found: list[str] = []
        while body in above:
            joint = above[body]
            if joint.kind != 'fixed':
                found.append(joint.mimic[0] if joint.mimic else joint.name)
            body = joint.parent
        return tuple(dict.fromkeys(reversed(found)))

    def inertials(
        self, values, given: RobotDescription | None = None
    ) -> dict[str, Inertial | None]:
        """What each body weighs by these parameters: name of its link -> inertia of all that is
        fixed to that link, in its frame; None of links that are fixed to it.

        Args:
            values: Name -> value.
            given: Where joints move that are held here: what hangs on those keeps its weight
                there, which is taken off the body.

        Raises:
            ModelError: no body is left once that is taken off.
        """  # noqa: D205
        given = given or self.description
        found: dict[str, Inertial | None] = {
            joint.child: body.inertial(values)
            for joint, body in zip(self.moving, self._bodies, strict=True)
            if body.mass > 0
        }
        there = _homes(given)
        off: dict[str, np.ndarray] = {}
        for link, (body, turn, origin) in _homes(self.description).items():
            part = given.inertials.get(link)
            if part is None or link == body:
                continue
            if there[link][0] == body:
                found[link] = None
            else:
                off[body] = off.get(body, np.zeros((4, 4))) + _moments(part, link, turn, origin)
        for body, parts in off.items():
            found[body] = _without(found[body], parts, body)
        return found

    @cached_property
    def _tree(self) -> tuple[ca.DM, ca.DM]:
        """Positions of all joints that move, those that follow as well: T q + offset."""
        free = {name: k for k, name in enumerate(self.coordinates)}
        follow, offset = np.zeros((len(self.moving), len(free))), np.zeros(len(self.moving))
        for k, joint in enumerate(self.moving):
            leader, ratio, offset[k] = joint.mimic or (joint.name, 1.0, 0.0)
            follow[k, free[leader]] = ratio
        return ca.DM(follow), ca.DM(offset)

    @cached_property
    def _order(self) -> dict[str, int]:
        """Where each joint that moves stands among those that do."""
        return {joint.name: k for k, joint in enumerate(self.moving)}

    def _placed(self, q) -> dict[str, tuple[ca.SX, ca.SX]]:
        """Joint -> orientation, (3, 3), and origin, (3, 1), of its child in its parent's frame."""
        to_tree, offset = self._tree
        positions = ca.vertsplit(ca.mtimes(to_tree, q) + offset)
        return {
            joint.name: _child_frame(
                joint, positions[self._order[joint.name]] if joint.kind != 'fixed' else None
            )
            for joint in self.description.joints
        }

    def _frames(self, q) -> dict[str, tuple[ca.SX, ca.SX]]:
        """Link -> its orientation, shape (3, 3), and origin, (3, 1), in the root's frame."""
        placed = self._placed(q)
        frames = {self.description.root: (ca.SX.eye(3), ca.SX.zeros(3))}
        for joint in self.description.joints:
            turn, origin = placed[joint.name]
            before, at = frames[joint.parent]
            frames[joint.child] = ca.mtimes(before, turn), at + ca.mtimes(before, origin)
        return frames

    def carried(self, body: str) -> tuple[float, tuple[float, float, float]]:
        """Mass of what moves with the joint before a body, kg, and its centre, m.

        Args:
            body: Of `bodies`; the centre is in its frame. That of a tip, which is not on the
                joint's axis, is taken for the centre itself.
        """
        joint = self.moving[self.bodies.index(body)]
        own = self._bodies[self.bodies.index(body)]
        x, y, z = map(float, own.centre) if joint.child == body else (0.0, 0.0, 0.0)
        return own.mass, (x, y, z)

    def _determined(self) -> tuple[Parameter, ...]:
        """The parameters; those that no motion of this robot shows are not free.

        The dynamics are linear in the inertias of the bodies, in fewer combinations of them (base
        parameters) than there are. Of the numbers here a set is left free, each chosen as the one
        that the motions show best beside those before it, that spans what all of them do. Gravity
        is along -z there: what only another mounting would show is left alone.
        """
        effect = self._by_parameters(np.random.default_rng(0))
        count = effect.shape[1]
        remaining, chosen = effect.copy(), []
        largest = np.linalg.norm(effect, axis=0).max(initial=0.0)
        for _ in range(count):
            size = np.linalg.norm(remaining, axis=0)
            best = int(np.argmax(size))
            if not size[best] > DETERMINED * largest:
                break
            chosen.append(best)
            unit = remaining[:, best] / size[best]
            remaining -= np.outer(unit, unit @ remaining)
        return tuple(
            p if k in chosen or k >= count else replace(p, free=False, belief=False)
            for k, p in enumerate(self.parameters)
        )

    def _by_parameters(self, random: np.random.Generator) -> np.ndarray:
        """Change of torques at some motions with each number: (motions times joints, numbers)."""
        n = len(self.coordinates)
        p = ca.SX.sym('p', len(self.parameters))
        names = [parameter.name for parameter in self.parameters]
        symbols = dict(zip(names, ca.vertsplit(p), strict=True))
        q, v, a = (ca.SX.sym(name, n) for name in 'qva')
        torque = self.inverse_dynamics(q, v, a, symbols, self.up(Setup()))
        numbers = len(self.parameters) - 1
        by = ca.Function('by', [q, v, a, p], [ca.jacobian(torque, p[:numbers])])
        nominal = np.array([parameter.default for parameter in self.parameters])
        rows = []
        for _ in range(PROBES):
            motion = (random.uniform(-3, 3, n), random.normal(0, 2, n), random.normal(0, 5, n))
            rows.append(np.asarray(by(*motion, nominal)))
        return np.vstack(rows)


@lru_cache(maxsize=16)
def _known(
    text: str,
    driven: tuple[str, ...],
    rates: bool,
    couplings: tuple[tuple[str, tuple[tuple[str, float], ...]], ...],
) -> Urdf:
    """The robot of a URDF, once a process."""
    return Urdf(parse(text), driven, rates, {name: dict(own) for name, own in couplings})


class _Body:
    """The mass distribution of what moves with one joint.

    Attributes:
        link: Name of the joint's child link.
        mass: Mass in the URDF, kg.
        centre: Its centre in the frame of the child link, m, shape (3,).
        gyration: G of (BODY): Cholesky factor of the second moment of a unit mass, m, (3, 3).
    """

    def __init__(self, link: str, mass: float, centre: np.ndarray, second: np.ndarray):
        self.link, self.mass, self.centre = link, mass, centre
        self.gyration = np.linalg.cholesky(second) if mass else np.zeros((3, 3))

    def parameters(self) -> Iterable[Parameter]:
        """Its numbers, all at what the URDF says; none of a body without mass."""
        if not self.mass:
            return
        for name, meaning, neutral, (lower, upper) in NUMBERS:
            yield Parameter(
                f'{self.link}_{name}', '1', f'{self.link}: {meaning}', lower, upper, neutral,
                scale=BELIEF, logarithmic=neutral == 1.0, belief=True,
            )  # fmt: skip

    def symbols(self, p) -> Mass:
        """All that it weighs."""
        if not self.mass:
            return _nothing()
        x = {name: p[f'{self.link}_{name}'] for name, *_ in NUMBERS}
        mass = self.mass * x['mass']
        factor = ca.DM(self.gyration)
        centre = ca.DM(self.centre) + ca.mtimes(
            factor, ca.vertcat(x['shift_x'], x['shift_y'], x['shift_z'])
        )
        stretch = ca.vertcat(
            ca.horzcat(x['stretch_x'], x['shear_xy'], x['shear_xz']),
            ca.horzcat(0, x['stretch_y'], x['shear_yz']),
            ca.horzcat(0, 0, x['stretch_z']),
        )
        image = ca.mtimes(factor, stretch)
        second = mass * (ca.mtimes(image, image.T) + ca.mtimes(centre, centre.T))
        return mass, mass * centre, ca.trace(second) * ca.DM.eye(3) - second

    def inertial(self, values) -> Inertial:
        """The same as numbers, about the centre of mass."""
        m, h, about_origin = (np.asarray(ca.DM(x)) for x in self.symbols(values))
        mass, h = float(m[0, 0]), h.ravel()
        x, y, z = [float(part) for part in h / mass]
        arm = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return Inertial(mass, (x, y, z), _entries(about_origin + mass * arm @ arm))


def _nothing() -> Mass:
    return ca.SX(0), ca.SX.zeros(3), ca.SX.zeros(3, 3)


def _child_frame(joint: Joint, position: ca.SX | None) -> tuple[ca.SX, ca.SX]:
    """Orientation and origin of a joint's child link in its parent's frame."""
    turn, origin = ca.SX(ca.DM(rotation(joint.rpy))), ca.SX(ca.DM(joint.xyz))
    if position is None:
        return turn, origin
    axis = ca.DM(joint.axis)
    if joint.slides:
        return turn, origin + ca.mtimes(turn, axis * position)
    cross = ca.skew(axis)
    about = (
        ca.DM.eye(3) * ca.cos(position)
        + (1 - ca.cos(position)) * ca.mtimes(axis, axis.T)
        + ca.sin(position) * cross
    )
    return ca.mtimes(turn, about), origin


def _place(description: RobotDescription, joint: Joint) -> str:
    """Link by which what a joint carries is named: the tip, where one hangs firmly on its end."""
    link = joint.child
    while True:
        behind = [other for other in description.joints if other.parent == link]
        if len(behind) != 1 or behind[0].kind != 'fixed':
            return joint.child if behind else link
        link = behind[0].child


def _homes(description: RobotDescription) -> dict[str, tuple[str, np.ndarray, np.ndarray]]:
    """Link that moves -> body that it belongs to, and its orientation and origin in that frame."""
    home: dict[str, tuple[str, np.ndarray, np.ndarray]] = {}
    for joint in description.joints:
        if joint.kind != 'fixed':
            home[joint.child] = (joint.child, np.eye(3), np.zeros(3))
        elif joint.parent in home:
            body, turn, origin = home[joint.parent]
            here = np.array(rotation(joint.rpy))
            home[joint.child] = (body, turn @ here, origin + turn @ np.array(joint.xyz))
    return home


def _bodies(description: RobotDescription) -> tuple[_Body, ...]:
    """What each joint that moves carries, with the links that are fixed to it."""
    # Body -> sum over its mass of (x, 1)(x, 1)', in its frame.
    sums = {joint.child: np.zeros((4, 4)) for joint in description.moving}
    for link, (body, turn, origin) in _homes(description).items():
        found = description.inertials.get(link)
        if found is not None:
            sums[body] += _moments(
                found, f'URDF {description.name!r}: link {link!r}', turn, origin
            )
    made = []
    for joint in description.moving:
        total = sums[joint.child]
        mass = float(total[3, 3])
        if not mass:
            made.append(_Body(joint.child, 0.0, np.zeros(3), np.eye(3)))
            continue
        c = total[:3, 3] / mass
        made.append(_Body(joint.child, mass, c, total[:3, :3] / mass - np.outer(c, c)))
    return tuple(made)


def nearest_real(
    description: RobotDescription,
) -> tuple[RobotDescription, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """A robot of real bodies, where a URDF gives links inertias that no body has.

    The largest principal moment of such a link stays; the others grow to what a thin body has.

    Returns:
        The description, and of each link that is changed its principal moments before and after,
        kg m^2.
    """
    inertials, changed = dict(description.inertials), {}
    for link in _homes(description):
        found = inertials.get(link)
        if found is None:
            continue
        sizes, axes = _along_axes(found)
        if not np.isfinite(sizes).all() or _real(sizes):
            continue
        second = _thickened(sizes, axes, found.mass)
        tensor = np.trace(second) * np.eye(3) - second
        inertials[link] = replace(found, inertia=_entries(tensor))
        changed[link] = np.linalg.eigvalsh(_tensor(found)), np.linalg.eigvalsh(tensor)
    return replace(description, inertials=inertials), changed


def _moments(found: Inertial, where: str, turn: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Sum over a link's mass of (x, 1)(x, 1)', in a frame in which it is so turned and placed."""
    c = origin + turn @ np.array(found.centre)
    sums = np.empty((4, 4))
    sums[:3, :3] = turn @ _second_moment(found, where) @ turn.T + found.mass * np.outer(c, c)
    sums[:3, 3] = sums[3, :3] = found.mass * c
    sums[3, 3] = found.mass
    return sums


def _without(whole: Inertial | None, parts: np.ndarray, link: str) -> Inertial:
    """What is left of a body of which parts, sums of `_moments`, are taken off."""
    left = -parts
    if whole is not None:
        left = left + _moments(whole, link, np.eye(3), np.zeros(3))
    mass = float(left[3, 3])
    if mass > 0:
        x, y, z = (float(at) for at in left[:3, 3] / mass)
        second = left[:3, :3] - np.outer(left[:3, 3], left[:3, 3]) / mass
        if _real(np.linalg.eigvalsh(second)):
            return Inertial(mass, (x, y, z), _entries(np.trace(second) * np.eye(3) - second))
    raise ModelError(
        f'link {link!r}: what was identified of it is less than what hangs on joints that were '
        f'held: {parts[3, 3]:.4g} of {mass + parts[3, 3]:.4g} kg; that cannot be written apart'
    )


def _second_moment(found: Inertial, where: str) -> np.ndarray:
    """Of a link about its centre, kg m^2, shape (3, 3).

    Points and thin rods, which have none along some axis, get THINNEST.

    Raises:
        ModelError: if no body has this inertia.
    """
    sizes, axes = _along_axes(found)
    if not np.isfinite(sizes).all() or not _real(sizes):
        least = np.linalg.eigvalsh(_tensor(found))
        raise ModelError(
            f'{where}: no body has the inertia with principal moments {least[0]:.3g}, '
            f'{least[1]:.3g}, {least[2]:.3g} kg m^2; all must be positive, and none above the sum '
            'of the others'
        )
    return _thickened(sizes, axes, found.mass)


def _entries(tensor: np.ndarray) -> tuple[float, float, float, float, float, float]:
    """What `Inertial` has of an inertia, shape (3, 3)."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor.tolist()
    return xx, yy, zz, xy, xz, yz


def _tensor(found: Inertial) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = found.inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def _along_axes(found: Inertial) -> tuple[np.ndarray, np.ndarray]:
    """Second moments along the principal axes, kg m^2, the smallest first, and these axes."""
    tensor = _tensor(found)
    return np.linalg.eigh(np.trace(tensor) / 2 * np.eye(3) - tensor)


def _real(sizes: np.ndarray) -> bool:
    """Whether a body has these second moments, the smallest first, but for rounding."""
    return bool(sizes[0] >= -ROUNDED * abs(sizes[-1]))


def _thickened(sizes: np.ndarray, axes: np.ndarray, mass: float) -> np.ndarray:
    """Second moment of a body that is at least THINNEST along each axis."""
    return (axes * np.maximum(sizes, mass * THINNEST**2)) @ axes.T
