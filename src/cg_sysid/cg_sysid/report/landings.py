"""The landings of a walking robot: measured impulses beside those of plastic impacts."""

import math

from cg_sysid.diagnosis.summary import INTERVAL
from cg_sysid.report.function import axis_ticks
from cg_sysid.report.markup import Markup, tag
from cg_sysid.report.wording import Facts

WIDTH, HEIGHT = 460, 260
LEFT, RIGHT, TOP, BOTTOM = 54, 8, 24, 40
SURE = 0.5  # of the largest impulse; what is known worse is left out of the picture


def landings(facts: Facts) -> Markup | None:
    """The card of the landings; None where there are none."""
    found = facts.get('landings')
    if found is None:
        return None
    cone = found['law']['friction'] is not None
    return tag('div',
        tag('h2', f'{found["judged"]} landings'),
        tag('p', found['text']),
        picture(found),
        tag('p', 'Impulse of the ground on each landing foot over its first 20 ms, measured by '
            'the jump of the rates (dots with their 95 % crosses), and what a plastic impact '
            'would give (rings).',
            ' The lines are the cone of friction.' if cone else None, class_='soft small'),
        class_='card', id='landings',
    )  # fmt: skip


def picture(found: Facts) -> Markup | None:
    """Impulses along the ground and off it, as SVG."""
    size = max((math.hypot(*i['plastic']) for i in found['impulses']), default=0.0)
    known = [
        i
        for i in found['impulses']
        if max(i['covariance'][0][0], i['covariance'][1][1]) < (SURE * size) ** 2
    ]
    if not known:
        return None
    spread = [math.sqrt(i['covariance'][0][0]) for i in known]
    lift = [math.sqrt(i['covariance'][1][1]) for i in known]
    along = [i['along'] for i in known] + [i['plastic'][0] for i in known]
    off = [i['off'] for i in known] + [i['plastic'][1] for i in known]
    left, right = 1.15 * min(0.0, *along) - 0.3, 1.15 * max(0.0, *along) + 0.3
    low, high = min(0.0, *off) - 0.3, 1.15 * max(off)

    def x(value: float) -> float:
        value = min(max(value, left), right)
        return LEFT + (value - left) / (right - left) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        value = min(max(value, low), high)
        return TOP + (high - value) / (high - low) * (HEIGHT - TOP - BOTTOM)

    def line(a: float, b: float, c: float, d: float, kind: str) -> Markup:
        return tag('line', x1=f'{x(a):.1f}', y1=f'{y(b):.1f}', x2=f'{x(c):.1f}',
                   y2=f'{y(d):.1f}', class_=kind)  # fmt: skip

    parts = [
        *axis_ticks(left, right, 1.0, lambda v, text: (
            line(v, low, v, high, 'rule'),
            tag('text', text, x=x(v), y=HEIGHT - BOTTOM + 15, text_anchor='middle'))),
        *axis_ticks(low, high, 1.0, lambda v, text: (
            line(left, v, right, v, 'rule'),
            tag('text', text, x=LEFT - 6, y=y(v) + 4, text_anchor='end'))),
    ]  # fmt: skip
    friction = found['law']['friction']
    if friction is not None:
        for side in (left, right):
            reach = min(high, abs(side) / friction)
            parts.append(line(0.0, 0.0, math.copysign(friction * reach, side), reach, 'curve'))
    for i, a, b in zip(known, spread, lift, strict=True):
        p, q = i['along'], i['off']
        parts += [
            line(p - INTERVAL * a, q, p + INTERVAL * a, q, 'measured'),
            line(p, q - INTERVAL * b, p, q + INTERVAL * b, 'measured'),
            tag('circle', cx=f'{x(p):.1f}', cy=f'{y(q):.1f}', r=3, class_='dot'),
            tag('circle', cx=f'{x(i["plastic"][0]):.1f}', cy=f'{y(i["plastic"][1]):.1f}', r=4.5,
                class_='ring'),
        ]  # fmt: skip
    parts += [
        tag('text', 'along the ground [N s]', x=(LEFT + WIDTH - RIGHT) / 2, y=HEIGHT - 6,
            text_anchor='middle', class_='label'),
        tag('text', 'off the ground [N s]', x=4, y=TOP - 10, class_='label'),
    ]  # fmt: skip
    return tag('svg', parts, viewBox=f'0 0 {WIDTH} {HEIGHT}', role='img',
               class_='function impulses', aria_label=found['text'])  # fmt: skip
