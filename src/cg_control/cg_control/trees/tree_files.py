"""Where trees are, and one that is selected: by name, by path, by the hash of its file."""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from cg_control.trees.tree import LARGEST_FILE, Tree, TreeError
from cg_description.reading import parse_json, path_of
from cg_dynamics.model import Model


def trees_directory() -> Path:
    """The directory of the trees that come along: beside the sources, or in share/cg_control."""
    package = Path(__file__).resolve().parents[1]
    candidates = [package.parent / 'trees']
    candidates += [parent / 'share' / 'cg_control' / 'trees' for parent in package.parents]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise TreeError(f'no directory of trees beside or above {package}')


def tree_names() -> list[str]:
    """Names of the trees that come along."""
    return sorted(path.stem for path in trees_directory().glob('*.npz'))


def tree_path(name: str | Path) -> Path:
    """The tree that is meant: one that comes along, by its name, or any other by its path.

    Args:
        name: A path, `~` included, or a name such as 'compass_gait_mit'. A file of that name in
            the working directory comes first.

    Raises:
        TreeError: There is neither; with the path that was tried and the names there are.
    """
    path = path_of(name, TreeError)
    if path.is_file():
        return path
    shipped = trees_directory() / f'{name}.npz'
    if shipped.parent == trees_directory() and shipped.is_file():
        return shipped
    raise TreeError(
        f'no tree {str(name)!r}: there is no file {path.absolute()}, and those that come along '
        f'are called {", ".join(tree_names())}'
    )


@dataclass(frozen=True)
class TreeSelection:
    """A file that holds a tree: what /tree/selected says.

    Attributes:
        path: The file, absolute.
        sha256: Of its bytes, in hexadecimal digits.
    """

    path: str
    sha256: str

    @classmethod
    def of(cls, path: Path) -> 'TreeSelection':
        """The file as it is now.

        Raises:
            TreeError: It cannot be read, or is no file of a size that a tree can have.
        """
        digest = hashlib.sha256()
        try:
            # The name may come in a message: a device or a pipe would never end.
            if path.exists() and not path.is_file():
                raise TreeError(f'{path}: not a file')
            if path.stat().st_size > LARGEST_FILE:
                raise TreeError(f'{path}: larger than {LARGEST_FILE} bytes, the most allowed')
            with path.open('rb') as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        except OSError as error:
            raise TreeError(f'{path}: {error.strerror or error}') from None
        return cls(str(path.absolute()), digest.hexdigest())

    @classmethod
    def from_text(cls, text: str) -> 'TreeSelection':
        """What `text` wrote.

        Raises:
            TreeError: It is not a selection.
        """
        given = parse_json(text, 'selection', TreeError)
        if not isinstance(given, dict) or not all(
            isinstance(given.get(name), str) for name in ('path', 'sha256')
        ):
            raise TreeError('selection: path and sha256 are needed, both texts')
        return cls(given['path'], given['sha256'])

    def text(self) -> str:
        """As JSON."""
        return json.dumps(asdict(self))

    def load(self, model: Model) -> Tree:
        """The tree.

        Raises:
            TreeError: The file is none of this robot, or has changed since it was selected.
        """
        path = path_of(self.path, TreeError)
        if TreeSelection.of(path).sha256 != self.sha256:
            raise TreeError(f'{path}: the file has changed since it was selected; load it again')
        return Tree.load(path, model)
