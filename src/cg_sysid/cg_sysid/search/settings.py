"""Every threshold of the search, by stage: what it is, its unit, and where it comes from.

A stage reads its thresholds from the one instance of its class here, so that a bench can move them
(bench/thresholds.py). Those of learned terms and of experiment design stand in their own rooms.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Screening:
    """First looks at candidates, on an excerpt of the records: diagnosis.md, section 4.

    Attributes:
        lengths_s: Lengths of the excerpt of long records in s: the first of them in which the base
            fails.
        enough_s: Length of short records that is enough, all together, in s.
        fewest_records: Short records from each set-up, at least.
        iterations: Of a first look.
        heat: Of these, those that all starts of a candidate are given.
        hopeless: Times the error that matters, beyond which a candidate is given no more of them.
            A look that leaves so many times less than the base has left little.
        most_starts: Starts of one effect.
        followed: Starts that are worth a second look.
        following: Iterations of each of these on whole records, before the best of them is chosen.
        same: Ratio of the errors of two fits that may be one minimum.
        alike: Relative difference of an effect's parameters there.
        drawn: Ratio of the errors of a model with its laws drawn in two ways, from which the
            better is the machine's. Where much is missing they differ by hundredths, either way.
        clearly: Deviance (-2 log likelihood) of the torques by which what has states, as a rotor,
            is not simulated where it is worse than its rival, or waits where another is better.
    """

    lengths_s: tuple[float, ...] = (2.0, 5.0)
    enough_s: float = 10.0
    fewest_records: int = 6
    iterations: int = 16
    heat: int = 3
    hopeless: float = 100.0
    most_starts: int = 24
    followed: int = 3
    following: int = 8
    same: float = 1.01
    alike: float = 0.1
    drawn: float = 1.1
    clearly: float = 100.0


@dataclass(frozen=True)
class Fitting:
    """Fits to whole records.

    Attributes:
        iterations: Of a fit by itself.
        thorough_iterations: Of the thorough fit of what was found.
        last_iterations: From there on all records. One step of Gauss-Newton would be as good as
            what they know, were the cost quadratic that far.
    """

    iterations: int = 60
    thorough_iterations: int = 72
    last_iterations: int = 8


@dataclass(frozen=True)
class Noise:
    """When an error counts as noise, in chi2/N: noise alone gives 1, floors are known to tenths.

    Attributes:
        at_noise: Of each output, training and held out: up to here it is explained.
        quick: Of each output after a quick fit: up to here a thorough one may come to the noise.
        settled: Of a fit or a piece of a record: up to here nothing is left to find.
        nothing_left: Of all records: no record can hold an event of its own.
        much_wrong: From here on much is wrong with a model.
        quietest: Of an output of which nothing is wrong, at least.
        white: Share of independent samples from which a residual counts as white noise, [1].
        half_white: The same beside a cause or a law that sound machines follow: such laws are
            drawn roughly. Beside small faults nothing with states is sought from here on.
    """

    at_noise: float = 1.3
    quick: float = 3.0
    settled: float = 1.2
    nothing_left: float = 1.03
    much_wrong: float = 1.5
    quietest: float = 0.9
    white: float = 0.9
    half_white: float = 0.5


@dataclass(frozen=True)
class Prior:
    """When a number is in conflict with what the model file states.

    Attributes:
        conflict: Tolerances from the stated value.
    """

    conflict: float = 4.0


@dataclass(frozen=True)
class Halving:
    """Who is fitted further (successive halving): ratios of errors in chi2/N.

    Attributes:
        rungs: Iterations on whole records; after each only those go on that may still win.
        in_reach: Times the smallest error, from which a short or unfinished fit may still win.
        near: The same where that error is the noise.
        as_good: Times what is to be beaten, from which a candidate does not come up to it.
        hope: Times what the last rung gained, from which it may still win.
        favoured: Times what the best first look leaves above the noise, to be fitted first.
        mostly: An error that is so many times smaller is mostly explained.
        idle: Share of what the best explains: who explains less is idle beside it.
        belief: Times what beliefs cost the base, that a fit that is not at its end may be off.
        heavy: Cost from which a candidate is looked at when the others have been.
        first_few: Light candidates that may show that the base was in a local minimum.
        stands_out: Ratio of the errors of two joints' motions, from which what moves by itself is
            looked at on the worse of them before all others.
        fewest: Light candidates that are fitted to whole records whatever the first look says.
    """

    rungs: tuple[int, ...] = (8, 16, 36)
    in_reach: float = 10.0
    near: float = 3.0
    as_good: float = 1.2
    hope: float = 10.0
    favoured: float = 2.0
    mostly: float = 2.0
    idle: float = 0.3
    belief: float = 3.0
    heavy: int = 10
    first_few: int = 8
    stands_out: float = 4.0
    fewest: int = 5


@dataclass(frozen=True)
class Selection:
    """What an effect must show to be earned, and when rivals are a tie: diagnosis.md, section 4.

    Attributes:
        margin: Evidence in nats by which rivals are not told apart (odds of 400 to 1).
        fidelity: Share of chi2/N by which integrators and interpolation differ.
        thorough_fidelity: The same of thorough fits to all records; half their steps move chi2 by
            1e-6 of it.
        coarse_fidelity: The same of those that may be rivals and are then fitted thoroughly.
        rough_fidelity: The same where the best leaves more than white noise.
        earned: Nats that an effect must gain over the model without it (odds of 20 000 to 1).
        material: Error that it must explain, in standard deviations of the noise.
        half_seen: Of what has to be explained on held-out records, at least on those fitted to.
        significant: Standard errors by which the held-out error must fall, block by block.
        block_s: Length of these blocks in s.
        fewest_blocks: Short records are cut into shorter blocks for so many.
        shortest_block_s: But not below this, in s.
        accounts: Of the squared error above the noise: who takes less does not explain it.
        mishap: Of the error above the noise: what events of single records leave at most.
        remainder: Of the squared error that causes explain: up to here what they leave may be the
            shape of their laws, 3 % off. Who explains that leaves no more of it than `mishap`.
        says_more: Independent samples of a record for each value that it has of its own.
        too_small: Standard deviations within which an effect's size may be none at all.
        far_off: Squared error above the noise, in variances, that has other causes too.
        nearly_as_much: Of the squared error that a law explains: a simpler one, which it contains,
            is preferred from here on where that much is left.
    """

    margin: float = 6.0
    fidelity: float = 1.5e-3
    thorough_fidelity: float = 1e-4
    coarse_fidelity: float = 2e-2
    rough_fidelity: float = 2e-3
    earned: float = 10.0
    material: float = 1.0
    half_seen: float = 0.3
    significant: float = 2.5
    block_s: float = 0.5
    fewest_blocks: int = 20
    shortest_block_s: float = 0.1
    accounts: float = 0.5
    mishap: float = 1 / 3
    remainder: float = 1e-3
    says_more: float = 4.0
    too_small: float = 2.0
    far_off: float = 10.0
    nearly_as_much: float = 0.8


@dataclass(frozen=True)
class Events:
    """Events of single records, as pushes.

    Attributes:
        sure: Standard deviations from which an event is not chance.
        seekings: Times that instants are sought, each with better parameters.
        worth_seeking: Share of the error at which seeking again is not worth it.
        grid_s: Between instants that are tried, s.
        piece_s: Length of pieces of a record, in most of which nothing happens, s.
        kept: Share of the pieces that is kept at least.
        trimmings: Times that a fit chooses its pieces.
        piece_iterations: Of such a fit.
        before_s: Before a spoilt piece: what happened may have begun there, s.
        followed: Peaks from which a fit goes on.
        little: Error that an event explains, in standard deviations of the noise, up to which it
            may be an error of friction.
        of_friction: Share of the dry friction of a joint, below which it then is: real friction
            differs by more from place to place.
    """

    sure: float = 5.0
    seekings: int = 4
    worth_seeking: float = 0.9
    grid_s: float = 0.2
    piece_s: float = 2.0
    kept: float = 0.5
    trimmings: int = 3
    piece_iterations: int = 8
    before_s: float = 0.5
    followed: int = 3
    little: float = 5.0
    of_friction: float = 0.02


@dataclass(frozen=True)
class Doubt:
    """Small faults, deeper minima, and doubt about what was accepted.

    Attributes:
        deeper: Times that a base is asked for deeper minima.
        reviews: Passes of doubt over what was accepted.
        most_of_it: Share of the error that may be left for small faults to be taken up.
        shows: Standard deviations from which a small fault is there at all.
        clear: From which no fit without it need be asked: 112 nats, where `selection.earned` would
            do.
        level: Squared standard deviations within which two fits say the same of all data.
        from_afar: Times the best start's error, from which a start leads nowhere else at the
            noise.
        proposed: Experiments named for each cause with rivals.
        outstanding: Share of the squared error in one record that is worth a word.
        outstanding_times: And as many times its even share.
        nearly_all: Of the squared error above the noise: a cause of another shape than its law's,
            a law that sound machines follow, or who leaves so much of what a simpler one does.
            Small faults that waited for a cause in vain have to leave less.
        hard: Of the least rate over which friction may turn, up to which it turns as fast as that.
        as_found: Relative, within which the number that tells such a law sound stays from then on.
    """

    deeper: int = 3
    reviews: int = 4
    most_of_it: float = 0.7
    shows: float = 3.0
    clear: float = 15.0
    level: float = 1.0
    from_afar: float = 2.0
    proposed: int = 3
    outstanding: float = 0.2
    outstanding_times: int = 4
    nearly_all: float = 0.9
    hard: float = 1.01
    as_found: float = 0.01


SCREENING = Screening()
FITTING = Fitting()
NOISE = Noise()
PRIOR = Prior()
HALVING = Halving()
SELECTION = Selection()
EVENTS = Events()
DOUBT = Doubt()
