"""Write docs/reference/api.md from what is public: ./cg exec python tools/make_api_doc.py."""

from pathlib import Path

TARGET = Path(__file__).resolve().parents[1] / 'docs/reference/api.md'


def page() -> str:
    """The page: one entry for each public name, at the place where it is defined."""
    import cg_sysid

    places = []
    for name in cg_sysid.__all__:
        item = getattr(cg_sysid, name)
        places.append(f'::: {item.__module__}.{item.__qualname__}')
    return '\n'.join([
        '# Python API', '', 'From the docstrings; `make docs` fills this page. What is public, by '
        'use: [python](python.md).', '', *places, '',
    ])  # fmt: skip


if __name__ == '__main__':
    TARGET.write_text(page(), encoding='utf-8')
