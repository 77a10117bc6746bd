"""A search that has not begun, for tests of its stages."""

import numpy as np

from cg_dynamics.rig import Setup
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.result import Options
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare


def swings_of(machine, count):
    """Records of a machine's swinging legs."""
    return [
        rehearse(f'r{k}', machine, Setup(fixture='inner_fixed'), [0.1, 0.0],
                 [lambda t, k=k: 3 * np.sin((3 + k) * t)], 2.0, 0.004, k)
        for k in range(count)
    ]  # fmt: skip


def search_for(nominal, machine):
    """A workspace with two such records, one of them held out."""
    train, held = ([data_set] for data_set in prepare(nominal, swings_of(machine, 2)))
    return Workspace(nominal, train, held, Options(workers=1), lambda *_: None, None, Deadline())
