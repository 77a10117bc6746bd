"""Signals made small enough to live in a page: quantised curves, spectra, residuals by state."""

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import scipy

from cg_sysid.checks.faults import FaultSignal
from cg_sysid.report.curves import Curve
from cg_sysid.report.wording import input_units

MISSING = 0xFFFF
STEPS = 0xFFFE
BUDGET = 420_000  # numbers in a page, two bytes each before base64
MOST_RECORDS = 24
FREQUENCIES = 160
BINS = 28
LEAST_IN_BIN = 12
LONGEST_SEGMENT = 2048

Facts = dict[str, Any]


def payload(facts: Facts, curves: Sequence[Curve], faults: Sequence[FaultSignal] = ()) -> Facts:
    """Everything that the scripts of the page draw."""
    channels = [
        {**channel, 'sigma': facts['noise_floor'].get(channel['name'])}
        for channel in facts['channels']
    ]
    shown = list(curves[:MOST_RECORDS])
    columns = sum((3 * c.measured.shape[1] + c.inputs.shape[1]) * len(c.time) for c in shown)
    every = max(1, int(np.ceil(columns / BUDGET)))
    judged = [c for c in curves if c.role in ('held', 'all')]
    return {
        'channels': channels,
        'inputs': facts['inputs'],
        'input_units': list(input_units(facts).values()),
        'thinned': every,
        'faults': [_fault(signal) for signal in faults],
        'records': [_record(curve, every) for curve in shown],
        'spectra': {
            channel['name']: spectra(judged, j, channel['sigma'])
            for j, channel in enumerate(channels)
        },
        'states': {
            channel['name']: by_state(judged, j, channel['unit'], input_units(facts))
            for j, channel in enumerate(channels)
        },
    }


def _fault(signal: FaultSignal) -> Facts:
    every = max(1, len(signal.time) // 4000)
    return {
        'source': signal.source,
        'channel': signal.channel,
        'unit': signal.unit,
        'code': signal.code,
        'span': [signal.start, signal.stop],
        'time': _times(signal.time[::every]),
        'values': quantised(signal.values[::every]),
    }


def _record(curve: Curve, every: int) -> Facts:
    measured = curve.measured[::every]
    residuals = [(s[::every] - measured) for s in (curve.before, curve.after)]
    return {
        'name': curve.name,
        'role': curve.role,
        'time': _times(curve.time[::every]),
        'inputs': [quantised(column) for column in curve.inputs[::every].T],
        'outputs': [
            {
                'measured': quantised(measured[:, j]),
                'before': quantised(residuals[0][:, j]),
                'after': quantised(residuals[1][:, j]),
            }
            for j in range(measured.shape[1])
        ],
    }


def _times(time: np.ndarray) -> Facts:
    single = np.asarray(time, '<f4')
    return {'n': len(single), 'b': base64.b64encode(single.tobytes()).decode()}


def quantised(values: np.ndarray) -> Facts | None:
    """Values as 16-bit steps of their range; None where there is no value at all."""
    finite = np.isfinite(values)
    if not finite.any():
        return None
    low, high = float(values[finite].min()), float(values[finite].max())
    span = high - low or 1.0
    steps = np.full(len(values), MISSING, '<u2')
    steps[finite] = np.rint((values[finite] - low) / span * STEPS).astype('<u2')
    return {'lo': low, 'span': span, 'b': base64.b64encode(steps.tobytes()).decode()}


def spectra(curves: Sequence[Curve], channel: int, sigma: float | None) -> Facts | None:
    """Power spectral densities of the residual before and after, averaged over records.

    Args:
        curves: Records to average over.
        channel: Index of the output.
        sigma: Its noise floor; white noise of this size has a flat density.
    """
    regular = [r for r in (_regular(c, channel) for c in curves) if r is not None]
    if not regular:
        return None
    step = float(np.median([r[0] for r in regular]))
    length = min(LONGEST_SEGMENT, min(len(r[1]) for r in regular))
    sums = np.zeros((2, length // 2 + 1))
    for _, before, after in regular:
        for row, signal in zip(sums, (before, after), strict=True):
            row += scipy.signal.welch(signal, 1 / step, nperseg=length, detrend=False)[1]
    frequency = np.fft.rfftfreq(length, step)
    density = sums / len(regular)
    groups = np.unique(np.geomspace(1, length // 2, FREQUENCIES).astype(int))
    mean = [
        [float(d[a:b].mean()) for a, b in zip(groups, [*groups[1:], groups[-1] + 1], strict=True)]
        for d in density
    ]
    return {
        'f': [float(f'{f:.4g}') for f in frequency[groups]],
        'before': [float(f'{v:.4g}') for v in mean[0]],
        'after': [float(f'{v:.4g}') for v in mean[1]],
        'floor': 2 * step * sigma**2 if sigma else None,
    }


def _regular(curve: Curve, channel: int) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Step in s and both residuals on a regular grid; None where there are too few samples."""
    present = np.isfinite(curve.measured[:, channel])
    if present.sum() < 64:
        return None
    time = curve.time[present]
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], step)
    both = [
        np.interp(grid, time, (s - curve.measured)[present, channel])
        for s in (curve.before, curve.after)
    ]
    return step, both[0], both[1]


def by_state(
    curves: Sequence[Curve], channel: int, unit: str, inputs: Mapping[str, str]
) -> list[Facts]:
    """Residual before and after against angle, rate and torque: mean and spread in bins.

    Args:
        curves: Records as simulated.
        channel: Index of the output.
        unit: Its unit.
        inputs: Unit of each input.
    """
    moved = unit.removesuffix('/s')
    what = 'angle' if moved == 'rad' else 'position'
    axes = [
        (what, moved, [c.position[:, channel] for c in curves]),
        ('rate', f'{moved}/s', [c.rate[:, channel] for c in curves]),
    ]
    for i, (name, of) in enumerate(inputs.items()):
        axes.append((name.replace('_', ' '), of, [c.inputs[:, i] for c in curves]))
    found = []
    for name, unit, values in axes:
        if not values:
            continue
        x = np.concatenate(values)
        residuals = [
            np.concatenate([(getattr(c, s) - c.measured)[:, channel] for c in curves])
            for s in ('before', 'after')
        ]
        binned = _binned(x, residuals)
        if binned:
            found.append({'axis': name, 'unit': unit, **binned})
    return found


def _binned(x: np.ndarray, residuals: Sequence[np.ndarray]) -> Facts | None:
    here = np.isfinite(x) & np.isfinite(residuals[0]) & np.isfinite(residuals[1])
    if here.sum() < 2 * LEAST_IN_BIN:
        return None
    x = x[here]
    low, high = np.quantile(x, [0.005, 0.995])
    if high - low < 1e-9:
        return None
    edges = np.linspace(low, high, BINS + 1)
    index = np.digitize(x, edges) - 1
    rows = []
    for k in range(BINS):
        inside = index == k
        if inside.sum() < LEAST_IN_BIN:
            continue
        row = [0.5 * (edges[k] + edges[k + 1])]
        for residual in residuals:
            values = residual[here][inside]
            row += [values.mean(), values.std()]
        rows.append([float(f'{value:.5g}') for value in row])
    if len(rows) < 2:
        return None
    names = ('x', 'before', 'before_spread', 'after', 'after_spread')
    return dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
