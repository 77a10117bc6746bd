"""The learned term: its function as a picture, and what it says.

The picture is drawn here, once: it needs no interaction and stands on its own when printed.
"""

import math

from cg_sysid.diagnosis.summary import INTERVAL
from cg_sysid.report.markup import Markup, tag
from cg_sysid.report.wording import Facts
from cg_sysid.text import number, scaled

WIDTH, HEIGHT = 460, 230
LEFT, RIGHT, TOP, BOTTOM = 54, 8, 24, 40
TICKS = 5


def unmodelled(facts: Facts) -> Markup | None:
    """The card of what no effect explains; None where there is no such term."""
    term = facts.get('unmodelled')
    if term is None:
        return None
    title = 'What no effect explains' if not facts['causes'] else 'What remains'
    rivals = [
        tag('div', tag('b', 'Could also be '), rival['what'], class_='rival')
        for rival in term['rivals']
    ]
    return tag('div',
        tag('h2', title),
        tag('p', term['text']),
        picture(term),
        tag('p', 'Learned function (line), its 95 % band, where there are recordings (shaded)',
            ', one period.' if term['period'] else '.',
            ' It is no cause but a description; learned.yaml is the model with it.',
            class_='soft small'),
        _gain(term),
        tag('p', tag('span', term['label'], class_='mono soft'), class_='small'),
        rivals,
        class_='card', id='unmodelled',
    )  # fmt: skip


def _gain(term: Facts) -> Markup | None:
    """The error with the term in the model, where it was most above the noise."""
    if not term['gain']:
        return None
    channel = max(term['gain'], key=lambda c: _above_noise(term['gain'][c]))
    gain = term['gain'][channel]
    factor, unit = scaled(gain['before'], gain['unit'])
    before, after = (number(factor * gain[key]) for key in ('before', 'after'))
    return tag('p', f'With it the error of {channel} on held-out recordings falls from '
               f'{before} to {after} {unit}.', class_='soft small')  # fmt: skip


def _above_noise(gain: Facts) -> float:
    return (gain['before'] or 0.0) / (gain['noise_floor'] or 1.0)


def picture(term: Facts) -> Markup:
    """The function with its band over what it follows, as SVG."""
    f = term['function']
    keep = [k for k, value in enumerate(f['sigma']) if value is not None]
    s, g, sigma = ([f[name][k] for k in keep] for name in ('s', 'value', 'sigma'))
    size = max((abs(y) for y, ok in zip(g, f['seen'], strict=False) if ok), default=1.0) or 1.0
    factor, unit = scaled(size, term['unit'])
    across, across_unit = scaled(max(abs(s[0]), abs(s[-1])), term['variable_unit'])
    # A band that nothing holds must not flatten what is known.
    widest = max(abs(y) + INTERVAL * e for y, e in zip(g, sigma, strict=True))
    top = 1.25 * max(size, min(2 * size, widest))
    low = -top if min(g) < -0.1 * size else -0.15 * top
    high = top if max(g) > 0.1 * size else 0.15 * top

    def x(value: float) -> float:
        return LEFT + (value - s[0]) / (s[-1] - s[0]) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        value = min(max(value, low), high)
        return TOP + (high - value) / (high - low) * (HEIGHT - TOP - BOTTOM)

    def path(points: list[tuple[float, float]]) -> str:
        return 'M' + 'L'.join(f'{x(a):.1f},{y(b):.1f}' for a, b in points)

    upper = [(a, b + INTERVAL * e) for a, b, e in zip(s, g, sigma, strict=True)]
    lower = [(a, b - INTERVAL * e) for a, b, e in zip(s, g, sigma, strict=True)]
    parts = [
        *_seen(s, [f['seen'][k] for k in keep], x),
        *axis_ticks(s[0], s[-1], across, lambda v, text: (
            tag('line', x1=x(v), x2=x(v), y1=TOP, y2=HEIGHT - BOTTOM, class_='rule'),
            tag('text', text, x=x(v), y=HEIGHT - BOTTOM + 15, text_anchor='middle'))),
        *axis_ticks(low, high, factor, lambda v, text: (
            tag('line', x1=LEFT, x2=WIDTH - RIGHT, y1=y(v), y2=y(v), class_='rule'),
            tag('text', text, x=LEFT - 6, y=y(v) + 4, text_anchor='end'))),
        tag('path', d=path([*upper, *reversed(lower)]) + 'Z', class_='band'),
        tag('path', d=path(list(zip(s, g, strict=True))), class_='curve'),
        tag('text', f'{term["follows_words"]} [{across_unit or "1"}]',
            x=(LEFT + WIDTH - RIGHT) / 2, y=HEIGHT - 6, text_anchor='middle', class_='label'),
        tag('text', unit or '1', x=4, y=TOP - 10, class_='label'),
    ]  # fmt: skip
    return tag('svg', parts, viewBox=f'0 0 {WIDTH} {HEIGHT}', role='img', class_='function',
               aria_label=term['text'])  # fmt: skip


def _seen(s: list[float], seen: list[bool], x) -> list[Markup]:
    """Shades where there are recordings."""
    step = (s[-1] - s[0]) / max(len(s) - 1, 1)
    found, start = [], None
    for value, here in [*zip(s, seen, strict=True), (s[-1] + step, False)]:
        if here and start is None:
            start = value
        elif not here and start is not None:
            a, b = x(max(start - step / 2, s[0])), x(min(value - step / 2, s[-1]))
            found.append(tag('rect', x=f'{a:.1f}', y=TOP, width=f'{max(b - a, 0):.1f}',
                             height=HEIGHT - TOP - BOTTOM, class_='seen'))  # fmt: skip
            start = None
    return found


def axis_ticks(low: float, high: float, factor: float, draw) -> list[Markup]:
    """Round values of an axis, each drawn by `draw(value, text)`."""
    span = (high - low) * factor
    rough = 10 ** math.floor(math.log10(span / TICKS))
    step = next(rough * m for m in (1, 2, 5, 10) if span / (rough * m) <= TICKS)
    first = math.ceil(low * factor / step - 1e-9)
    last = math.floor(high * factor / step + 1e-9)
    found = []
    for k in range(first, last + 1):
        digits = max(1, 1 + math.floor(math.log10(abs(k)))) if k else 1
        found += draw(k * step / factor, number(k * step, max(2, digits)))
    return found
