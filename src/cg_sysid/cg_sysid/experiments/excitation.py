"""Excitation signals: torque in N m as a function of time in s. Pure; no ROS.

A signal is a function of time, so that it can be sampled at the stamps of the measurements it
answers, whatever their rate. Every signal is zero outside its duration.
"""

import csv
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cg_description.reading import JSON, read_text, shown
from cg_interfaces.settings import Settings, setting

KINDS = ('none', 'multisine', 'chirp', 'steps', 'file')
PHASE_DRAWS = 64  # random phase sets, of which the one with the lowest peak is taken

Signal = Callable[[float], float]


class CommandFileError(ValueError):
    """A command file that cannot be played; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class ExcitationSettings(Settings):
    """Parameters of an excitation."""

    kind: str = setting('multisine', 'shape of the torque', choices=KINDS)
    duration: float = setting(20.0, 'length of the signal', unit='s', minimum=0.0)
    amplitude: float = setting(
        5.0,
        'RMS of a multisine, amplitude of a chirp, largest step',
        unit='N m',
        minimum=0.0,
        maximum=200.0,
    )
    f_min: float = setting(0.1, 'lowest frequency', unit='Hz', minimum=0.0, maximum=200.0)
    f_max: float = setting(4.0, 'highest frequency', unit='Hz', minimum=0.01, maximum=200.0)
    dwell: float = setting(0.5, 'mean time between steps', unit='s', minimum=0.01)
    ramp: float = setting(
        0.2,
        'time over which the torque grows at the start and dies at the end',
        unit='s',
        minimum=0.0,
        maximum=10.0,
    )
    seed: int = setting(1, 'seed of phases and steps', minimum=0)
    file: str = setting('', 'CSV file to play: columns time in s, torque in N m')

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.kind in ('multisine', 'chirp') and self.f_min >= self.f_max:
            raise ValueError(f'f_min is {self.f_min} Hz; it must lie below f_max, {self.f_max} Hz')
        if self.kind == 'file' and not self.file:
            raise ValueError('file is empty; excitation kind file needs a CSV file')


def make_signal(settings: ExcitationSettings) -> Signal:
    """The signal that the settings describe.

    Raises:
        ValueError: The file to play is missing or wrong.
    """
    makers = {
        'none': lambda _: lambda time: 0.0,
        'multisine': _multisine,
        'chirp': _chirp,
        'steps': _steps,
        'file': lambda settings: playback(Path(settings.file)),
    }
    signal = makers[settings.kind](settings)
    if settings.kind in ('none', 'file'):
        return _within(signal, settings.duration)
    return _within(_ramped(signal, settings.duration, settings.ramp), settings.duration)


def _within(signal: Signal, duration: float) -> Signal:
    return lambda time: signal(time) if 0.0 <= time < duration else 0.0


def _ramped(signal: Signal, duration: float, ramp: float) -> Signal:
    """The signal with a raised-cosine start and end."""
    if ramp == 0.0:
        return signal

    def ramped(time: float) -> float:
        edge = min(time, duration - time) / ramp
        share = 1.0 if edge >= 1.0 else 0.5 - 0.5 * math.cos(math.pi * max(edge, 0.0))
        return share * signal(time)

    return ramped


def multisine_lines(
    duration: float, f_min: float, f_max: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz and phases in rad of a flat multisine of unit line amplitude.

    The lines are the harmonics of 1/duration inside the band. Of `PHASE_DRAWS` random phase
    sets the one with the lowest peak is taken: a low crest factor puts more power under a limit.
    """
    first, last = math.ceil(f_min * duration), math.floor(f_max * duration)
    harmonics = np.arange(max(first, 1), last + 1)
    if harmonics.size == 0:
        raise ValueError(f'no harmonic of 1/{duration:g} s lies in {f_min:g} to {f_max:g} Hz')
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0.0, 2.0 * math.pi, size=(PHASE_DRAWS, harmonics.size))
    samples = 8 * (int(harmonics[-1]) + 1)
    spectra = np.zeros((PHASE_DRAWS, samples // 2 + 1), dtype=complex)
    spectra[:, harmonics] = np.exp(1j * phases)
    peaks = np.abs(np.fft.irfft(spectra, n=samples, axis=1)).max(axis=1)
    return harmonics / duration, phases[np.argmin(peaks)]


def _multisine(settings: ExcitationSettings) -> Signal:
    if settings.duration == 0.0:
        return lambda time: 0.0
    frequencies, phases = multisine_lines(
        settings.duration, settings.f_min, settings.f_max, settings.seed
    )
    line = settings.amplitude * math.sqrt(2.0 / len(frequencies))
    omega = 2.0 * math.pi * frequencies
    return lambda time: line * float(np.cos(omega * time + phases).sum())


def _chirp(settings: ExcitationSettings) -> Signal:
    """Sine whose frequency grows linearly from f_min to f_max."""
    slope = (settings.f_max - settings.f_min) / max(settings.duration, 1e-9)

    def chirp(time: float) -> float:
        return settings.amplitude * math.sin(
            2.0 * math.pi * (settings.f_min * time + 0.5 * slope * time**2)
        )

    return chirp


def _steps(settings: ExcitationSettings) -> Signal:
    """Levels drawn at random between the two amplitudes, each held for a random time."""
    rng = np.random.default_rng(settings.seed)
    count = 4 + math.ceil(4.0 * settings.duration / settings.dwell)
    starts = np.concatenate(([0.0], np.cumsum(rng.uniform(0.5, 1.5, size=count) * settings.dwell)))
    levels = rng.uniform(-settings.amplitude, settings.amplitude, size=count + 1)
    return _held(starts, levels)


def _held(starts: np.ndarray, levels: np.ndarray) -> Signal:
    """Zero-order hold: each level acts from its start until the next; zero before the first."""

    def held(time: float) -> float:
        index = int(np.searchsorted(starts, time, side='right')) - 1
        return float(levels[index]) if index >= 0 else 0.0

    return held


def playback(path: Path) -> Signal:
    """The torque of a CSV file, held between its rows; zero after the last row's time.

    Raises:
        CommandFileError: naming file, line and what is wrong.
    """
    rows: list[tuple[float, float]] = []
    titles = 0
    text = read_text(path, CommandFileError, JSON)
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith('#'):
            continue
        try:
            cells = next(csv.reader([line]))
            rows.append((float(cells[0]), float(cells[1])))
        except (ValueError, IndexError, csv.Error):
            titles += 1
            if rows or titles > 1:
                raise CommandFileError(
                    f'{path}:{number}: expected time in s, torque in N m; got {shown(line)}'
                ) from None
    if not rows:
        raise CommandFileError(f'{path} holds no rows of time in s, torque in N m')
    times, torques = np.array(rows).T
    if not np.all(np.isfinite(times)) or not np.all(np.isfinite(torques)):
        raise CommandFileError(f'{path} holds a number that is not finite')
    if np.any(np.diff(times) <= 0.0):
        raise CommandFileError(f'{path}: times must grow from row to row')
    last = times[-1]
    held = _held(times, torques)
    return lambda time: held(time) if time <= last else 0.0


def crest_factor(samples: np.ndarray) -> float:
    """Peak over RMS of a signal."""
    return float(np.max(np.abs(samples)) / np.sqrt(np.mean(np.square(samples))))
