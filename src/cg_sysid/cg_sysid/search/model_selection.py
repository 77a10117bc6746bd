"""Is an effect earned? The judgement of candidates against the model that they extend.

The conditions and why they are what they are: diagnosis.md, section 4.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.effects.effect import Effect
from cg_dynamics.effects.external_push import ExternalPush
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.information_criterion import block_gain, evidence, independent_samples
from cg_sysid.search import settings
from cg_sysid.search.nuisance import as_sound_robots, faults_among
from cg_sysid.search.outcome import (
    Outcome,
    at_edge,
    chi2,
    events_of,
    own_parameters,
    prior_conflicts,
    shared_unknowns,
    sizes_of,
    too_small,
    undetermined_size,
)
from cg_sysid.search.ranking import Candidate, contains, per_output


@dataclass(frozen=True)
class Comparison:
    """All candidates on top of one base, judged, best first.

    Attributes:
        base: What they extend.
        ranked: Each candidate and the outcome of its fit.
        independent: Independent samples behind the evidence.
        margin: Evidence in nats by which rivals are not told apart.
        aside: Labels of those that were not fitted to whole records.
    """

    base: Outcome
    ranked: tuple[tuple[Candidate, Outcome], ...]
    independent: float
    margin: float
    aside: tuple[str, ...] = ()

    def winner(self) -> tuple[Candidate, Outcome] | None:
        """The best candidate that is earned, or a simpler one that it contains.

        The simpler one if that comes within the margin, or leaves hardly more, or explains nearly
        as much where most is unexplained still.
        """
        able = [pair for pair in self.ranked if not pair[0].reason]
        if not able:
            return None
        leader, best = able[0]
        simpler = [
            (candidate, o)
            for candidate, o in able
            if contains(leader.label, candidate.label)
            and (
                candidate.evidence > leader.evidence - self.margin
                or hardly_more(best, o)
                or self._nearly_as_much(best, o)
            )
        ]
        return simpler[0] if simpler else able[0]

    def _nearly_as_much(self, best: Outcome, simpler: Outcome) -> bool:
        """Whether a simpler effect explains nearly as much, and the better one far from all.

        An error of many times the noise has other causes too, and more numbers bend to those.
        """
        was, left, by_simpler = (above_noise(o) for o in (self.base, best, simpler))
        least = settings.SELECTION.nearly_as_much * (was - left)
        return left > settings.SELECTION.far_off and was - by_simpler > least

    def less(self, label: str, reason: str) -> 'Comparison':
        """The comparison with the candidate of that label turned down after all."""
        return replace(self, ranked=tuple(
            (replace(c, reason=reason) if c.label == label else c, o) for c, o in self.ranked
        ))  # fmt: skip

    def of(self, label: str) -> tuple[Candidate, Outcome] | None:
        """The candidate of that label."""
        return next((pair for pair in self.ranked if pair[0].label == label), None)

    def close_to(self, label: str, fidelity: float = 0.0) -> list[Candidate]:
        """Other earned candidates that come within the margin of this one, best first.

        Args:
            label: Of this one.
            fidelity: Share of chi2/N by which they may differ besides.
        """
        found = self.of(label)
        if found is None:
            return []
        least = found[0].evidence - max(self.margin, fidelity * self.independent / 2)
        return [
            c for c, _ in self.ranked if c.label != label and not c.reason and c.evidence > least
        ]


class ModelSelection:
    """Judges outcomes that were fitted on one split of records.

    Args:
        train: Data sets to fit.
        held: Data sets held out.

    Attributes:
        before_causes: chi2/N above the noise before there was any cause (`without_cause`).
    """

    def __init__(self, train: Sequence[DataSet], held: Sequence[DataSet]):
        data_sets = (*train, *held)
        self.first_held = len(train)
        self.data_sets = data_sets
        self.steps = [float(np.median(np.diff(data_set.time))) for data_set in data_sets]
        self.rows_per_block = max(1, int(block_s(held) / np.median(self.steps)))
        self.before_causes = np.inf

    def without_cause(self, base: Outcome) -> None:
        """Take note of what a base without any cause leaves: the least of them counts."""
        self.before_causes = min(self.before_causes, above_noise(base))

    def compare(
        self, base: Outcome, outcomes: Sequence[Outcome], to_all: Sequence[Fit | Failure] = ()
    ) -> Comparison:
        """Rank outcomes that extend a base.

        Args:
            base: What they extend.
            outcomes: To be ranked.
            to_all: Where all outcomes are thorough fits: of each the fit to all records, or why
                there is none. If all went through they rank the outcomes.
        """
        if not outcomes:
            return Comparison(base, (), 2.0, settings.SELECTION.margin)
        leader = min([base, *outcomes], key=chi2)
        independent = independent_samples(leader.residuals, self.steps)
        reference = _evidence(base, independent)
        joint = [f for f in to_all if isinstance(f, Fit)]
        if len(joint) < len(outcomes):
            found = [_evidence(o, independent) for o in outcomes]
        else:
            found = [
                evidence(f.squares, samples(o), independent, o.unknowns, f.belief + f.starts)
                for f, o in zip(joint, outcomes, strict=True)
            ]
        ranked = [
            (self.judge(base, o, reference - own, independent), o)
            for own, o in zip(found, outcomes, strict=True)
        ]
        ranked.sort(key=lambda pair: -pair[0].evidence)
        white = independent > settings.NOISE.white * samples(leader)
        fine = settings.SELECTION.thorough_fidelity if to_all else settings.SELECTION.fidelity
        fidelity = fine if white else settings.SELECTION.rough_fidelity
        margin = max(settings.SELECTION.margin, fidelity * independent / 2)
        if self._beliefs_decide(base):
            # Beliefs do, and those are rough: whatever relieves them is a rival.
            margin = float('inf')
        return Comparison(base, tuple(ranked), independent, margin)

    def judge(
        self, base: Outcome, o: Outcome, gained: float, independent: float = float('inf')
    ) -> Candidate:
        """One outcome against its base, `gained` nats of evidence better."""
        n = self.first_held
        significance = block_gain(base.residuals[n:], o.residuals[n:], self.rows_per_block)
        explained = explained_by(base, o)
        held_gain = 1 - o.held.normalised_error / base.held.normalised_error
        own = own_parameters(o)
        reasons = []
        if gained < settings.SELECTION.earned:
            reasons.append(f'evidence {gained:.1f} nats, {settings.SELECTION.earned:g} needed')
        reasons += self._gains_nothing(base, o, significance, held_gain, explained)
        reasons += self._takes_the_edge_off(base, o, independent)
        if any(u.each == 'record' for u in o.train.own) and explained < settings.EVENTS.little:
            reasons += within_friction(o)
        reasons += never_happens(o)
        # What sound robots have lies at the edge of what is a cause.
        reasons += as_sound_robots(o.label, own) or at_edge(o)
        # What takes most of the error acts, though its numbers may be known together only.
        most = _left(base, o) <= 1 - settings.SELECTION.accounts
        if at_noise(base) or not most or not _known_at_all(o):
            reasons += too_small(o) + undetermined_size(o)
        reasons += self._implausible(o)
        return Candidate(
            label=o.label,
            model=o.train.model,
            train=o.train,
            held=o.held,
            evidence=float(gained),
            held_gain=float(held_gain),
            significance=significance,
            explained=explained,
            parameters=own,
            reason='; '.join(reasons),
        )

    def _gains_nothing(
        self, base: Outcome, o: Outcome, significance: float, held_gain: float, explained: float
    ) -> list[str]:
        """That records held out do not show it, or too little."""
        if self._beliefs_decide(base):
            # No error is left to explain, but numbers that nobody believes.
            if prior_conflicts(o) or not (at_noise(o) or self._as_good(base, o)):
                return ['leaves numbers far from what the model file believes']
            return []
        if significance < settings.SELECTION.significant or held_gain <= 0:
            return ['no significant gain on held-out records']
        relieves = prior_conflicts(base) and not prior_conflicts(o)
        whitens = self.imitated(base) and self._white(o)
        if explained < settings.SELECTION.material and not relieves and not whitens:
            return [
                f'explains {explained:.2f} noise standard deviations, '
                f'{settings.SELECTION.material:g} needed'
            ]
        return []

    def _takes_the_edge_off(self, base: Outcome, o: Outcome, independent: float) -> list[str]:
        """That it can take a part of whatever is wrong, as what every record has of its own."""
        reasons = []
        left = _left(base, o)
        each = _own_values(o) / len(self.steps)
        eventful = any(u.each == 'record' for u in o.train.own)
        if eventful and independent < settings.SELECTION.says_more * each * len(self.steps):
            # With a push of its own a short record is matched whatever is wrong, held out or not.
            reasons.append(
                f'records of {independent / len(self.steps):.0f} independent samples cannot '
                f"judge {each:.0f} values of each record's own"
            )
        if at_noise(o) or left <= settings.SELECTION.mishap:
            return reasons
        if eventful:
            # A push in every record takes the edge off whatever is wrong all the time.
            reasons.append(
                f'leaves {100 * left:.0f} % of the error, at most '
                f'{100 * settings.SELECTION.mishap:.0f} % allowed'
            )
        elif self._is_remainder(base):
            # A law that is drawn otherwise leaves a little, and much takes the edge off that.
            share = 100 * float(np.sqrt(above_noise(base) / self.before_causes))
            reasons.append(
                f'leaves {100 * left:.0f} % of an error that is {share:.1g} % of what the causes '
                'before it explain: their laws may be so far off'
            )
        return reasons

    def _implausible(self, o: Outcome) -> list[str]:
        """That an effect's values are none of what it is named after."""
        effect = _tried(o)
        if effect is None or effect.slides(o.model.mechanism):
            return []
        prefix = f'{o.label}.'
        values = {n.removeprefix(prefix): v for n, v in o.train.model.values.items()
                  if n.startswith(prefix)}  # fmt: skip
        commands = o.model.mechanism.inputs
        torque = max(float(np.abs(t.inputs_for(commands)).max()) for t in self.data_sets)
        reason = effect.implausible(values, torque)
        return [reason] if reason else []

    def imitated(self, o: Outcome) -> bool:
        """True if small faults come to the noise, and what they leave is none.

        Many together imitate much, but hardly down to white noise.
        """
        faulty = bool(faults_among(o.model, o.task.bounds))
        return faulty and at_noise(o) and not self._white(o)

    def nothing_material(self, o: Outcome) -> bool:
        """True if so little is left that nothing could explain MATERIAL of it."""
        if prior_conflicts(o) or self.imitated(o):
            return False  # beliefs decide, or whiteness
        return _immaterial(o)

    def only_beliefs(self, o: Outcome) -> bool:
        """True if numbers that nobody believes explain all that could be material.

        What takes their place, as a payload that of an arm too heavy, lowers no error.
        """
        return bool(prior_conflicts(o)) and _immaterial(o)

    def _beliefs_decide(self, base: Outcome) -> bool:
        """True if no error of a base is left to explain."""
        return (at_noise(base) and not self.imitated(base)) or self.only_beliefs(base)

    def _as_good(self, base: Outcome, o: Outcome) -> bool:
        """Whether an outcome leaves no more than its base, as far as fits can tell."""
        more = np.array([o.train.normalised_error, o.held.normalised_error])
        error = np.array([base.train.normalised_error, base.held.normalised_error])
        return bool((more < (1 + settings.SELECTION.coarse_fidelity) * error).all())

    def to_be_earned(self, base: Outcome) -> float:
        """chi2/N of training records that a fit on top of a base has to come to, to be earned.

        It has to explain MATERIAL in one output of the records held out. Of those that it is
        fitted to it explains about as much; where they are almost at the noise, a part of that.
        """
        if prior_conflicts(base) or self.imitated(base):
            return np.inf
        count = base.train.count.sum(axis=0)
        error = base.train.normalised_error
        above = max(error - 1.0, 0.0)
        least = min(settings.SELECTION.material**2 * float(count.min() / count.sum()), above)
        if self._is_remainder(base):
            least = max(least, (1 - settings.SELECTION.mishap) * above)
        return error - settings.SELECTION.half_seen * least

    def _is_remainder(self, base: Outcome) -> bool:
        """Whether the laws of the causes, were they a little off, would leave as much."""
        most = settings.SELECTION.remainder * self.before_causes
        return 0 < above_noise(base) < most < np.inf

    def whiteness(self, o: Outcome) -> float:
        """Share of independent samples in what is left; 1 of white noise."""
        return independent_samples(o.residuals, self.steps) / samples(o)

    def _white(self, o: Outcome) -> bool:
        return self.whiteness(o) > settings.NOISE.white


def block_s(held: Sequence[DataSet]) -> float:
    """Length of the blocks that vote on records held out, s."""
    judged = sum(data_set.duration for data_set in held)
    shortest = max(judged / settings.SELECTION.fewest_blocks, settings.SELECTION.shortest_block_s)
    return min(settings.SELECTION.block_s, shortest)


def _immaterial(o: Outcome) -> bool:
    return bool(
        per_output(o.held).max() < settings.NOISE.quietest + settings.SELECTION.material**2
    )


def _left(base: Outcome, o: Outcome) -> float:
    """Share of the squared error above the noise that an effect leaves."""
    return above_noise(o) / max(above_noise(base), 1e-300)


def explained_by(base: Outcome, o: Outcome) -> float:
    """What an outcome explains of the base's error on held-out records, [sigma of the noise].

    In the output in which it is most.
    """
    less = per_output(base.held) - per_output(o.held)
    return float(np.sqrt(np.clip(less, 0, None)).max())


def share_explained(before: Fit, after: Fit) -> float:
    """Share of the squared error above the noise that is gone, 0 to 1."""
    gone = before.normalised_error - after.normalised_error
    return float(np.clip(gone / max(before.normalised_error - 1, 1e-9), 0, 1))


def never_happens(o: Outcome) -> list[str]:
    """That what happens in single records surely happened in none of them.

    A little of it in each takes the edge off whatever is wrong all the time.
    """
    effect = _tried(o)
    if effect is None or all(p.each != 'record' for p in effect.parameters):
        return []
    return [] if events_of(o, o.label) else ['there is no record in which it surely happened']


def _tried(o: Outcome) -> Effect | None:
    """The effect that an outcome extends its base by."""
    return next((e for e in o.model.effects if e.label == o.label), None)


def within_friction(o: Outcome) -> list[str]:
    """That a push does no more at any joint than what its dry friction may be off."""
    push = _tried(o)
    if not isinstance(push, ExternalPush):
        return []
    shared = {p.name: o.model.values[f'{o.label}.{p.name}'] for p in push.parameters if not p.each}
    largest, where = 0.0, ''
    for event in events_of(o, o.label).values():
        torques = push.torques({n: v for n, (v, _, _) in event.items()} | shared)
        for joint, torque in torques.items():
            value, sigma, _ = event[f'impulse_{joint}']
            if abs(value) > settings.EVENTS.sure * sigma:
                share = abs(torque) / (o.model.dry_friction(joint) or 1e-300)
                if share >= largest:
                    largest, where = share, joint
    if not where or largest > settings.EVENTS.of_friction:
        return []
    return [
        f'{100 * largest:.1g} % of the dry friction at {where}: that friction may be so far off'
    ]


def _known_at_all(o: Outcome) -> bool:
    """Whether a size of an effect exceeds its standard deviation."""
    own = own_parameters(o)
    return any(abs(own[size.name][0]) > own[size.name][1]
               for size in sizes_of(o) if size.name in own)  # fmt: skip


def above_noise(o: Outcome) -> float:
    """chi2/N of all records less that of noise."""
    return chi2(o) / samples(o) - 1


def _own_values(o: Outcome) -> float:
    """All that the records have of their own: initial motions, and what the effects add."""
    motions = sum(len(motion) - len(o.train.own) for motion in (*o.train.motions, *o.held.motions))
    return motions + o.unknowns - shared_unknowns(o.train, o.task.bounds)


def settled(o: Outcome) -> bool:
    """True if nothing is left to explain: no error, and no numbers that nobody believes."""
    return at_noise(o) and not prior_conflicts(o)


def at_noise(o: Outcome) -> bool:
    """True if every output is simulated down to noise, in training and on records held out."""
    return bool(
        (per_output(o.train) < settings.NOISE.at_noise).all()
        and (per_output(o.held) < settings.NOISE.at_noise).all()
    )


def hardly_more(o: Outcome, simpler: Outcome) -> bool:
    """Whether an outcome leaves nearly all of what a simpler one leaves above the noise.

    Where something else is wrong still, a law with more numbers takes a little of it, and hundreds
    of nats of many samples with it. They say nothing about that law.
    """
    least = settings.DOUBT.nearly_all * above_noise(simpler)
    return not at_noise(simpler) and above_noise(o) > least


def samples(o: Outcome) -> float:
    """Number of samples, training and held-out data sets together."""
    return float(o.train.count.sum() + o.held.count.sum())


def _evidence(o: Outcome, independent: float) -> float:
    return evidence(chi2(o), samples(o), independent, o.unknowns, o.belief)
