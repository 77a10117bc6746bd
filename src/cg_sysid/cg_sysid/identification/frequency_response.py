"""Frequency response from torque to each sensor: where a machine is not rigid (seed 4.4).

    cg frequency-response BAG --model compass_gait_mit --out DIRECTORY

The response is estimated by Welch's method over windows of the record,

    H = S_yu / S_uu,   gamma^2 = |S_yu|^2 / (S_uu S_yy)                                (H1)
    sigma(|H|) / |H| = sqrt((1 - gamma^2) / (2 n gamma^2))      n windows, as if independent

and shown as an acceleration, omega^2 |H|, which for rigid bodies is level at high frequencies. A
resonance is a peak of it where the coherence gamma^2 is high. It is fitted by

    -omega^2 H = exp(-s tau) (r + c / (1 + 2 zeta s / w0 + s^2 / w0^2)),  s = i omega  (RES)

The encoder tells apart what a single sensor cannot: a transmission that bends shows in it, a bent
bracket of the IMU shows in the IMU alone. The thesis' picture (Fig. 4-12, 4-13), the magnitude
of a signal over time by high-pass, absolute value and low-pass, is `magnitude_trace`.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import yaml

from cg_description.model_file import write_atomically
from cg_dynamics.linearise import linearise, without_dry_friction
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_interfaces.channels import interface
from cg_sysid.progress import Bars
from cg_sysid.records.bags import read_bag
from cg_sysid.records.record import Record

WINDOW = 4.0  # s; resolves 0.25 Hz
BAND = (2.0, 25.0)  # Hz, in which a resonance is looked for
EXCITED = 1e-3  # of the largest spectral density of the torque
COHERENT = 0.6  # coherence below which a frequency does not count
PEAK = 2.0  # times the level beside it: less is no resonance
BESIDE = 2.5  # the level is taken this factor in frequency below the peak
CONFIDENCE = 1.96  # standard deviations of a 95 % interval


@dataclass(frozen=True)
class Response:
    """(H1) of one path.

    Attributes:
        channel: Output channel.
        frequency: In Hz, shape (n,).
        H: Output per torque, complex, shape (n,).
        coherence: gamma^2, shape (n,).
        sigma: Standard deviation of |H|, shape (n,).
    """

    channel: str
    frequency: np.ndarray
    H: np.ndarray
    coherence: np.ndarray
    sigma: np.ndarray

    @property
    def acceleration(self) -> np.ndarray:
        """Response of the angle's second derivative, complex, shape (n,), rad/s^2 per N m."""
        s = 2j * np.pi * self.frequency
        return self.H * (s if self.channel.endswith('rate') else s**2)


@dataclass(frozen=True)
class Resonance:
    """A peak, and (RES) fitted to it.

    Attributes:
        channel: Output channel that has it.
        frequency: w0 / 2 pi in Hz.
        frequency_sigma: Its standard deviation, Hz.
        damping_ratio: zeta.
        delay: tau in s.
        level: r + c, the acceleration per torque below the resonance, rad/s^2 per N m.
        height: Largest measured response over that beside the peak.
    """

    channel: str
    frequency: float
    frequency_sigma: float
    damping_ratio: float
    delay: float
    level: float
    height: float


def uniform(record: Record, channel: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Torque and one output on a regular grid, shapes (n,), and the sample time in s.

    The torque of a sample is the one that is held from it on.
    """
    time, values = record.samples(channel)
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], step)
    torque = next(iter(record.inputs.values()))
    held = np.searchsorted(record.time, grid + 1e-9, side='right') - 1
    return torque[np.maximum(held, 0)], np.interp(grid, time, values), step


def response(record: Record, channel: str, window: float = WINDOW) -> Response:
    """(H1) from the torque to one output.

    Args:
        record: An excited record.
        channel: One of its outputs.
        window: Length of a window in s.

    Raises:
        ValueError: The record is shorter than two windows, or its torque is zero.
    """
    u, y, step = uniform(record, channel)
    n = round(window / step)
    if len(u) < 2 * n:
        raise ValueError(
            f'record {record.name!r} lasts {len(u) * step:.3g} s; two windows of {window:g} s '
            'are needed'
        )
    if not np.any(u):
        raise ValueError(f'record {record.name!r} has no torque; there is no response')
    given: dict[str, Any] = {'fs': 1.0 / step, 'nperseg': n, 'detrend': 'linear'}
    frequency, S_uu = scipy.signal.welch(u, **given)
    _, S_yy = scipy.signal.welch(y, **given)
    _, S_uy = scipy.signal.csd(u, y, **given)
    windows = 2 * len(u) // n - 1
    # Half-overlapping Hann windows are worth 0.95 of as many independent ones (Welch, 1967).
    averages = max(1.0, 0.95 * windows)
    # What was not excited has no response, only leakage.
    keep = (frequency > 0) & (S_uu > EXCITED * S_uu.max()) & (S_yy > 0)
    H = S_uy[keep] / S_uu[keep]
    coherence = np.clip(np.abs(S_uy[keep]) ** 2 / (S_uu[keep] * S_yy[keep]), 1e-9, 1.0)
    sigma = np.abs(H) * np.sqrt((1.0 - coherence) / (2.0 * averages * coherence))
    # The hold delays by half a sample; that is the sampling's, not the machine's.
    H = H * np.exp(1j * np.pi * frequency[keep] * step)
    return Response(channel, frequency[keep], H, coherence, sigma)


def resonance(path: Response, band: tuple[float, float] = BAND) -> Resonance | None:
    """The highest peak in a band, fitted by (RES); None if nothing stands out.

    Args:
        path: A response.
        band: In Hz.
    """
    chosen = (path.frequency >= band[0]) & (path.frequency <= band[1])
    chosen &= path.coherence > COHERENT
    if chosen.sum() < 8:
        return None
    f, A = path.frequency[chosen], path.acceleration[chosen]
    size = np.abs(A)
    top = int(np.argmax(size))
    below, above = size[f < f[top] / BESIDE], size[f > f[top]]
    if not len(below) or not len(above):
        return None
    height = float(size[top] / np.median(below))
    if height < PEAK or size[top] / above.min() < PEAK:
        return None
    sigma = np.maximum(path.sigma[chosen] / np.abs(path.H[chosen]) * size, 0.02 * size)
    s = 2j * np.pi * f

    def model(p: np.ndarray) -> np.ndarray:
        w0, zeta, tau, r, c = p
        return np.exp(-s * tau) * (r + c / (1 + 2 * zeta * s / w0 + (s / w0) ** 2))

    def error(p: np.ndarray) -> np.ndarray:
        difference = (model(p) - A) / sigma
        return np.concatenate([difference.real, difference.imag])

    sign = float(np.sign(np.sum(A[f < f[top]].real))) or 1.0
    start = np.array([2 * np.pi * f[top], 0.05, 0.002, 0.0, sign * float(np.median(below))])
    low = [2 * np.pi * band[0], 1e-3, 0.0, -np.inf, -np.inf]
    high = [2 * np.pi * band[1], 1.0, 0.05, np.inf, np.inf]
    found = scipy.optimize.least_squares(
        error, start, bounds=(low, high), x_scale=np.maximum(np.abs(start), 1e-3), loss='soft_l1'
    )
    misfit = max(1.0, found.cost / len(f))
    spread = np.linalg.pinv(found.jac.T @ found.jac)[0, 0] * misfit
    w0, zeta, tau, r, c = found.x
    return Resonance(
        path.channel,
        float(w0 / (2 * np.pi)),
        float(np.sqrt(max(spread, 0.0)) / (2 * np.pi)),
        float(zeta),
        float(tau),
        float(r + c),
        height,
    )


def seat(found: dict[str, Resonance | None]) -> tuple[str, str]:
    """Where a resonance sits, and why: effect ('' if there is none) and one sentence.

    Args:
        found: Channel -> its resonance, of encoder and IMU.
    """
    encoder = found.get('hip_angle')
    imu = next((found[c] for c in ('imu_rate', 'imu_angle') if found.get(c)), None)
    if encoder is not None:
        return 'joint_flexibility', (
            f'the encoder resonates at {encoder.frequency:.2f} Hz: what bends lies in the '
            'transmission, between motor and joint'
        )
    if imu is not None:
        return 'imu_mount_flexibility', (
            f'the IMU resonates at {imu.frequency:.2f} Hz and the encoder does not: what bends '
            'carries the IMU'
        )
    return '', 'no path has a resonance'


def flexible_start(model: Model, setup: Setup, found: Resonance) -> Model:
    """The model with a flexible joint that resonates as was found, to start a diagnosis from.

    Below the resonance rotor and joint turn together, level = 1/(M + J); the rigid model gives M,
    the inertia that the hip sees, and w0^2 = k (1/J + 1/M).
    """
    rigid = without_dry_friction(model)
    m = len(rigid.mechanism.kinematics(setup).names)
    linear = linearise(rigid, setup, np.zeros(2 * m), np.zeros(1))
    hip = linear.C[list(rigid.mechanism.outputs).index('hip_angle'), :m]
    M = 1.0 / float(hip @ linear.B[m:, 0])
    J = max(1.0 / abs(found.level) - M, 0.05 * M)
    reduced = J * M / (J + M)
    w0 = 2 * np.pi * found.frequency
    return model.with_effect(
        'joint_flexibility',
        stiffness=reduced * w0**2,
        rotor_inertia=J,
        damping=max(2 * found.damping_ratio * w0 * reduced, 1e-3),
    )


def magnitude_trace(
    signal: np.ndarray, sample_time: float, high_pass: float = 5.0, low_pass: float = 1.0
) -> np.ndarray:
    """The thesis's trace of a signal's high-frequency magnitude: high-pass, abs, low-pass.

    Args:
        signal: Samples, shape (n,).
        sample_time: In s.
        high_pass: Cutoff in Hz of a fourth-order Butterworth filter.
        low_pass: Cutoff in Hz of a first-order filter.

    Returns:
        Amplitude of what a sine would need for that mean magnitude, shape (n,).
    """
    sections = scipy.signal.butter(4, high_pass, 'highpass', fs=1.0 / sample_time, output='sos')
    rectified = np.abs(scipy.signal.sosfilt(sections, signal - signal[0]))
    b, a = scipy.signal.butter(1, low_pass, fs=1.0 / sample_time)
    return scipy.signal.lfilter(b, a, rectified) * np.pi / 2


def analyse(record: Record) -> tuple[list[Response], dict[str, Resonance | None]]:
    """Responses of all outputs that move, and their resonances."""
    paths = [response(record, channel) for channel in record.outputs]
    return paths, {path.channel: resonance(path) for path in paths}


def draw(record: Record, paths: Sequence[Response], found, target: Path) -> None:
    """Magnitude with its 95 % interval, coherence, and the magnitude trace, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 9), layout='constrained')
    size, coherent, trace = figure.subplots(3, 1)
    # Below what the torque excites there is nothing to see: no sensor follows it there.
    heard = np.max([path.coherence for path in paths], axis=0) > COHERENT
    lowest = min(paths[0].frequency[heard], default=0.0)
    for path in paths:
        shown = (path.frequency >= lowest) & (path.frequency <= 2 * BAND[1])
        f, A = path.frequency[shown], np.abs(path.acceleration[shown])
        spread = CONFIDENCE * (path.sigma / np.abs(path.H))[shown] * A
        (line,) = size.loglog(f, A, label=path.channel)
        size.fill_between(f, np.maximum(A - spread, 1e-3 * A), A + spread, alpha=0.2)
        coherent.semilogx(f, path.coherence[shown], color=line.get_color())
        if found.get(path.channel):
            size.axvline(found[path.channel].frequency, color=line.get_color(), lw=0.5)
        _, y, step = uniform(record, path.channel)
        time = np.arange(len(y)) * step
        level = magnitude_trace(y, step)
        trace.plot(time, level / level.max(), color=line.get_color())
    size.set(ylabel='acceleration per torque, rad/s²/(N m)', title=record.name)
    size.legend()
    for axes in (size, coherent):
        axes.xaxis.set_major_formatter('{x:g}')
        axes.xaxis.set_minor_formatter('{x:g}')
        axes.tick_params(axis='x', which='minor', labelsize=7)
        axes.grid(which='both', alpha=0.2)
    coherent.set(xlabel='frequency, Hz', ylabel='coherence', ylim=(0, 1.02))
    trace.set(xlabel='time, s', ylabel='high-pass, abs, low-pass; of its largest')
    figure.savefig(target, dpi=120)


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `cg frequency-response`."""
    parser = argparse.ArgumentParser(
        prog='cg frequency-response',
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('bag', help='bag of an excited machine: a chirp or a multisine')
    parser.add_argument(
        '--model', help='rigid model, a file or a name; writes it with the resonance in it'
    )
    parser.add_argument('--out', type=Path, default=Path('.'), help='directory for the results')
    options = parser.parse_args(args)
    try:
        with Bars('cg frequency-response') as bars:
            bars('reading the recording', 0, 2)
            model = Model.load(options.model) if options.model else None
            known = interface(model.mechanism) if model else None
            record = read_bag(options.bag, mechanism=known)
            bars('finding resonances', 1, 2)
            paths, found = analyse(record)
        effect, why = seat(found)
    except (ValueError, OSError) as error:
        print(f'cg frequency-response: error: {error}', file=sys.stderr)
        return 2
    options.out.mkdir(parents=True, exist_ok=True)
    for channel, peak in found.items():
        print(f'{channel}: ' + ('no resonance' if peak is None else describe(peak)))
    print(why)
    facts = {
        'record': record.name,
        'effect': effect,
        'why': why,
        'resonances': {c: vars(peak) for c, peak in found.items() if peak is not None},
    }
    write_atomically(
        options.out / 'frequency_response.yaml', yaml.safe_dump(facts, sort_keys=False)
    )
    draw(record, paths, found, options.out / 'frequency_response.png')
    encoder = found.get('hip_angle')
    if model is not None and effect == 'joint_flexibility' and encoder is not None:
        flexible_start(model, record.setup, encoder).save(options.out / 'model.yaml')
    print(options.out / 'frequency_response.png')
    return 0


def describe(peak: Resonance) -> str:
    """One line about a resonance."""
    return (
        f'{peak.frequency:.2f} +- {CONFIDENCE * peak.frequency_sigma:.2f} Hz, damping ratio '
        f'{peak.damping_ratio:.3f}, {peak.height:.1f} times the level below, delay '
        f'{1e3 * peak.delay:.1f} ms'
    )


if __name__ == '__main__':
    raise SystemExit(main())
