"""System identification and diagnosis: recordings, checks, fits and reports.

    from cg_sysid import Model, Options, check, diagnose, identify, read_bag

What `__all__` lists is public and stays (python.md). All else is how it is done, and may move
from one version to the next.
"""

import importlib
from typing import Any

# Loaded when asked for: a command that reads a bag needs no optimiser.
_PUBLIC = {
    'CheckReport': 'cg_sysid.checks.recordings',
    'DataSet': 'cg_sysid.identification.data_set',
    'Deadline': 'cg_sysid.deadline',
    'Diagnosis': 'cg_sysid.diagnosis.result',
    'Fit': 'cg_sysid.identification.identify',
    'IdentificationError': 'cg_sysid.identification.unknowns',
    'Model': 'cg_dynamics.model',
    'Options': 'cg_sysid.diagnosis.result',
    'Record': 'cg_sysid.records.record',
    'RecordingError': 'cg_sysid.errors',
    'Setup': 'cg_dynamics.rig',
    'Verdict': 'cg_sysid.diagnosis.result',
    'check': 'cg_sysid.checks.recordings:check_recording',
    'diagnose': 'cg_sysid.diagnosis.diagnose',
    'identify': 'cg_sysid.identification.identify',
    'measure_noise': 'cg_sysid.records.noise',
    'prepare': 'cg_sysid.identification.data_set',
    'read_bag': 'cg_sysid.records.bags',
    'read_raw': 'cg_sysid.records.bags',
    'rehearse': 'cg_sysid.experiments.rehearsal',
    'score': 'cg_sysid.identification.identify',
    'to_record': 'cg_sysid.records.bags',
    'write_bag': 'cg_sysid.records.bag_writer',
}
__all__ = sorted(_PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
    module, _, attribute = _PUBLIC[name].partition(':')
    return getattr(importlib.import_module(module), attribute or name)


def __dir__() -> list[str]:
    return __all__
