"""Where a result comes from: model, software, options, command line."""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ('cg_sysid', 'cg_dynamics', 'cg_description', 'numpy', 'scipy', 'casadi', 'rosbags')


def provenance(
    model_file: str | Path,
    command: Sequence[str],
    options: Mapping[str, Any],
    created: str | None = None,
) -> dict[str, Any]:
    """What is needed to do the same again.

    Args:
        model_file: The model file that was given.
        command: Program and arguments.
        options: Options in effect, defaults included; plain values only.
        created: ISO 8601 date and time; now if it is None.
    """
    return {
        'created': created or datetime.now(timezone.utc).isoformat(timespec='seconds'),
        'model_file': str(model_file),
        'model_sha256': hashlib.sha256(Path(model_file).read_bytes()).hexdigest(),
        'command': list(command),
        'options': dict(options),
        'software': software(),
    }


def software() -> dict[str, str]:
    """Versions of what took part."""
    versions = {'python': platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = 'source tree'
    return versions
