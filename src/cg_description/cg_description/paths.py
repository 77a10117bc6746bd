"""Where the installed model files are."""

from pathlib import Path

from cg_description.model_file import ModelFileError


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


def model_path(name: str) -> Path:
    """Path of the model file called name, e.g. 'compass_gait_mit'."""
    directory = models_directory()
    path = directory / f'{name}.yaml'
    if not path.is_file():
        known = ', '.join(sorted(p.stem for p in directory.glob('*.yaml')))
        raise ModelFileError(f'no model called {name!r}; there are: {known}')
    return path
