"""HTML that cannot be broken by what it shows: every text is escaped, markup is a type."""

import html
from collections.abc import Iterable

VOID = ('br', 'col', 'hr', 'input', 'meta')


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


def tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """An element.

    Args:
        name: Name of the element.
        children: Markup is taken as it is, lists are flattened, None is left out, anything else
            is escaped.
        attributes: `class_` and `data_x` stand for `class` and `data-x`; None and False leave
            the attribute out, True sets it without a value.
    """
    words = [name]
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        key = key.rstrip('_').replace('_', '-')
        words.append(key if value is True else f'{key}="{html.escape(str(value))}"')
    if name in VOID:
        return Markup(f'<{" ".join(words)}>')
    return Markup(f'<{" ".join(words)}>{join(children)}</{name}>')


def column(*children: object, **attributes: object) -> Markup:
    """Header cell of a column."""
    return tag('th', *children, scope='col', **attributes)


def row(*children: object, **attributes: object) -> Markup:
    """Header cell of a row: what it is about."""
    return tag('th', *children, scope='row', **attributes)


def wide(label: str, *children: object) -> Markup:
    """What may be wider than the page: it scrolls by itself, by keyboard too.

    Args:
        label: What a screen reader calls it.
        children: See `tag`.
    """
    return tag('div', *children, class_='scroll', tabindex=0, role='region', aria_label=label)


def join(children: Iterable[object]) -> Markup:
    """Children as one piece of markup."""
    parts = []
    for child in children:
        if child is None:
            continue
        if isinstance(child, Markup):
            parts.append(str(child))
        elif isinstance(child, list | tuple):
            parts.append(str(join(child)))
        else:
            parts.append(html.escape(str(child), quote=False))
    return Markup(''.join(parts))
