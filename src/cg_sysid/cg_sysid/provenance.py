"""Where a result comes from: model, software, options, command line."""

import hashlib
import platform
from collections.abc import Iterable, Mapping, Sequence
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


def of_model(
    made_by: str,
    origin: Mapping[str, Any],
    parent: Mapping[str, Any],
    records: Iterable[Mapping[str, Any]],
    **more: Any,
) -> dict[str, Any]:
    """Provenance of a model that was made of another one and of recordings.

    Args:
        made_by: Command that made it.
        origin: Of the result (provenance()).
        parent: Provenance of the model that it was made of.
        records: Those that were used: 'name' and 'sha256'; other fields are left out.
        more: What else is to be told.
    """
    return {
        'made_by': made_by,
        'created': origin['created'],
        'parent': Path(origin['model_file']).name,
        'parent_sha256': origin['model_sha256'],
        **more,
        'records': [{'name': s['name'], 'sha256': s['sha256']} for s in records],
        'parent_provenance': dict(parent),
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
