"""Facts about what was recorded: records and their errors, windows, bags and findings."""

import math
from collections.abc import Sequence

import numpy as np

from cg_dynamics.model import Model
from cg_sysid.checks.loading import Loaded
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.windows import Windows
from cg_sysid.records.findings import Finding
from cg_sysid.report.diagnosis_file import Facts


def data_facts(
    model: Model,
    data_sets: Sequence[DataSet],
    roles: Sequence[str],
    errors: Sequence[np.ndarray],
    counts: np.ndarray,
    loaded: Loaded,
) -> Facts:
    """Everything about the recordings.

    Args:
        model: The nominal model.
        data_sets: The records that were used.
        roles: Of each: train, held, or all.
        errors: chi2/N before and after, each of shape (records, ny).
        counts: Samples behind them, the same shape.
        loaded: The bags.
    """
    records = []
    by_name = {record.name: record for record in (*loaded.records, *loaded.wholes)}
    for k, (data_set, role) in enumerate(zip(data_sets, roles, strict=True)):
        record = by_name.get(data_set.name)
        records.append(
            {
                'name': data_set.name,
                'source': loaded.origin.get(data_set.name, ''),
                'role': role,
                'experiment': str((record.note if record else {}).get('experiment', '')),
                'setup': data_set.setup.to_dict(),
                'duration_s': data_set.duration,
                'rows': len(data_set.time),
                'rate_hz': 1 / float(np.median(np.diff(data_set.time))),
                'coverage': _coverage(model, data_set),
                'error': {
                    channel: {'before': float(s * np.sqrt(b)), 'after': float(s * np.sqrt(a))}
                    for channel, s, b, a, n in zip(
                        model.mechanism.outputs, data_set.sigma, errors[0][k], errors[1][k],
                        counts[k], strict=True,
                    )
                    if n
                },
            }
        )  # fmt: skip
    sigma = data_sets[0].sigma if data_sets else np.zeros(0)
    return {
        'noise_floor': {
            channel: float(s) for channel, s in zip(model.mechanism.outputs, sigma, strict=False)
        },
        'records': records,
        'windows': _windows(loaded.windows),
        'sources': [
            {
                'name': source.name,
                'path': source.path,
                'sha256': source.sha256 or None,
                'used': not source.reason,
                'check': source.check.verdict,
                'findings': [_finding(f) for f in source.check.findings],
            }
            for source in loaded.sources
        ],
        'overruled': [
            {
                'name': source.name,
                'source': source.path,
                'code': finding.code,
                'where': finding.where,
                'place': finding.place,
                'reason': finding.message,
            }
            for source, finding in loaded.overruled
        ],
        'unusable': [
            {
                'name': source.name,
                'source': source.path,
                'place': source.faults[0].place if source.faults else '',
                'where': source.faults[0].where if source.faults else '',
                'reason': source.reason,
            }
            for source in loaded.left_out
        ],
    }


def in_spite_of(loaded: Loaded) -> str:
    """That recordings are used which the check refuses, as a sentence; empty if there are none."""
    if not loaded.overruled:
        return ''
    names = sorted({source.name for source, _ in loaded.overruled})
    codes = sorted({finding.code for _, finding in loaded.overruled})
    which = names[0] if len(names) == 1 else f'{len(names)} recordings'
    return f' {which} used in spite of what the check finds: {", ".join(codes)}.'


def _windows(windows: Windows) -> Facts:
    how = 'whole' if all(f.whole for f in windows.records) else 'cut'
    return {
        'how': how if windows.chosen is None else 'chosen by you',
        'length_s': windows.chosen,
        'text': windows.text,
        'followed': {
            f.name: {
                'growth': f.growth if math.isfinite(f.growth) else None,
                'whole': f.whole,
                'cuts_s': list(f.cuts),
            }
            for f in windows.records
        },
    }


def _coverage(model: Model, data_set: DataSet) -> Facts:
    channels = dict(zip(model.mechanism.outputs, data_set.outputs.T, strict=True))
    channels |= dict(zip(data_set.input_names, data_set.inputs.T, strict=True))
    return {
        name: [float(np.nanmin(values)), float(np.nanmax(values))]
        for name, values in channels.items()
        if np.isfinite(values).any()
    }


def _finding(f: Finding) -> Facts:
    return {
        'code': f.code,
        'severity': f.severity,
        'where': f.where,
        'place': f.place,
        'message': f.text,
        'start_s': f.start_s,
        'stop_s': f.stop_s,
    }
