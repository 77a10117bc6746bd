"""effects.md is what the library would write today."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]


def test_page_is_up_to_date():
    tool = ROOT / 'tools' / 'make_effects_doc.py'
    if not tool.exists():
        pytest.skip('the page and its tool come with the sources of the workspace')
    spec = importlib.util.spec_from_file_location('make_effects_doc', tool)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    message = 'run python tools/make_effects_doc.py'
    assert module.TARGET.read_text(encoding='utf-8') == module.page(), message
