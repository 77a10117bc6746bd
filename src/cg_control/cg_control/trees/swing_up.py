"""Motions of a machine without feet onto a tree: what `extension.py` is to a robot that walks.

    min int (1 + effort u^2) dt,  dx/dt = f(x, u),  |u| <= limit,  x(0) = x,  x(T) = 0   (SWING)

A joint without stops comes upright after any number of whole turns: they are *turns* of the
state, and the cheapest of the motions that are found counts. T is free. (SWING) becomes a program
by (HS) of trajectories.md, compressed, and IPOPT solves it.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_control.balancing.lqr import lqr
from cg_control.following.nodes import Nodes
from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.trajectory import Phase, Trajectory
from cg_control.trajectories.tvlqr import riccati
from cg_control.trees.extension import FUNNEL
from cg_control.trees.growth import Branch
from cg_control.trees.tree import Tree
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.linearise import linearise
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import compile_model

STANCE = STANCES[0]  # what has no feet stands on the first leg of every tree
REACH = 40.0  # rad and rad/s: bounds of every state
DIRECTIONS, SHELLS = 2000, 100  # in which the goal region is looked at


@dataclass(frozen=True)
class SwingOptions:
    """How motions are planned and followed.

    Attributes:
        Q: Weight of a deviation that the gains are designed for, shape (nx, nx).
        R: Weight of the torque there, 1/(N m)^2.
        effort: Weight of u^2 in the plan, 1/(N m)^2.
        spare: Share of the torque limit that a plan leaves to the feedback.
        intervals: Of a motion.
        durations: Shortest and longest motion, s.
        guesses: Durations from which a solve starts, s.
        iterations: Of a solve.
    """

    Q: np.ndarray
    R: float
    effort: float = 0.1
    spare: float = 0.15
    intervals: int = 40
    durations: tuple[float, float] = (0.1, 6.0)
    guesses: tuple[float, ...] = (1.0, 2.5, 4.5)
    iterations: int = 150


def upright_root(model: Model, options: SwingOptions) -> Tree:
    """A tree without branches: the machine upright at zero, held by its regulator.

    The goal region is the largest ellipsoid x'S x <= c of the cost to go in which, as far as
    sampled directions tell, the regulator's torque is within the limit and x'S x falls.

    Args:
        model: A machine without feet, with one input.
        options: Weights.

    Raises:
        ValueError: The regulator holds nothing.
    """
    plant = planning_model(model)
    compiled, p = compile_model(plant, Setup()), parameter_vector(plant, Setup())
    linear = linearise(plant, Setup(), np.zeros(compiled.nx), np.zeros(1))
    R = np.array([[options.R]])
    followed = lqr(linear.A, linear.B, options.Q, R)
    light = lqr(linear.A, linear.B, FUNNEL * options.Q, R)
    K, S = followed.K[0], followed.S
    # max |K x| on x'S x = c is sqrt(c K S^-1 K').
    largest = model.torque_limit**2 / (K @ np.linalg.solve(S, K))
    direction = np.random.default_rng(0).standard_normal((compiled.nx, DIRECTIONS))
    direction = np.linalg.solve(np.linalg.cholesky(S).T, direction)
    direction /= np.sqrt((direction * (S @ direction)).sum(axis=0))
    level = 0.0
    for share in np.arange(1, SHELLS + 1) / SHELLS:
        x = np.sqrt(share * largest) * direction
        falls = (S @ x) * np.asarray(compiled.f(x, -K[None] @ x, p))
        if not falls.sum(axis=0).max() < 0:
            break
        level = share * largest
    if level == 0.0:
        raise ValueError(f'the regulator of {model.name!r} holds no region about upright')
    goal = np.full((len(STANCES), *S.shape), np.nan)
    goal[0] = S / level
    root = Nodes.root(STANCE, K, S, model.hash, funnel=light.S)
    return Tree(root, goal, {'model': model.name})


def whole_turns(joint: int, nx: int, most: int) -> np.ndarray:
    """Displacements by whole turns of one joint, zero left out: shape (2 most, nx), rad.

    Args:
        joint: Its index among the states.
        nx: How many states there are.
        most: Turns to either side.
    """
    turns = np.zeros((2 * most, nx))
    turns[:, joint] = 2 * np.pi * np.array([s * k for k in range(1, most + 1) for s in (-1, 1)])
    return turns


class SwingUp:
    """Plans from states to upright. Called with (nodes, legs, states), as `Grower` does.

    Args:
        model: A machine without feet, with one input.
        options: How.
        turns: Displacements under which a state is the same, as those of `Lookup`, shape (m, nx).
    """

    def __init__(self, model: Model, options: SwingOptions, turns: np.ndarray | None = None):
        self.model, self.options = model, options
        self._plant = planning_model(model)
        compiled = compile_model(self._plant, Setup())
        if compiled.nu != 1:
            raise ValueError(f'{model.name!r} has {compiled.nu} inputs; one is allowed')
        self._nx = compiled.nx
        none = np.zeros((1, self._nx))
        self._turns = none if turns is None else np.vstack([none, turns])
        e, p = compiled.equations, parameter_vector(self._plant, Setup())
        self._rates = ca.Function('f', [e.x, e.u], [ca.substitute(e.rates, e.p, p)])
        self._solver = self._program()

    def __call__(self, nodes: Nodes, legs: np.ndarray, x: np.ndarray) -> list[Branch | None]:
        """For each state a branch that ends at the root; None if no motion is found."""
        return [self._branch(nodes, state) for state in x]

    def _branch(self, nodes: Nodes, x: np.ndarray) -> Branch | None:
        motion = self.plan(x)
        return None if motion is None else self._stabilised(motion, nodes)

    def plan(self, x: np.ndarray) -> Trajectory | None:
        """The cheapest motion that is found from any turn of a state (nx,); None: none is."""
        found = [
            self._solved(x + turn, duration)
            for turn in self._turns for duration in self.options.guesses
        ]  # fmt: skip
        return min(
            (motion for motion in found if motion is not None),
            key=lambda motion: motion.provenance['cost'], default=None,
        )  # fmt: skip

    def _program(self) -> ca.Function:
        """(SWING): the variables are knots (x, u), side by side, and T."""
        n, nx, f = self.options.intervals, self._nx, self._rates
        x, u, T = ca.SX.sym('x', nx, n + 1), ca.SX.sym('u', 1, n + 1), ca.SX.sym('T')
        h = T / n
        rows, cost = [], T
        rates = [f(x[:, k], u[k]) for k in range(n + 1)]
        for k in range(n):
            middle = (x[:, k] + x[:, k + 1]) / 2 + h / 8 * (rates[k] - rates[k + 1])
            torque = (u[k] + u[k + 1]) / 2
            mean = (rates[k] + 4 * f(middle, torque) + rates[k + 1]) / 6
            rows.append(x[:, k + 1] - x[:, k] - h * mean)
            squares = (u[k] ** 2 + 4 * torque**2 + u[k + 1] ** 2) / 6
            cost += self.options.effort * h * squares
        z = ca.vertcat(ca.vec(ca.vertcat(x, u)), T)
        return ca.nlpsol(
            'swing', 'ipopt', {'x': z, 'f': cost, 'g': ca.vertcat(*rows)},
            {'print_time': False, 'ipopt': {
                'print_level': 0, 'sb': 'yes', 'max_iter': self.options.iterations, 'tol': 1e-7,
            }},
        )  # fmt: skip

    def _solved(self, x: np.ndarray, duration: float) -> Trajectory | None:
        n, nx = self.options.intervals, self._nx
        limit = (1 - self.options.spare) * self.model.torque_limit
        high = np.tile(np.append(np.full(nx, REACH), limit), (n + 1, 1))
        low = -high
        low[0, :nx] = high[0, :nx] = x
        low[-1, :nx] = high[-1, :nx] = 0.0
        guess = np.zeros((n + 1, nx + 1))
        guess[:, :nx] = (1 - np.linspace(0.0, 1.0, n + 1)[:, None]) * x
        shortest, longest = self.options.durations
        try:
            found = self._solver(
                x0=np.append(guess, duration), lbg=0.0, ubg=0.0,
                lbx=np.append(low, shortest), ubx=np.append(high, longest),
            )  # fmt: skip
        except RuntimeError:  # what the solver throws where it meets no number
            return None
        if not self._solver.stats()['success']:
            return None
        z = np.asarray(found['x']).ravel()
        knots = z[:-1].reshape(n + 1, nx + 1)
        states, torque = knots[:, :nx], knots[:, nx]
        rates = np.asarray(self._rates.map(n + 1)(states.T, torque[None])).T
        phase = Phase(STANCE, np.linspace(0.0, z[-1], n + 1), states, rates, torque)
        return Trajectory((phase,), self.model.hash, {'cost': float(found['f'])})

    def _stabilised(self, motion: Trajectory, nodes: Nodes) -> Branch:
        """With gains and funnels that end in those of the root."""
        (phase,), R = motion.phases, np.array([[self.options.R]])
        _, funnel = riccati(self._plant, phase, FUNNEL * self.options.Q, R, nodes.F[0])
        gains, S = riccati(self._plant, phase, self.options.Q, R, nodes.S[0])
        phase = Phase(phase.stance, phase.time, phase.states, phase.rates, phase.torque, gains, S)
        return Branch(motion.with_phases((phase,)), 0, funnels=(funnel,))
