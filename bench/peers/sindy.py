"""Sparse regression in the manner of SINDy, with pysindy's optimiser and our library of effects.

What the nominal model leaves of the measured motion (measured_motion.py) is regressed sparsely on
what each effect of our library would add along that motion. Shapes and frequencies enter
as one column for each of their starts, phases as a sine and a cosine; effects with states of their
own are simulated along the motion. pysindy's FROLS chooses the terms; its STLSQ, the best of a
path of thresholds, chose the same ones on the seeds on which all was tuned.

The parameters of rigid body and friction are either identified beforehand and again in the same
regression, free of the sparsity, with the file's tolerances as a ridge; or they are told. The
structure that is chosen is fitted once more by its simulation error, from where the regression
puts it, so that its held-out error is that of the structure.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pysindy

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.identification.unknowns import unknowns_of
from peers import Answer, Case, effects_for
from peers.grey_box import held_error, identify_nominal, minimise
from peers.measured_motion import Measured

MOST_TERMS = 4
MOST_STARTS = 60
WORTH_A_TERM = 0.005  # relative fall of the held-out squared residual
ACCEPTED = 0.02  # what the terms must bring together; healthy robots show 0.001
ALIKE = 0.999  # cosine of two columns that say the same
NUDGE = 0.01  # of a tolerance, for derivatives


def starts(name: str) -> list[dict[str, float]]:
    """Each combination of an effect's starts; a phase is tried as sine and cosine."""
    grids = []
    for p in LIBRARY[name].parameters:
        values = p.starts if p.free and p.starts else (p.default,)
        if p.name == 'phase':
            values = (0.0, np.pi / 2)
        grids.append([(p.name, v) for v in values])
    return [dict(point) for point in itertools.islice(itertools.product(*grids), MOST_STARTS)]


@dataclass(frozen=True)
class Term:
    """An effect at one of its starts, and what it would add to the training rows."""

    name: str
    at: str | None
    start: Mapping[str, float]
    column: np.ndarray

    @property
    def one_way(self) -> int:
        """1 for an effect that cannot be negative, else 0."""
        declared = LIBRARY[self.name].parameters
        ways = [p.neutral == np.inf or p.lower >= 0.0 for p in declared if p.neutral is not None]
        return int(any(ways))

    def added_to(self, model: Model, size: float = 1.0) -> Model:
        """The model with the effect, `size` times that of the start."""
        values = dict(self.start)
        for p in LIBRARY[self.name].parameters:
            # What vanishes at zero grows with the size; what vanishes at infinity falls.
            if p.neutral == 0.0:
                values[p.name] = float(np.clip(size * values[p.name], p.lower, p.upper))
            elif p.neutral == np.inf and size > 0:
                values[p.name] = float(np.clip(values[p.name] / size, p.lower, p.upper))
        return model.with_effect(self.name, self.at, **values)


def stacked(model: Model, data_sets: list[Measured]) -> np.ndarray:
    """Rows of several data sets."""
    return np.concatenate([data_set.rows(model) for data_set in data_sets])


def terms_of(case: Case, base: Model, train: list[Measured], target: np.ndarray) -> list[Term]:
    """The library of candidate functions along the training data sets."""
    found = []
    for name, at in effects_for(case):
        for start in starts(name):
            model = base.with_effect(name, at, **start)
            column = target - stacked(model, train)
            if np.isfinite(column).all() and np.linalg.norm(column) > 1:
                found.append(Term(name, at, start, column))
    return distinct(found)


def distinct(terms: list[Term]) -> list[Term]:
    """Without starts at which an effect is but a simpler one: a motor limited to nothing."""
    kept: list[Term] = []
    for term in sorted(terms, key=lambda t: len(LIBRARY[t.name].parameters)):
        others = [other for other in kept if other.name != term.name]
        if all(abs(cosine(term.column, other.column)) < ALIKE for other in others):
            kept.append(term)
    return kept


def cosine(a: np.ndarray, b: np.ndarray) -> float:
    """Of the angle between two columns."""
    return float(a @ b / (np.linalg.norm(a) * np.linalg.norm(b)))


def name_cause_told(case: Case) -> Answer:
    """As `name_cause`, but rigid body and friction are those of the machine."""
    return name_cause(case, told=True)


def name_cause(case: Case, told: bool = False) -> Answer:
    """Regress, choose the number of terms on held-out rows, name the term that explains most."""
    body = case.nominal.mechanism
    train = [Measured(body, data_set) for data_set in case.train]
    held = [Measured(body, data_set) for data_set in case.held]
    base = case.machine if told else case.nominal.with_values(identify_nominal(case).values)
    target, judged = stacked(base, train), stacked(base, held)
    terms = terms_of(case, base, train, target)
    beliefs = [] if told else [u for u in unknowns_of(case.nominal) if np.isfinite(u.tolerance)]

    def by_priors(data_sets, rows):
        moved = [base.with_values({u.name: base.values[u.name] + NUDGE * u.tolerance})
                 for u in beliefs]  # fmt: skip
        columns = [(rows - stacked(model, data_sets)) / NUDGE for model in moved]
        return np.column_stack(columns) if columns else np.zeros((len(rows), 0))

    # What the believed parameters can explain, within their tolerances, is taken out first.
    lumps = by_priors(train, target)
    k = lumps.shape[1]
    q, r = np.linalg.qr(np.vstack([lumps, np.eye(k)]))
    wide = np.column_stack([*(term.column for term in terms), target])
    wide = np.vstack([wide, np.zeros((k, wide.shape[1]))])
    shares = q.T @ wide
    # Least squares knows its columns by their triangle alone.
    triangle = np.linalg.qr(wide - q @ shares, mode='r')
    library, left = triangle[:, :-1], triangle[:, -1]
    able = [i for i, term in enumerate(terms) if term.one_way * (library[:, i] @ left) >= 0]
    terms, library, shares = [terms[i] for i in able], library[:, able], shares[:, [*able, -1]]
    norms = np.linalg.norm(library, axis=0)
    optimiser = pysindy.FROLS(max_iter=MOST_TERMS, alpha=1e-10)
    optimiser.fit(library / norms, left[:, None])
    # Its own choice of the number of terms takes the step that explained least: we choose.
    path = [coefficients.ravel() / norms for coefficients in optimiser.history_[1:]]
    judged_lumps = by_priors(held, judged)
    before = float(judged @ judged)
    best = (0.0, None, None)
    for sizes in path:
        moves = np.linalg.solve(r, shares[:, -1] - shares[:, :-1] @ sizes) if k else np.zeros(0)
        rows = judged - judged_lumps @ moves
        for i in np.flatnonzero(sizes):
            rows = rows - sizes[i] * (judged - stacked(terms[i].added_to(base), held))
        fall = 1 - float(rows @ rows) / before
        if fall > best[0] + WORTH_A_TERM:
            best = (fall, sizes, moves)
    fall, sizes, moves = best
    if fall < ACCEPTED:
        return Answer('', held_error(base, case.held), fall)
    chosen = [i for i in np.flatnonzero(sizes)]
    weight = {}
    for name in {terms[i].name for i in chosen}:
        without = [i for i in chosen if terms[i].name != name]
        rest = left - library[:, without] @ np.linalg.lstsq(library[:, without], left)[0] \
            if without else left  # fmt: skip
        weight[name] = float(rest @ rest)
    cause = max(weight, key=weight.__getitem__)
    start = {u.name: float(np.clip(base.values[u.name] + m * u.tolerance, u.lower, u.upper))
             for u, m in zip(beliefs, moves, strict=True)}  # fmt: skip
    model = extended(base if told else case.nominal, terms, sizes)
    found = minimise(model, case.train, start)
    return Answer(cause, held_error(model.with_values(found.values), case.held), fall)


def extended(model: Model, terms: list[Term], sizes: np.ndarray) -> Model:
    """The model with the chosen terms; a sine and a cosine are one ripple."""
    largest: dict[tuple, tuple] = {}
    ripples: dict[tuple, complex] = {}
    for i in np.flatnonzero(sizes):
        term = terms[i]
        key = (term.name, term.at)
        if abs(sizes[i]) * np.linalg.norm(term.column) > largest.get(key, (0.0,))[0]:
            largest[key] = (abs(sizes[i]) * np.linalg.norm(term.column), term, float(sizes[i]))
    for i in np.flatnonzero(sizes):
        term = terms[i]
        _, main, _ = largest[term.name, term.at]
        same = {k: v for k, v in term.start.items() if k != 'phase'}
        if 'phase' in term.start and same == {k: main.start[k] for k in same}:
            key = (term.name, term.at)
            ripples[key] = ripples.get(key, 0) + sizes[i] * np.exp(1j * term.start['phase'])
    for key, (_, term, size) in largest.items():
        if key in ripples:
            term = replace(term, start={**term.start, 'phase': float(np.angle(ripples[key]))})
            size = float(abs(ripples[key]))
        model = term.added_to(model, size)
    return model
