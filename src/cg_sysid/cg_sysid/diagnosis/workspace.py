"""What all stages of a diagnosis work with: the data, the options, and what is known by now."""

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.result import Options
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.kept_fits import keeping
from cg_sysid.parallel import run_all
from cg_sysid.search import settings
from cg_sysid.search.model_selection import Comparison, ModelSelection
from cg_sysid.search.nuisance import nuisances
from cg_sysid.search.outcome import Outcome
from cg_sysid.search.ranking import Round, per_output
from cg_sysid.search.standings import SoFar, title_of
from cg_sysid.search.successive_halving import SuccessiveHalving
from cg_sysid.search.torque_screening import Scores

Progress = Callable[[str, int, int, str], None]
Structure = tuple[frozenset[str], frozenset[str]]  # labels of effects, names of small faults


class Workspace:
    """What one diagnosis works with, and what it knows by now.

    Args:
        model: The nominal model.
        train: Data sets to fit.
        held: Data sets held out.
        options: How.
        progress: Called with (what, done, total, best candidate so far in words).
        executor: Where candidates are fitted; None for local processes.
        deadline: When to answer with the best so far.

    Attributes:
        selection: Judges what was fitted.
        halving: Fits candidates, the promising ones further.
        so_far: Who leads.
        comparisons: By the labels of what was added, and whether small faults are allowed for.
        torques: What torques say of candidates, by the same.
        faulty: By the labels of what was added, the fit with small faults, taken up or not.
        thorough: Thorough fits by structure.
        joint: Fits to all records, or why there is none.
        law: What stands, with a law that sound machines follow (small_faults.sound_law).
        found: What stands, for an answer before the end.
        under_way: The base of the comparison under way.
        rounds: What was tried, in order.
        instead: Of a small fault, that something else explains as much; empty if nothing does.
        doubted: Cause -> small faults that explain as much.
    """

    def __init__(
        self,
        model: Model,
        train: Sequence[DataSet],
        held: Sequence[DataSet],
        options: Options,
        progress: Progress,
        executor: Executor | None,
        deadline: Deadline,
    ):
        self.deadline = deadline
        self.nominal, self.options, self.progress = model, options, progress
        self.train, self.held, self.executor = train, held, executor
        self.selection = ModelSelection(train, held)
        self.halving = SuccessiveHalving(train, held, self.carry_out)
        self.so_far = SoFar(frozenset(effect.label for effect in model.effects))
        self.comparisons: dict[tuple[frozenset[str], bool], Comparison] = {}
        self.torques: dict[tuple[frozenset[str], bool], Scores | None] = {}
        self.faulty: dict[frozenset[str], Outcome] = {}
        self.thorough: dict[Structure, Outcome] = {}
        self.joint: dict[Structure, Fit | Failure] = {}
        self.law: Outcome | None = None
        self.found: Outcome
        self.under_way: Outcome
        self.rounds: list[Round] = []
        self.instead = ''
        self.doubted: dict[str, Outcome] = {}

    def added(self, o: Outcome) -> frozenset[str]:
        """Labels of the effects that were put on top of the nominal model, less small faults."""
        return self.added_to(o.model) - nuisances(o.model, o.task.bounds)

    def added_to(self, model: Model) -> frozenset[str]:
        """Labels of the effects of a model that the nominal one has not."""
        stated = {effect.label for effect in self.nominal.effects}
        return frozenset(effect.label for effect in model.effects) - stated

    def setups(self) -> list[Setup]:
        """Of all data sets."""
        return [data_set.setup for data_set in (*self.train, *self.held)]

    def carry_out(self, function: Callable, arguments: list[tuple], what: str) -> list:
        """Independent pieces of work, side by side: the function's result for each arguments."""
        # Other machines have no such folder.
        kept = self.options.kept if self.executor is None else None
        return run_all(
            keeping, [(kept, function, *a) for a in arguments], self.options.workers,
            self.executor,
            lambda done, total, result: self.progress(what, done, total, self.best(result)),
        )  # fmt: skip

    def best(self, result: Any) -> str:
        """The best candidate after one more result, in words."""
        self.so_far.note(result)
        return self.so_far.best

    def note(self, comparison: Comparison, accepted: str) -> None:
        """Keep a comparison as a round of the answer, with what was accepted in it."""
        candidates = tuple(c for c, _ in comparison.ranked)
        title = title_of(self.added(comparison.base))
        self.rounds.append(
            Round(title, candidates, accepted, comparison.independent, comparison.aside)
        )

    def remaining(self, o: Outcome) -> dict[str, float]:
        """chi2/N of each output on held-out records."""
        names, errors = self.nominal.mechanism.outputs, per_output(o.held)
        return {name: float(error) for name, error in zip(names, errors, strict=True)}

    def left(self, o: Outcome) -> dict[str, float]:
        """Those of them that are above the noise."""
        return {
            c: v
            for c, v in self.remaining(o).items()
            if v > (1 + settings.SELECTION.material) ** 2
        }


def structure(o: Outcome) -> Structure:
    """What tells models apart: their effects, and what they may have of small faults."""
    return frozenset(e.label for e in o.model.effects), frozenset(o.task.bounds)
