"""Where model files are: those that come along, by name, and any other by its path."""

from pathlib import Path

from cg_description.model_file import ModelFileError
from cg_description.reading import path_of

NOMINAL_MODEL = 'compass_gait_mit'  # where no model is named


def models_directory() -> Path:
    """The directory of the model files: beside the sources, or in the share directory."""
    package = Path(__file__).resolve().parent
    candidates = [package.parent / 'models']
    # colcon installs to <prefix>/lib/pythonX.Y/site-packages/cg_description and pip the same way;
    # both put data files under <prefix>/share.
    candidates += [parent / 'share' / 'cg_description' / 'models' for parent in package.parents]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise ModelFileError(f'no models directory beside or above {package}')


def model_path(name: str | Path) -> Path:
    """The model file that is meant: one that comes along, by its name, or any other by its path.

    Args:
        name: A path, `~` included, or a name such as 'compass_gait_mit'. A file of that name in
            the working directory comes first.

    Raises:
        ModelFileError: There is neither; with the path that was tried and the names there are.
    """
    path = path_of(name, ModelFileError)
    if path.exists() and not path.is_dir():
        return path
    shipped = models_directory() / f'{name}.yaml'
    if shipped.parent == models_directory() and shipped.is_file():
        return shipped
    raise ModelFileError(
        f'no model {str(name)!r}: there is no file {path.absolute()}, and those that come along '
        f'are called {", ".join(model_names())}'
    )


def model_names() -> list[str]:
    """Names of the model files that come along."""
    return sorted(path.stem for path in models_directory().glob('*.yaml'))
