"""Manipulator equations from energies: theory.md, (LAG).

    M(q) dv/dt + b(q, v) = Q,
    M = d2T/dv2,   b = d(dT/dv)/dq v - dT/dq + dV/dq

No hand-derived C or G: once compiled the derived form is as fast, and it cannot disagree with
the energies.
"""

import casadi as ca


def manipulator(kinetic: ca.SX, potential: ca.SX, q: ca.SX, v: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Mass matrix M(q), shape (n, n), and bias b(q, v), shape (n, 1), of (LAG).

    Args:
        kinetic: T(q, v) in J, quadratic in v.
        potential: V(q) in J.
        q: Coordinates, shape (n, 1).
        v: Their rates, shape (n, 1).
    """
    momentum = ca.gradient(kinetic, v)
    mass_matrix = ca.jacobian(momentum, v)
    bias = ca.jtimes(momentum, q, v) - ca.gradient(kinetic, q) + ca.gradient(potential, q)
    return mass_matrix, bias


def solve_small(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """Solution of a symmetric positive definite system of one, two or more rows."""
    n = matrix.shape[0]
    if n == 1:
        return right / matrix
    if n == 2:
        a, b, c = matrix[0, 0], matrix[0, 1], matrix[1, 1]
        determinant = a * c - b * b
        return ca.vertcat(
            (c * right[0] - b * right[1]) / determinant,
            (a * right[1] - b * right[0]) / determinant,
        )
    return ca.ldl_solve(right, *ca.ldl(matrix)) if n > 2 else right
