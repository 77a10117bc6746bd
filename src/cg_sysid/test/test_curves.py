"""Curves of the report: what was simulated, with all that a record has of its own."""

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import predict, score
from cg_sysid.report.curves import make_curve

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))


@pytest.mark.parametrize('effect', ['external_push', 'encoder_zero', 'imu_drift', 'imu_lag'])
def test_a_curve_is_what_the_model_predicts(model_file, effect):
    nominal = Model.load(model_file)
    extended = nominal.with_effect(effect)
    record = rehearse(
        'record', extended, Setup(springs=SPRINGS), [0.1, -0.1, 0.3, -0.5],
        [lambda t: 9.0 * np.sin(4.0 * t)], 2.0, 0.004, 1,
    )  # fmt: skip
    (data_set,) = prepare(nominal, [record])
    before, after = (score(model, [data_set]) for model in (nominal, extended))
    curve = make_curve(data_set, 'all', nominal, before.motions[0], extended, after.motions[0])
    np.testing.assert_array_equal(curve.before, predict(nominal, data_set, before.motions[0]))
    np.testing.assert_array_equal(curve.after, predict(extended, data_set, after.motions[0]))
    assert curve.position.shape == (len(data_set.time), 3)
