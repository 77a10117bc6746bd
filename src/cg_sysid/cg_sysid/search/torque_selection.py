"""Which laws the torques of a robot lack: effects taken up while records held out gain by them.

    torque fit of the numbers -> score tests of all effects (torque_screening.py)
      -> torque fits of the best -> that which gains most is taken up, if records held out gain too
      -> friction and rotors at all other joints as well, if they gain by that
      -> again on top of these, until none does
      -> whole Stribeck curves where parts of one were taken up, if they gain by that
      -> two at once, where neither is worth it without the other
      -> in the place of friction, what is like it, if that does better
      -> again on top of these -> each asked whether the others do without it

A torque fit takes a second where one by simulation takes a minute, and does not mind which
controller kept the robot on its way. So an arm of six joints has an answer in a minute or two,
and a real one may have one at all. It is no diagnosis: smoothed torques know little of delays and
sensors, and what moves by itself, as a rotor behind a spring, is not asked. `diagnose` judges in
simulation what is found here.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.parallel import CarryOut, one_by_one
from cg_sysid.search.torque_alternatives import with_likes, with_stribeck_curve, with_two
from cg_sysid.search.torque_judging import MATERIAL, Judge, Law
from cg_sysid.search.torque_search import TorqueSearch, best_of

MOST = 32  # effects that are taken up


@dataclass(frozen=True)
class TorqueSelection:
    """What the torques say of a robot.

    Attributes:
        coordinates: Names of the robot's n coordinates.
        stated: Torque error of records held out over the torque that acted, by the file's numbers,
            shape (n,); NaN where nothing drives.
        identified: The same with the numbers that the torques say.
        extended: The same with the laws.
        laws: Effects that were taken up, in the order in which they were.
        turned_down: Others that were fitted on top of these and are not worth it, the best first.
        model: The model with them, and with the numbers that the torques of all records say.
    """

    coordinates: tuple[str, ...]
    stated: np.ndarray
    identified: np.ndarray
    extended: np.ndarray
    laws: tuple[Law, ...]
    turned_down: tuple[Law, ...]
    model: Model

    def shares(self, law: Law) -> dict[str, float]:
        """Coordinate -> share of its squared torque error that a law takes, if MATERIAL."""
        taken = zip(self.coordinates, law.taken, strict=True)
        return {name: float(share) for name, share in taken if share > MATERIAL}


def select(
    model: Model,
    train: Sequence[DataSet],
    held: Sequence[DataSet],
    names: Sequence[str] | None = None,
    carry_out: CarryOut = one_by_one,
) -> TorqueSelection:
    """Take up effects that the torques of a robot lack.

    Args:
        model: The nominal model, of a robot of a URDF.
        train: Whole records that are fitted.
        held: Whole records that judge.
        names: Effects, or labels of effects, that may be taken up; by default all of the library.
        carry_out: Who fits.

    Raises:
        IdentificationError: if the torques of these records say nothing of this model.
    """
    if not torque_error.can(model):
        raise IdentificationError(
            f'model {model.name!r}: torques are compared for a robot of a URDF with an encoder at '
            'every joint that moves, and without integral_control'
        )
    judge = Judge(train, held)
    search = TorqueSearch(judge, names, carry_out)
    plain = torque_error.without_states(model)
    bare = replace(plain, effects=())
    if names is not None and not search.candidates(bare):
        raise IdentificationError(
            f'torques alone cannot tell of {", ".join(names)}: they know little of sensors and '
            'delays, and nothing of pushes and of what moves by itself; use cg diagnose'
        )
    nominal = base = judge.fit(plain, {})
    laws: list[Law] = []
    while True:
        judged = search.on_top(base, laws)
        best = best_of(judged)
        if len(laws) >= MOST:
            break
        if best is None:
            found = (
                with_stribeck_curve(search, base, laws)
                or with_two(search, base, laws, judged)
                or with_likes(search, base, laws)
            )
            if found is None:
                break
            laws, base = found
            continue
        law, base = best
        more, base = search.at_other_joints(base)
        laws += [law, *more]
    base, laws = search.doubted(base, laws)
    # Who judged has no more say: the numbers are those of all records.
    every = Judge([*train, *held], held)
    final = every.fit(base.model, base.said.values)
    taken_up = {law.label for law in laws}
    laws = [
        replace(
            law, parameters=every.sizes(final, law.label),
            rivals=tuple(label for label in law.rivals if label not in taken_up),
        )
        for law in laws
    ]  # fmt: skip
    stated, identified, extended = (
        _relative(m, held) for m in (plain, nominal.standing, base.standing)
    )
    return TorqueSelection(
        tuple(model.mechanism.coordinates), stated, identified, extended, tuple(laws),
        tuple(law for law, _ in judged if law.reason), final.standing,
    )  # fmt: skip


def _relative(model: Model, data_sets: Sequence[DataSet]) -> np.ndarray:
    """Torque error of a model as it is over the torque that acted, shape (n,)."""
    found = torque_error.fit_by_torque(model, data_sets, only=())
    assert found is not None  # its errors are known
    return found.relative
