"""Numbers and names as people read them."""

import math
import re

MINUS = '\u2212'
THIN_SPACE = '\u202f'
RAISED = str.maketrans('-0123456789', '⁻⁰¹²³⁴⁵⁶⁷⁸⁹')
# Units that are read more easily with a prefix when the value is small.
PREFIXED = ('s', 'rad', 'rad/s', 'm', 'm/s')


def number(value: float | None, digits: int = 3) -> str:
    """A value to some significant digits; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return '\u2013'
    if value == 0:
        return '0'
    exponent = math.floor(math.log10(abs(value)))
    if -4 <= exponent < 4:
        text = f'{value:.{max(0, digits - 1 - exponent)}f}'
    elif 4 <= exponent < 7:
        rounded = round(value, digits - 1 - exponent)
        text = f'{rounded:,.0f}'.replace(',', THIN_SPACE)
    else:
        mantissa = value / 10.0**exponent
        text = f'{mantissa:.{digits - 1}f}e{exponent}'
    return text.replace('-', MINUS)


def plain_unit(unit: str) -> str:
    """A unit as printed: a ratio has none, `s^2` is s²."""
    if unit == '1':
        return ''
    return re.sub(r'\^(-?\d+)', lambda found: found[1].translate(RAISED), unit)


def measured(value: float | None, sigma: float | None, unit: str = '1') -> str:
    """A value with its standard deviation to two digits, such as `8.01 ± 0.05 ms`."""
    if value is None:
        return '\u2013'
    size = max(abs(value), sigma) if sigma is not None and math.isfinite(sigma) else value
    factor, unit = scaled(size, unit)
    value *= factor
    tail = f' {unit}' if unit else ''
    if sigma is None or not math.isfinite(sigma):
        return f'{number(value, 4)}{tail}'
    sigma *= factor
    if sigma <= 0:
        return f'{value:.5g}{tail}'.replace('-', MINUS)  # known for certain
    decimals = 1 - math.floor(math.log10(sigma))
    if decimals < 0 or decimals > 7:
        return f'{number(value, 4)} \u00b1 {number(sigma, 2)}{tail}'
    # Adding 0 turns a negative zero into a plain one.
    text = f'{round(value, decimals) + 0.0:.{decimals}f}'.replace('-', MINUS)
    return f'{text} \u00b1 {sigma:.{decimals}f}{tail}'


def scaled(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit in which a value is read easily: 0.008 s is 8 ms."""
    unit = plain_unit(unit)
    if unit in PREFIXED and 0 < abs(value) < 0.0995:
        return (1e3, f'm{unit}') if abs(value) >= 1e-4 else (1e6, f'\u00b5{unit}')
    return 1.0, unit


def effect_name(label: str) -> str:
    """Label of an effect in words: `sensor_delay@imu` is `sensor delay (imu)`."""
    name, _, at = label.partition('@')
    words = name.replace('_', ' ')
    return f'{words} ({at.replace("_", " ")})' if at else words


def listed(words: list[str], last: str = 'and') -> str:
    """`a, b and c`."""
    if len(words) < 2:
        return ''.join(words)
    return f'{", ".join(words[:-1])} {last} {words[-1]}'


def sentence(text: str) -> str:
    """With a capital first letter."""
    return text[:1].upper() + text[1:]


def off_by(error: float) -> str:
    """A mean squared error in squared standard deviations of the noise, in words."""
    return f'off by {error**0.5:.3g} times the noise'
