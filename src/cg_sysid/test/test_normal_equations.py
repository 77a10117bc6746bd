"""The step of an identification, from normal equations of very different size."""

import numpy as np
import pytest

from cg_sysid.simulation_error import Border, Point, reduced


def _point(own_hessian, coupling, own_gradient):
    nothing = np.zeros((1, 1))
    return Point(
        cost=1.0, shared_hessian=np.array([[7.0]]), shared_gradient=np.array([3.0]),
        own=[(own_hessian, coupling, own_gradient)], sse=nothing, count=nothing, data_cost=1.0,
        border=Border(0.0, np.zeros(1), nothing),
    )  # fmt: skip


def test_reduced_is_the_schur_complement():
    d, e, g = np.array([[4.0, 1.0], [1.0, 9e6]]), np.array([[2.0], [5e2]]), np.array([0.5, 8e2])
    h, gradient, _ = reduced(_point(d, e, g), 0.0)
    whole = np.block([[d, e], [e.T, np.array([[7.0]])]])
    step = np.linalg.solve(whole, np.append(g, 3.0))[2]
    # Both are solves of a matrix with condition 1e7: nine digits are left of sixteen.
    assert (gradient / h[0, 0])[0] == pytest.approx(step, rel=1e-9)


def test_a_direction_that_rounding_has_lost_is_no_failure():
    # An unstable motion: both unknowns move the end of the record, only their sum is seen, and
    # what is believed of each (1e4) lies below the last digit of 1e30.
    steep = np.full((2, 2), 1e30)
    h, gradient, factors = reduced(_point(steep + 1e4 * np.eye(2), np.ones((2, 1)),
                                          np.array([2e10, 2e10])), 0.0)
    assert np.isfinite(h).all()
    assert np.isfinite(gradient).all()
    # The sum of the unknowns goes where the data say, by equal shares.
    assert factors[0][:, -1] == pytest.approx([1e-20, 1e-20], rel=1e-6)
