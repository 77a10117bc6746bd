"""Windows of a record, as they lie in the lanes of vectors for windows.c.

Lanes go on row by row, and all wait for the one whose row takes most integration steps. Which
windows lie side by side is a matter of speed alone: the sensitivities are the same.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from cg_dynamics.rollout.vector_code import WIDTH

PIECE, SHARE = 8.0, 0.05  # what a vector of windows more costs, in steps, and of a record's steps
PLACES = 12  # pieces of equal length, of which those of a record are made


def window_edges(work: np.ndarray) -> np.ndarray:
    """First rows of the windows of a record, and its last row.

    Windows side by side go on row by row, and wait for the one whose row takes most steps. Where
    dry friction is stiff, as where a joint turns round, some rows take ten times as many as
    others. So the record is cut into pieces of rows alike, and each of them into windows.

    Args:
        work: Steps of each row to the next, shape (n - 1,).
    """
    n, every = len(work), work + 1.0  # what a row takes besides
    edges = [
        np.linspace(a, b, min(WIDTH, max(1, b - a)) + 1).astype(int)[:-1]
        for a, b in itertools.pairwise([*_pieces(every), n])
    ]
    return np.append(np.concatenate(edges), n)


def _pieces(work: np.ndarray) -> list[int]:
    """First rows of the pieces whose windows take the fewest steps, by dynamic programming."""
    whole = _side_by_side(work)
    piece = max(PIECE, SHARE * whole)
    if whole - work.sum() / WIDTH <= piece:
        return [0]
    rows = np.unique(np.linspace(0, len(work), PLACES + 1).astype(int))
    least, begins = [0.0], [0]  # steps up to each place, and where its last piece begins
    for j in range(1, len(rows)):
        steps = [least[i] + piece + _side_by_side(work[rows[i] : rows[j]]) for i in range(j)]
        begins.append(int(np.argmin(steps)))
        least.append(steps[begins[-1]])
    first, j = [], len(rows) - 1
    while j > 0:
        j = begins[j]
        first.append(int(rows[j]))
    return first[::-1]


def _side_by_side(work: np.ndarray) -> float:
    """Steps of windows of equal length that wait for each other."""
    beside = np.zeros(-(-len(work) // WIDTH) * WIDTH)
    beside[: len(work)] = work
    return float(beside.reshape(WIDTH, -1).max(axis=0, initial=0.0).sum())


@dataclass(frozen=True)
class Lanes:
    """Windows of a record, as windows.c wants them; arrays of shape (padded,).

    Attributes:
        count: How many windows there are.
        padded: The same, to whole vectors.
        first: First row of each: early enough for what a late sensor saw.
        length: Rows of each.
        start: Its first row that counts, from `first`.
        until: The first that does not count any more.
        handed: The first row of the next window.
        late: Column of the delay of the inputs, or -1.
        columns: Number of columns.
    """

    count: int
    padded: int
    first: np.ndarray
    length: np.ndarray
    start: np.ndarray
    until: np.ndarray
    handed: np.ndarray
    late: int
    columns: int

    @classmethod
    def of(
        cls, time: np.ndarray, edges: np.ndarray, delay: float, nx: int, active: int,
        delay_column: int,
    ):  # fmt: skip
        """Windows between edges (`window_edges`)."""
        n, count = len(time), len(edges) - 1
        padded = -(-count // WIDTH) * WIDTH
        first = np.searchsorted(time, time[edges[:-1]] - delay, side='right') - 1
        first = np.minimum(np.maximum(first, 0), edges[:-1])
        last = np.append(edges[1:-1], n - 1)
        until = np.append(edges[1:-1], n)
        handed = np.append(first[1:], n) - first

        def filled(a, empty):
            return np.array([*a, *[empty] * (padded - count)], np.int32)

        late = nx + active if delay_column >= 0 else -1
        return cls(
            count, padded, filled(first, 0), filled(last - first + 1, 1),
            filled(edges[:-1] - first, 0), filled(until - first, 0), filled(handed, -1),
            late, nx + active + (late >= 0),
        )  # fmt: skip
