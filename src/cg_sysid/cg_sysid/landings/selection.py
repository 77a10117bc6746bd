"""Landings judged: is the impact plastic, does the foot bounce, does it slide?

Only after the causes within the phases are known: what a payload does to an impact is no bounce.
The rules are those of the phases (search/model_selection.py): evidence, a significant gain on
landings held out, an error that is more than noise. And the law has to explain most of it, as a
wrong mass can pass for a little of either.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.contact import contact_law
from cg_sysid.errors import Failure
from cg_sysid.identification.information_criterion import block_gain, evidence, independent_samples
from cg_sysid.identification.unknowns import without_events
from cg_sysid.landings.contact_fit import FREE, SMALLEST, ContactFit, ContactTask, fit_contact
from cg_sysid.landings.impulse import measure_impulse
from cg_sysid.landings.landings import Passage, ready
from cg_sysid.landings.result import Impulse, Landings, LawTried
from cg_sysid.search import settings
from cg_sysid.stances.phases import Landing

MOST_LANDINGS = 12  # landings that are fitted, and as many that judge
FEWEST_LANDINGS = 2  # of each
# Blocks on which a gain is tested: short where landings are few, long where a gain is small.
BLOCKS_S = (0.025, 0.05, 0.1, 0.3)
# A rebound of a tenth lasts for ten milliseconds and explains about one standard deviation.
NOTICEABLE = 0.5
LEFT = 0.35  # share of the error above the noise that an accepted law may leave
GIVEN = 0.005  # share of a value that the numbers of the model, taken as given, may be worth
SURE = 5.0  # standard deviations from which an impulse is known
ON_CONE = 0.8  # quantile of the slants of impulses that lies on the cone if there is one
TOO_SMALL = 2.0  # standard deviations within which a rebound may be none at all

Run = Callable[[Callable, list[tuple], str], list]


def judge_landings(
    model: Model,
    landings: Sequence[Landing],
    sigma: np.ndarray,
    run: Run,
    effects: Sequence[str] | None = None,
) -> Landings | None:
    """What the landings say; None where too few of them can be simulated.

    Args:
        model: The model with all causes of the phases.
        landings: The landings between the phases.
        sigma: Noise floor of each output, shape (ny,).
        run: Runs a function on tuples of arguments, here or elsewhere.
        effects: Names of the effects to try; by default all.
    """
    model = without_events(model)
    passages = ready(model, landings, sigma)
    train, held = _split(passages)
    if min(len(train), len(held)) < FEWEST_LANDINGS:
        return None
    stated = contact_law(model)
    task = ContactTask(model, stated, (), train, held, sigma)
    base = run(fit_contact, [(task,)], 'landings as the model states them')[0]
    if isinstance(base, Failure):
        return None
    present = {effect.label for effect in model.effects}
    names = [n for n in FREE if n not in present and (effects is None or n in effects)]
    fits: list[ContactFit] = []
    believed = _impulses(task, passages, [passage.centre for passage in passages])
    task = replace(task, starts=_starts(believed))
    if not _at_noise(base, len(train)):
        fits = _fits(run, task, [(name,) for name in names])
        best = min((f for f in fits), key=lambda f: f.chi2, default=None)
        # A little that is left is the ground's own softness, or the model's numbers.
        if (
            best is not None
            and len(names) > 1
            and _error(best.residuals) > (1 + settings.SELECTION.material) ** 2
        ):
            fits += _fits(run, task, [tuple(names)])
    return _verdict(task, base, fits, len(landings), believed)


def _split(
    passages: Sequence[Passage],
) -> tuple[tuple[Passage, ...], tuple[Passage, ...]]:
    """Training and held-out landings: of each leg, every second one is held out."""
    sides: tuple[list[Passage], list[Passage]] = [], []
    for first, stance in enumerate(STANCES):
        for k, passage in enumerate(p for p in passages if p.stance == stance):
            sides[(k + first) % 2].append(passage)
    return tuple(_some(sides[0])), tuple(_some(sides[1]))


def _some(passages: Sequence[Passage]) -> list[Passage]:
    """At most so many of them, from the first to the last."""
    if len(passages) <= MOST_LANDINGS:
        return list(passages)
    return [
        passages[k] for k in np.linspace(0, len(passages) - 1, MOST_LANDINGS).round().astype(int)
    ]


def _fits(run: Run, task: ContactTask, effects: Sequence[tuple[str, ...]]) -> list[ContactFit]:
    tasks = [(replace(task, effects=names),) for names in effects]
    found = run(fit_contact, tasks, 'landings that bounce or slide')
    return [fit for fit in found if isinstance(fit, ContactFit)]


def _verdict(
    task: ContactTask,
    base: ContactFit,
    fits: Sequence[ContactFit],
    found: int,
    believed: Sequence[Impulse],
) -> Landings:
    passages = (*task.train, *task.held)
    first = len(task.train)
    leader = min([base, *fits], key=lambda f: f.chi2)
    steps = [float(np.median(np.diff(p.time))) for p in passages]
    independent = independent_samples(leader.residuals, steps)

    # What a wrong law leaves is correlated and says less than as many independent samples would.
    fits = [_surely(fit, independent_samples(fit.residuals, steps)) for fit in fits]

    def weight(fit: ContactFit) -> float:
        return evidence(fit.chi2, fit.samples, independent, len(fit.effects), fit.belief)

    rows = [max(1, round(block / float(np.median(steps)))) for block in BLOCKS_S]
    tried = sorted(
        (_judged(base, fit, first, weight(base) - weight(fit), rows) for fit in fits),
        key=lambda t: -t.evidence,
    )
    margin = max(settings.SELECTION.margin, settings.SELECTION.fidelity * independent / 2)
    single = [t for t in tried if len(t.effects) == 1 and not t.reason]
    both = [t for t in tried if len(t.effects) > 1 and not t.reason]
    accepted = single[0] if single else None
    if both and (
        accepted is None or both[0].evidence > accepted.evidence + settings.SELECTION.earned
    ):
        accepted = both[0]
    close = [
        t.effects[0] for t in single
        if accepted is not None and t is not accepted and len(accepted.effects) == 1
        and t.evidence > accepted.evidence - margin
    ]  # fmt: skip
    names = accepted.effects if accepted else ()
    final = next((f for f in fits if f.effects == names), base)
    # A law that explains the landings knows their instants better than the poses do.
    known = _error(final.residuals) < (1 + settings.SELECTION.material) ** 2
    impulses = _impulses(task, passages, final.own) if known else believed
    return Landings(
        found=found,
        judged=len(passages),
        stated=task.law,
        tried=tuple(tried),
        accepted=names,
        rivals=tuple(close),
        before=_per_output(base.residuals[first:]),
        after=_per_output(final.residuals[first:]),
        independent=independent,
        impulses=tuple(impulses),
    )


def _surely(fit: ContactFit, independent: float) -> ContactFit:
    factor = float(np.sqrt(max(1.0, fit.samples / independent)))
    return replace(
        fit,
        values={
            name: (value, float(np.hypot(factor * sigma, GIVEN * value)))
            for name, (value, sigma) in fit.values.items()
        },
    )


def _judged(
    base: ContactFit, fit: ContactFit, first: int, gained: float, rows: Sequence[int]
) -> LawTried:
    before, after = (_per_output(f.residuals[first:]) for f in (base, fit))
    errors = (_error(fit.residuals[:first]), _error(fit.residuals[first:]))
    was = (_error(base.residuals[:first]), _error(base.residuals[first:]))
    explained = float(np.sqrt(np.clip(before - after, 0, None)).max())
    significance = max(
        block_gain(base.residuals[first:], fit.residuals[first:], each) for each in rows
    )
    held_gain = 1 - errors[1] / was[1]
    reasons = []
    if gained < settings.SELECTION.earned:
        reasons.append(f'evidence {gained:.1f} nats, {settings.SELECTION.earned:g} needed')
    if significance < settings.SELECTION.significant or held_gain <= 0:
        reasons.append('no significant gain on landings held out')
    elif explained < NOTICEABLE:
        reasons.append(
            f'explains {explained:.2f} noise standard deviations, {NOTICEABLE:g} needed'
        )
    left = max(errors[1] - 1, 0.0)
    if left > LEFT * max(was[1] - 1, 0.0) and errors[1] > settings.NOISE.at_noise:
        reasons.append(f'leaves an error of {np.sqrt(errors[1]):.1f} noise standard deviations')
    reasons += _edges(fit)
    return LawTried(
        fit.effects,
        {
            name: {LIBRARY[name].parameters[0].name: (*fit.values[name], '1')}
            for name in fit.effects
        },
        fit.law, float(gained), float(held_gain), significance, explained, errors,
        '; '.join(reasons),
    )  # fmt: skip


def _edges(fit: ContactFit) -> list[str]:
    """Values that are no more than the absence of the effect, or the end of its range."""
    found = []
    for name, (value, sigma) in fit.values.items():
        p = LIBRARY[name].parameters[0]
        if FREE[name] == 'restitution' and value < max(TOO_SMALL * sigma, 2 * SMALLEST):
            found.append(f'{p.name} = {value:.3g} +- {sigma:.2g} is as good as none')
        elif value >= 0.99 * p.upper:
            found.append(f'{p.name} = {value:.3g} lies at the edge of its range')
    return found


def _at_noise(fit: ContactFit, first: int) -> bool:
    return all(
        (_per_output(part) < settings.NOISE.at_noise).all()
        for part in (fit.residuals[:first], fit.residuals[first:])
    )


def _per_output(residuals: Sequence[np.ndarray]) -> np.ndarray:
    stacked = np.vstack(residuals)
    seen = np.maximum(np.isfinite(stacked).sum(axis=0), 1)
    return np.nansum(stacked**2, axis=0) / seen


def _error(residuals: Sequence[np.ndarray]) -> float:
    return float(np.nanmean(np.vstack(residuals) ** 2))


def _impulses(
    task: ContactTask, passages: Sequence[Passage], owns: Sequence[np.ndarray]
) -> list[Impulse]:
    """What the jumps of the rates say by themselves, given what each landing has of its own."""
    found = []
    for passage, own in zip(passages, owns, strict=True):
        try:
            impulse = measure_impulse(task.model, passage, task.law, own, task.sigma)
        except DynamicsError:
            continue
        found += [impulse] if impulse is not None else []
    return found


def _starts(impulses: Sequence[Impulse]) -> dict[str, tuple[float, ...]]:
    """A first guess of the friction: where feet slide, impulses lie on the cone."""
    slanted = [
        abs(i.measured[0]) / i.measured[1]
        for i in impulses
        if i.measured[1] > SURE * np.sqrt(i.covariance[1, 1])
    ]
    if not slanted:
        return {}
    p = LIBRARY['foot_slip'].parameters[0]
    return {'foot_slip': (float(np.clip(np.quantile(slanted, ON_CONE), 0.05, 0.9 * p.upper)),)}
