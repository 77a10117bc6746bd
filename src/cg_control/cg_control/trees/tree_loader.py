"""Loading a tree beside a loop that must not wait for it."""

import threading

from cg_control.trees.recovery import ReadyTree
from cg_control.trees.tree_files import TreeSelection
from cg_dynamics.model import Model


class TreeLoader:
    """Loads the tree that was selected last, in a thread of its own.

    Args:
        model: The robot as it is known.
        grown_for: Trees of other models are refused.
        sample_time: Over which the torque is held, s.
    """

    def __init__(self, model: Model, grown_for: Model, sample_time: float):
        self._model, self._grown_for, self._sample_time = model, grown_for, sample_time
        self._lock = threading.Lock()
        self._asked = 0
        self._found: ReadyTree | ValueError | None = None

    def ask(self, selection: TreeSelection) -> None:
        """Load a tree; whatever was asked before is of no interest any more."""
        with self._lock:
            self._asked += 1
            self._found = None
            number = self._asked
        threading.Thread(
            target=self._load, args=(number, selection), name='tree loader', daemon=True
        ).start()

    def collect(self) -> ReadyTree | None:
        """The tree that was asked for, once, as soon as it is there. Never waits.

        Raises:
            TreeError: It could not be loaded.
        """
        if self._found is None:
            return None
        with self._lock:
            found, self._found = self._found, None
        if isinstance(found, ValueError):
            raise found
        return found

    def _load(self, number: int, selection: TreeSelection) -> None:
        found: ReadyTree | ValueError
        try:
            tree = selection.load(self._grown_for)
            found = ReadyTree.of(tree, self._model, self._sample_time)
        except ValueError as error:
            found = error
        with self._lock:
            if number == self._asked:
                self._found = found
