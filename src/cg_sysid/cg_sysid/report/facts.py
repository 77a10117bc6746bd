"""The facts of a diagnosis or identification as plain data: diagnosis_json.md.

The report is drawn from these and curves.npz alone.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.model import Model
from cg_sysid.checks.loading import Loaded
from cg_sysid.diagnosis.landing_cause import landing_gains, words
from cg_sysid.diagnosis.next_step import next_step
from cg_sysid.diagnosis.result import Cause, Diagnosis, gains_of
from cg_sysid.diagnosis.summary import INTERVAL, is_determined
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.gain import Gain
from cg_sysid.identification.unknowns import Unknown
from cg_sysid.learned.unmodelled import term_words, variable_words
from cg_sysid.report.curves import Curve
from cg_sysid.report.data_facts import data_facts, in_spite_of
from cg_sysid.report.diagnosis_file import DIAGNOSIS, IDENTIFICATION, Facts, plain
from cg_sysid.report.residual_analysis import leftover
from cg_sysid.search.ranking import Candidate, Round


def diagnosis_facts(
    diagnosis: Diagnosis,
    loaded: Loaded,
    provenance: Mapping[str, Any],
    curves: Sequence[Curve] = (),
) -> Facts:
    """The facts of a diagnosis.

    Args:
        diagnosis: The answer.
        loaded: The bags behind it.
        provenance: See provenance.py.
        curves: Measured and simulated signals; from those held out the character of the
            remaining error is read.
    """
    data_sets = (*diagnosis.train, *diagnosis.held)
    roles = ('train',) * len(diagnosis.train) + ('held',) * len(diagnosis.held)
    fit = diagnosis.extended.train
    errors = [
        np.vstack([c.train.mse, c.held.mse]) for c in (diagnosis.baseline, diagnosis.extended)
    ]
    counts = np.vstack([fit.count, diagnosis.extended.held.count])
    return _with_next(
        {
            **_head(
                DIAGNOSIS,
                str(diagnosis.verdict),
                diagnosis.summary + in_spite_of(loaded),
                diagnosis.nominal,
            ),
            'causes': [_cause(cause, diagnosis.extended.model) for cause in diagnosis.causes],
            'gain': {
                g.channel: _gain(g.before, g.after, g.noise, g.unit) for g in diagnosis.gains
            },
            'gain_from_measured_start': _measured_start(diagnosis),
            'remaining_error': {
                channel: {
                    'chi2_per_sample': chi2,
                    'in_noise': math.sqrt(max(chi2, 0.0)),
                    **_character(diagnosis.nominal, channel, curves),
                }
                for channel, chi2 in diagnosis.remaining.items()
                if channel in {g.channel for g in diagnosis.gains}
            },
            'unmodelled': _unmodelled(diagnosis),
            'wandering': _wandering(diagnosis),
            'late_samples': diagnosis.late,
            'landings': _landings(diagnosis),
            'unfinished': _unfinished(diagnosis),
            'ranking': [*(_round(r) for r in diagnosis.rounds), *_laws(diagnosis)],
            **_fitted(diagnosis.nominal, fit),
            'delivered': {
                'from_all': diagnosis.from_all,
                'values': {u.name: diagnosis.model.values[u.name] for u in fit.unknowns},
            },
            'findings': list(diagnosis.findings),
            **data_facts(diagnosis.nominal, data_sets, roles, errors, counts, loaded),
            'provenance': dict(provenance),
        }
    )


def unusable_facts(
    model: Model, loaded: Loaded, reason: str, provenance: Mapping[str, Any]
) -> Facts:
    """The facts where the recordings do not allow a diagnosis.

    Args:
        model: The model that was to be diagnosed.
        loaded: The bags and what is wrong with them.
        reason: Why nothing was fitted, one sentence.
        provenance: See provenance.py.
    """
    return _with_next(
        {
            **_head(DIAGNOSIS, 'unusable', reason + in_spite_of(loaded), model),
            'causes': [],
            'gain': {},
            'gain_from_measured_start': None,
            'remaining_error': {},
            'delivered': None,
            'unmodelled': None,
            'wandering': None,
            'late_samples': '',
            'landings': None,
            'unfinished': None,
            'ranking': [],
            'parameters': [_parameter(model, name, None) for name in model.declarations],
            'correlation': {'names': [], 'matrix': []},
            'fit': None,
            'findings': [],
            **data_facts(model, (), (), [], np.zeros((0, 0)), loaded),
            'provenance': dict(provenance),
        }
    )


def identification_facts(
    model: Model,
    fit: Fit,
    before: Fit | None,
    data_sets: Sequence[DataSet],
    loaded: Loaded,
    method: str,
    provenance: Mapping[str, Any],
    curves: Sequence[Curve] = (),
) -> Facts:
    """The facts of an identification.

    Args:
        model: The model as it was given.
        fit: The identification, on all data sets.
        before: Score of the model as given on the same data sets; None if it runs away.
        data_sets: The records.
        loaded: The bags behind them.
        method: Name of the method.
        provenance: See provenance.py.
        curves: Measured and simulated signals.
    """
    sigma = data_sets[0].sigma
    total = fit.count.sum(axis=0)
    after = _rms(fit.mse, fit.count)
    start = _rms(before.mse, before.count) if before else np.full(len(sigma), np.nan)
    outputs = list(zip(model.mechanism.outputs, model.mechanism.output_units, strict=True))
    gain = {
        channel: _gain(s * b, s * a, s, unit)
        for (channel, unit), s, b, a, n in zip(outputs, sigma, start, after, total, strict=True)
        if n
    }
    count = len(fit.unknowns)
    summary = (
        f'{count} parameter{"s" * (count != 1)} identified from {len(data_sets)} '
        f'record{"s" * (len(data_sets) != 1)} by {method.replace("_", "-")} '
        f'in {fit.seconds:.1f} s ({fit.evaluations} simulations of all records)'
        f'{"" if fit.converged else "; it stopped before it had converged"}.'
    )
    errors = [before.mse if before else np.full_like(fit.mse, np.nan), fit.mse]
    return _with_next(
        {
            **_head(IDENTIFICATION, 'identified', summary + in_spite_of(loaded), model),
            'method': method,
            'causes': [],
            'gain': gain,
            'remaining_error': {
                channel: {
                    'chi2_per_sample': float(a**2),
                    'in_noise': float(a),
                    **_character(model, channel, curves),
                }
                for (channel, _), a, n in zip(outputs, after, total, strict=True)
                if n
            },
            'delivered': None,
            'unmodelled': None,
            'wandering': None,
            'late_samples': '',
            'landings': None,
            'unfinished': None,
            'ranking': [],
            **_fitted(model, fit),
            'findings': list(fit.warnings),
            **data_facts(model, data_sets, ('all',) * len(data_sets), errors, fit.count, loaded),
            'provenance': dict(provenance),
        }
    )


def _with_next(facts: Facts) -> Facts:
    found = plain(facts)
    return {**found, 'next': next_step(found)}


def _head(form: str, verdict: str, summary: str, model: Model) -> Facts:
    return {
        'format': form,
        'verdict': verdict,
        'summary': summary,
        'model': {
            'name': model.name,
            'mechanism': model.mechanism.name,
            'effects': [effect.label for effect in model.effects],
        },
        'channels': [
            {'name': name, 'unit': unit}
            for name, unit in zip(
                model.mechanism.outputs, model.mechanism.output_units, strict=True
            )
        ],
        'inputs': list(model.mechanism.inputs),
        'input_units': list(model.mechanism.input_units),
    }


def _character(model: Model, channel: str, curves: Sequence[Curve]) -> Facts:
    """What the remaining error of an output looks like."""
    j = model.mechanism.outputs.index(channel)
    judged = [curve for curve in curves if curve.role != 'train']
    return leftover(judged, j, model.mechanism.output_units[j], model.mechanism.inputs)


def _rms(mse: np.ndarray, count: np.ndarray) -> np.ndarray:
    return np.sqrt((mse * count).sum(axis=0) / np.maximum(count.sum(axis=0), 1))


def _measured_start(diagnosis: Diagnosis) -> Facts | None:
    found = diagnosis.measured_start
    if found is None:
        return None
    return {
        'helps': found.helps,
        'text': found.text,
        'carried_s': dict(found.carried),
        'whole': found.whole,
        'gain': {g.channel: _gain(g.before, g.after, g.noise, g.unit) for g in found.gains},
    }


def _gain(before: float, after: float, noise: float, unit: str) -> Facts:
    return {
        'before': before,
        'after': after,
        'noise_floor': noise,
        'unit': unit,
        'ratio': before / after if after > 0 else None,
    }


def _cause(cause: Cause, model: Model) -> Facts:
    ranges = model.declarations
    return {
        **_effect(cause.label),
        'parameters': _values(cause.parameters, cause.label, ranges),
        'undetermined': list(cause.undetermined),
        'at_edge': list(cause.at_edge),
        'replaces': list(cause.replaces),
        'evidence_nats': cause.evidence,
        'rivals': [_effect(rival) for rival in cause.rivals],
        'places': list(cause.places),
        'next_experiments': [
            {
                'experiment': p.experiment,
                'excitation': dict(p.excitation),
                'duration_s': p.duration,
                'expected_nats': p.evidence,
                'tells_apart': list(p.weakest),
            }
            for p in cause.proposals
        ],
        'events': {
            record: _values(values, cause.label, ranges) for record, values in cause.events.items()
        },
    }


def _unfinished(diagnosis: Diagnosis) -> Facts | None:
    found = diagnosis.unfinished
    if found is None:
        return None
    return {
        'why': found.why,
        'seconds': found.seconds,
        'text': found.text,
        'ranking': [
            {**_effect(s.label), 'in_noise': s.in_noise, 'whole_records': s.whole}
            for s in found.ranking
        ],
        'by_torques': [{**_effect(label), 'nats': nats} for label, nats in found.by_torques],
        'not_fitted': list(found.not_fitted),
        'not_tried': list(found.not_tried),
        'not_done': list(found.steps),
    }


def _wandering(diagnosis: Diagnosis) -> Facts | None:
    found = diagnosis.wandering
    if found is None:
        return None
    return {
        'name': found.name,
        'unit': found.unit,
        'text': found.text,
        'explained': found.explained,
        'values': {
            recording: {'value': value, 'sigma': sigma}
            for recording, (value, sigma) in found.values.items()
        },
    }


def _unmodelled(diagnosis: Diagnosis) -> Facts | None:
    found = diagnosis.unmodelled
    if found is None:
        return None
    shape = found.shape
    gains: tuple[Gain, ...] = ()
    if found.held is not None:
        gains = gains_of(diagnosis.nominal, diagnosis.held, diagnosis.extended.held, found.held)
    return {
        'label': found.label,
        'text': found.text,
        'what': found.what,
        'constant': shape.constant,
        'mean': shape.mean,
        'where': found.where,
        'at': found.effect.site,
        'follows': found.effect.follows,
        'follows_words': variable_words(found.effect),
        'unit': found.effect.unit,
        'variable_unit': found.variable_unit,
        'kind': found.effect.kind,
        'parity': shape.parity or None,
        'even_share': shape.even,
        'period': None
        if found.period is None
        else {'value': found.period[0], 'sigma': found.period[1], 'unit': found.variable_unit},
        'rms': shape.rms,
        'peak': shape.peak,
        'covered': list(shape.covered),
        'mostly': None if shape.stretch is None else list(shape.stretch),
        'amplitudes': found.amplitudes,
        'function': {
            's': shape.s, 'value': shape.value, 'sigma': shape.sigma, 'seen': shape.seen.tolist(),
        },
        'explained': found.explained,
        'evidence_nats': found.evidence,
        'significance': found.significance,
        'window_s': found.window,
        'rivals': [
            {'label': rival.label, 'what': term_words(rival)} for rival in found.rivals
        ],
        'nearest': [_effect(label) for label in found.nearest],
        'gain': {g.channel: _gain(g.before, g.after, g.noise, g.unit) for g in gains},
    }  # fmt: skip


def _landings(diagnosis: Diagnosis) -> Facts | None:
    found = diagnosis.landings
    if found is None:
        return None
    best = found.best
    return {
        'touchdowns': found.found,
        'judged': found.judged,
        'text': words(diagnosis, found),
        'stated': _law(found.stated),
        'law': _law(best.law if best else found.stated),
        'accepted': list(found.accepted),
        'rivals': list(found.rivals),
        'gain': {
            g.channel: _gain(g.before, g.after, g.noise, g.unit)
            for g in landing_gains(diagnosis, found)
        },
        'impulses': [
            {
                'name': impulse.name,
                'along': impulse.measured[0],
                'off': impulse.measured[1],
                'covariance': impulse.covariance,
                'plastic': list(impulse.plastic),
            }
            for impulse in found.impulses
        ],
    }


def _law(law: ContactLaw) -> Facts:
    return {'restitution': law.restitution, 'friction': law.friction}


def _laws(diagnosis: Diagnosis) -> list[Facts]:
    """The laws of contact that were tried, as a round."""
    found = diagnosis.landings
    if found is None or not found.tried:
        return []
    return [{
        'base': 'landings',
        'accepted': found.best.label if found.best else None,
        'independent_samples': found.independent,
        'candidates': [
            {
                **_effect(t.label),
                'evidence_nats': t.evidence,
                'held_gain': t.held_gain,
                'significance': t.significance,
                'explained_sigmas': t.explained,
                'chi2_per_sample': {'train': t.errors[0], 'held': t.errors[1]},
                'parameters': {
                    k: v for name in t.effects for k, v in _values(
                        t.parameters[name], name,
                        {f'{name}.{p.name}': p for p in LIBRARY[name].parameters},
                    ).items()
                },
                'reason': t.reason,
            }
            for t in found.tried
        ],
        'set_aside': [],
    }]  # fmt: skip


def _effect(label: str) -> Facts:
    name, _, at = label.partition('@')
    known = LIBRARY.get(name)
    return {
        'name': name,
        'label': label,
        'at': at or None,
        'place': known.place if known else None,
        'description': known.summary if known else '',
    }


def _values(parameters: Mapping[str, tuple[float, float, str]], label: str, ranges) -> Facts:
    found = {}
    for name, (value, sigma, unit) in parameters.items():
        declared = ranges.get(f'{label}.{name}')
        found[name] = {
            'value': value,
            'sigma': sigma,
            'unit': unit,
            'interval95': interval(value, sigma, bool(declared and declared.logarithmic)),
            'determined': is_determined(label, name, sigma),
            'description': declared.description if declared else '',
        }
    return found


def interval(value: float, sigma: float, logarithmic: bool = False) -> list[float] | None:
    """Ends of the 95 % interval of a value; None where it has none."""
    if not math.isfinite(sigma):
        return None
    if logarithmic and value > 0:
        factor = math.exp(min(INTERVAL * sigma / value, 700.0))
        return [value / factor, value * factor]
    return [value - INTERVAL * sigma, value + INTERVAL * sigma]


def _round(r: Round) -> Facts:
    return {
        'base': r.base,
        'accepted': r.accepted or None,
        'independent_samples': r.independent,
        'candidates': [_candidate(c) for c in r.candidates],
        'set_aside': list(r.aside),
    }


def _candidate(c: Candidate) -> Facts:
    return {
        **_effect(c.label),
        'evidence_nats': c.evidence,
        'held_gain': c.held_gain,
        'significance': c.significance,
        'explained_sigmas': c.explained,
        'chi2_per_sample': {'train': c.train.normalised_error, 'held': c.held.normalised_error},
        'parameters': _values(c.parameters, c.label, c.model.declarations),
        'reason': c.reason,
    }


def _fitted(nominal: Model, fit: Fit) -> Facts:
    found = {
        u.name: (u, v, s, share)
        for u, v, s, share in zip(
            fit.unknowns, fit.values, fit.sigmas, fit.information, strict=True
        )
    }
    spread = np.sqrt(np.clip(np.diag(fit.covariance), 0, None))
    with np.errstate(divide='ignore', invalid='ignore'):
        correlation = fit.covariance / np.outer(spread, spread)
    return {
        'parameters': [
            _parameter(nominal, name, found.get(name), fit.model)
            for name in fit.model.declarations
        ],
        'correlation': {'names': [u.name for u in fit.unknowns], 'matrix': correlation.tolist()},
        'fit': {
            'evaluations': fit.evaluations,
            'seconds': fit.seconds,
            'converged': fit.converged,
            'inflation': fit.inflation,
        },
    }


def _parameter(
    nominal: Model,
    name: str,
    found: tuple[Unknown, float, float, float] | None,
    fitted: Model | None = None,
) -> Facts:
    declared = (fitted or nominal).declarations[name]
    believed = nominal.quantities.get(name)
    entry = {
        'name': name,
        'unit': declared.unit,
        'description': declared.description,
        'nominal': believed.value if believed else None,
        'tolerance': believed.tolerance if believed else None,
        'source': believed.source if believed else '',
        'fixed': found is None,
        'added': believed is None,
        'range': [declared.lower, declared.upper],
        'identified': None,
        'sigma': None,
        'interval95': None,
        'information': None,
        'moved_tolerances': None,
    }
    if found is None:
        if believed is None and fitted is not None:
            entry['nominal'] = fitted.quantities[name].value
        return entry
    u, value, sigma, share = found
    moved = None
    if believed is not None and math.isfinite(u.tolerance):
        moved = (u.to_coordinate(value) - u.to_coordinate(u.prior)) / u.tolerance
    if believed is not None and entry['tolerance'] is None and math.isfinite(u.tolerance):
        entry['tolerance'] = u.tolerance * (u.prior if u.logarithmic else 1.0)
    return entry | {
        'identified': value,
        'sigma': sigma,
        'interval95': interval(value, sigma, u.logarithmic),
        'information': share,
        'moved_tolerances': moved,
    }
