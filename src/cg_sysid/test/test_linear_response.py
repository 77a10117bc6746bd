"""Inner products of responses, against the responses themselves."""

import numpy as np
import pytest

from cg_sysid.learned.linear_response import Piece, Response
from cg_sysid.learned.residual_terms import _waves, beside_lines

M, SLOTS, STARTS = 30, 7, 4
ROUNDING = 1e-12  # of sums of 30 products of numbers of size 1, and of turns below 1e3 rad
ROW = np.array([0.7, -1.3])


@pytest.fixture
def piece():
    """Made up: two coordinates, three sensors unlike in rate and noise."""
    rng = np.random.default_rng(3)
    project, _ = np.linalg.qr(rng.normal(size=(M, STARTS)))

    def without_start(values):
        return values - np.tensordot(project, np.tensordot(project.T, values, 1), 1)

    samples = np.repeat([0, 1, 2], [5, 9, 16])
    return Piece(
        record=0,
        held=False,
        missed=without_start(rng.normal(size=M)),
        torque=without_start(rng.normal(size=(M, 2, SLOTS))),
        parameters=without_start(rng.normal(size=(M, 3))),
        samples=samples,
        project=project,
        sigma=np.array([0.2, 0.6, 3.0])[samples],
        at_slots={},
        at_samples={},
    )


def to_torque(piece, forcing):
    return np.einsum('mcs,c,sk->mk', piece.torque, ROW, forcing)


def to_error(piece, forcing):
    """Over the noise, and without what an initial motion would explain of it."""
    error = np.zeros((M, forcing.shape[1]))
    error[piece.samples == 1] = forcing
    error /= piece.sigma[:, None]
    return error - piece.project @ np.linalg.lstsq(piece.project, error, rcond=None)[0]


@pytest.mark.parametrize('what', ['torque', 'error'])
def test_inner_products_are_those_of_the_responses(piece, what):
    rng = np.random.default_rng(4)
    n = SLOTS if what == 'torque' else int(np.sum(piece.samples == 1))
    found = piece.to_torque(ROW) if what == 'torque' else piece.to_error(1)
    direct = to_torque if what == 'torque' else to_error
    basis, carrier = rng.normal(size=(n, 3)), rng.normal(size=n)
    for response, forcing in ((found, basis), (found.times(carrier), carrier[:, None] * basis)):
        moved = direct(piece, forcing)
        np.testing.assert_allclose(response.among(basis), moved.T @ moved, atol=ROUNDING)
        np.testing.assert_allclose(
            response.parameters @ basis, piece.parameters.T @ moved, atol=ROUNDING
        )
        np.testing.assert_allclose(response.missed @ basis, piece.missed @ moved, atol=ROUNDING)
    constant = direct(piece, np.ones((n, 1)))[:, 0]
    np.testing.assert_allclose(
        found.with_constant(), direct(piece, np.eye(n)).T @ constant, atol=ROUNDING
    )


@pytest.mark.parametrize('count', [1, 2, 10, 37])
def test_waves_are_turned_to_each_frequency(count):
    s = np.array([-3.1, 0.0, 0.4, 7.9])
    frequencies = 0.3 + 0.27 * np.arange(count)
    turn = 2 * np.pi * np.outer(s, frequencies)
    np.testing.assert_allclose(_waves(s, frequencies), [np.cos(turn), np.sin(turn)], atol=ROUNDING)


@pytest.mark.parametrize(
    ('variable', 'share'),
    [
        # Two and a half periods, in a second: it is seen to repeat.
        (lambda t: 2.5 * t, 0.5),
        # 40 periods in a second: a mass of 1 kg feels their mean.
        (lambda t: 40.0 * t, 0.0),
        # Two values only: a line has both.
        (lambda t: np.where(t < 0.4, 0.0, 0.37), 0.0),
    ],
)
def test_a_wave_that_no_motion_follows_is_a_line(variable, share):
    # Position is the second integral of a force; what an initial motion explains is left out.
    time = np.linspace(0, 1, 400)
    step = np.tri(400) / 400
    start = np.column_stack([np.ones(400), time])
    project, _ = np.linalg.qr(start)
    moved = step @ step
    moved -= project @ (project.T @ moved)
    response = Response(np.zeros((1, 400)), np.zeros(400), moved, np.zeros((1, 400)))
    s = variable(time)
    waves = [level + np.cos(2 * np.pi * s) for level in (0.03, -0.02)]
    found = beside_lines([response] * 2, [s] * 2, waves, ['a', 'b'])
    assert found > share if share else found < 1e-3
