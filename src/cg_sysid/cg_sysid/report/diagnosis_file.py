"""diagnosis.json and identification.json: their names, written and read (diagnosis_json.md)."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cg_description.model_file import write_atomically
from cg_description.reading import JSON, parse_json, read_text
from cg_description.schema import Key, Text
from cg_description.schema import Mapping as Form

DIAGNOSIS = 'cg_diagnosis/1'
IDENTIFICATION = 'cg_identification/1'
FILE_NAMES = {DIAGNOSIS: 'diagnosis.json', IDENTIFICATION: 'identification.json'}
VERDICTS = (
    'consistent', 'explained', 'ambiguous', 'unexplained', 'unfinished', 'unusable', 'identified',
)  # fmt: skip

Facts = dict[str, Any]


def write_facts(facts: Facts, directory: str | Path) -> Path:
    """Write diagnosis.json or identification.json, whole or not at all."""
    path = Path(directory) / FILE_NAMES[facts['format']]
    text = json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(path, text + '\n')
    return path


def read_facts(directory: str | Path) -> Facts:
    """Read what `write_facts` wrote.

    Raises:
        ValueError: There is none in the directory, or it has another format.
    """
    directory = Path(directory)
    for form, name in FILE_NAMES.items():
        path = directory / name
        if not path.is_file():
            continue
        schema = Form({'format': Key(Text((form,)))}, further=True)
        text = read_text(path, limits=JSON)
        return schema.of(parse_json(text, str(path)), str(path))
    raise ValueError(f'{directory}: neither {" nor ".join(FILE_NAMES.values())} in it')


def plain(value: Any) -> Any:
    """The same as types of JSON; numbers that are not finite become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple | set):
        return [plain(entry) for entry in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value if value is None else str(value)
