"""One small machine with a secret, recorded and diagnosed once for all tests of this package."""

import math

import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.checks.loading import load_bags
from cg_sysid.cli.diagnose import diagnosis_curves
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.provenance import provenance
from cg_sysid.records.bags import write_bag
from cg_sysid.report.facts import diagnosis_facts

BIAS = 0.8  # N m, hidden in the machine
EFFECTS = ('torque_bias', 'quadratic_friction')


@pytest.fixture(scope='session')
def model_file():
    return model_path('compass_gait_mit')


def swing(name, machine, seed, duration=3.0, sample_time=0.004):
    """The outer legs swing, the inner ones are fixed."""
    return rehearse(
        name,
        machine,
        Setup('inner', 'inner_fixed'),
        [0.25, 0.5],
        [lambda t: 6.0 * math.sin(2 * math.pi * (0.4 + 0.3 * seed + 0.2 * t) * t)],
        duration,
        sample_time,
        seed,
    )


@pytest.fixture(scope='session')
def bags(model_file, tmp_path_factory):
    """Two bags of a machine whose motor has a bias."""
    machine = Model.load(model_file).with_effect('torque_bias', bias=BIAS)
    folder = tmp_path_factory.mktemp('bags')
    return [write_bag(folder / f'swing_{k}', swing(f'swing_{k}', machine, k)) for k in (1, 2)]


@pytest.fixture(scope='session')
def loaded(bags, model_file):
    return load_bags(bags, model_file)


@pytest.fixture(scope='session')
def diagnosed(loaded, model_file):
    options = Options(effects=EFFECTS, rounds=1, workers=1)
    return diagnose(Model.load(model_file), loaded.records, options)


@pytest.fixture(scope='session')
def facts(diagnosed, loaded, model_file):
    made = provenance(model_file, ['diagnose', 'bags'], {'rounds': 1}, '2011-03-13T07:00:00Z')
    return diagnosis_facts(diagnosed, loaded, made)


@pytest.fixture(scope='session')
def lines(diagnosed):
    return diagnosis_curves(diagnosed)
