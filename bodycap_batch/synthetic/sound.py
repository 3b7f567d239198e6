"""Generate the sound that body cameras record: one scene, heard by several microphones.

A scene consists of dry sources: the voice of the wearer, footsteps, claps, a distant source, and music that
repeats. Each microphone hears every source with a delay of its own, through a room response of its own, in
its own frequency band and gain. The noise of cloth is added. The same seed gives the same samples.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import butter, oaconvolve, sosfilt

from bodycap_batch.core.arrays import FloatArray

Samples = npt.NDArray[np.float32]
"""Samples (N,) of mono sound, full scale −1 to 1."""

SOURCES = ("voice", "steps", "claps", "distant", "music")
"""Names of the sources of a scene."""
SOUND_M_S = 343.0
"""Speed of sound in air at 20 °C, metres per second."""
NOISE_BAND_HZ = (200.0, 6000.0)
"""Frequency band, Hz, in which the ratio of sound to cloth noise is defined."""
_PADDING_S = 1.0
"""Duration, seconds, of the scene before its first and after its last instant, for the delay of sound."""
_LEVELS = {"voice": 0.25, "steps": 0.3, "claps": 0.6, "distant": 0.08, "music": 0.15}
"""Level of each source at a distance of 1 m, of full scale. Evidence: none."""
_DISTANCES_M = {
    "voice": (0.2, 1.2),
    "steps": (0.4, 1.6),
    "claps": (0.1, 0.9),
    "distant": (2.0, 3.5),
    "music": (2.0, 3.5),
}
"""Least and greatest mean distance, metres, of a microphone on the body from each source. Origin: the ways
from mouth, feet and hands of a person 1.75 m tall to cameras between head and shin; the distant sources are
in the same room."""
_SWING_M = 0.15
"""Maximum amplitude, metres, of the change of a distance while the arms swing. Origin: arms that swing by
±30° about the shoulder, half of it towards the source."""
_REVERBERATION_S = (0.25, 0.5)
"""Least and greatest time, seconds, in which the sound of a room decays by 60 dB. Origin: furnished rooms."""
_STEP_DECAY_S = 0.02
"""Time, seconds, in which the amplitude of a footstep falls by a factor of e. Evidence: none."""
_BLOCK_S = 30.0
"""Duration, seconds, of the blocks in which a microphone's recording is resampled."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The dry sources of one scene.

    Attributes:
        rate_hz: Samples per second.
        start_s: Common time of the first sample, seconds.
        sources: Samples (N,) of each source by its name. All have the same length.
    """

    rate_hz: int
    start_s: float
    sources: dict[str, Samples]


@dataclass(frozen=True, slots=True, kw_only=True)
class Microphone:
    """One camera's microphone and clock.

    Attributes:
        seed: Seed of room responses, distances and noise.
        seconds: Duration of the recording on the camera's clock.
        offset_s: Common time = camera time · (1 + drift_ppm · 1e-6) + offset_s. The recording starts at
            camera time 0.
        drift_ppm: Drift of the camera's clock, parts per million.
        noise_ratio_db: Power of the scene's sound over the power of the cloth noise, dB, both in
            `NOISE_BAND_HZ` and averaged over the recording. Positive values mean that the sound is louder.
            None for no noise.
        gain_db: Gain of the recording, dB.
        band_hz: Lower and upper limit of the microphone's band, Hz.
        clip: Limit of the amplitude, of full scale.
    """

    seed: int
    seconds: float
    offset_s: float = 0.0
    drift_ppm: float = 0.0
    noise_ratio_db: float | None = None
    gain_db: float = 0.0
    band_hz: tuple[float, float] = (100.0, 7000.0)
    clip: float = 1.0


def make_scene(
    start_s: float,
    end_s: float,
    *,
    seed: int,
    rate_hz: int = 48_000,
    sources: tuple[str, ...] = ("voice", "steps", "claps", "distant"),
    steps_s: FloatArray | None = None,
) -> Scene:
    """Generate the sources of a scene.

    Args:
        start_s: Common time of the first instant that a microphone records, seconds.
        end_s: Common time of the last one, seconds.
        seed: Seed of all sources.
        rate_hz: Samples per second.
        sources: Names of the sources, from `SOURCES`.
        steps_s: (N,) common times of the footsteps, seconds; None for times that are drawn at random.

    Raises:
        KeyError: A source has an unknown name.
    """
    count = round((end_s - start_s + 2 * _PADDING_S) * rate_hz)
    makers = {"voice": _voice, "steps": _steps, "claps": _claps, "distant": _distant, "music": _music}
    made = {}
    for name in sources:
        rng = np.random.default_rng([seed, SOURCES.index(name)])
        if name == "steps" and steps_s is not None:
            starts = steps_s - (start_s - _PADDING_S)
            inside = starts[(starts >= 0.0) & (starts < count / rate_hz)]
            samples = _bursts(count, rate_hz, rng, inside, _STEP_DECAY_S)
        else:
            samples = makers[name](count, rate_hz, rng)
        made[name] = (_LEVELS[name] * samples).astype(np.float32)
    return Scene(rate_hz=rate_hz, start_s=start_s - _PADDING_S, sources=made)


def record(scene: Scene, microphone: Microphone) -> Samples:
    """Return the samples (N,) that a microphone records of a scene, at the rate of the scene.

    Sound that the scene does not contain, before its start and after its end, is silence.
    """
    rng = np.random.default_rng([microphone.seed, 17])
    rate = scene.rate_hz
    count = round(microphone.seconds * rate)
    out = np.zeros(count, np.float32)
    for name, dry in scene.sources.items():
        distance_m = rng.uniform(*_DISTANCES_M[name])
        response = _room_response(rng, rate, distance_m, microphone.band_hz)
        wet = np.asarray(oaconvolve(dry, response)[: len(dry)], np.float32)
        _add_delayed(out, wet, scene, microphone, _draw_delay(rng, distance_m))
    if microphone.noise_ratio_db is not None:
        noise = cloth_noise(count, rate, rng)
        ratio = _band_power(out, rate) / max(_band_power(noise, rate), 1e-20)
        out += noise * np.float32(np.sqrt(ratio * 10 ** (-microphone.noise_ratio_db / 10)))
    out *= np.float32(10 ** (microphone.gain_db / 20))
    return np.clip(out, -microphone.clip, microphone.clip)


def cloth_noise(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return the noise (N,) of cloth that rubs against a microphone: bursts, louder at low frequencies."""
    noise = rng.standard_normal(count, np.float32)
    low = sosfilt(_filter(1, (80.0, 600.0), rate_hz), noise)
    high = sosfilt(_filter(1, (600.0, min(5000.0, 0.45 * rate_hz)), rate_hz), noise)
    knots = max(2, int(count / rate_hz / 0.15))
    loudness = rng.gamma(0.7, 1.4, knots + 1).astype(np.float32)
    envelope = np.interp(np.arange(count, dtype=np.float32), np.linspace(0, count, knots + 1), loudness)
    return ((2.0 * low + 0.7 * high) * (0.15 + envelope)).astype(np.float32)


def _draw_delay(rng: np.random.Generator, distance_m: float) -> Callable[[FloatArray], FloatArray]:
    """Return the delay (N,) of a source, seconds, at times (N,), as the arms swing and the body turns.

    Args:
        rng: Source of randomness.
        distance_m: Mean distance of the microphone from the source, metres.
    """
    swing_m, swing_hz, phase_rad = (
        rng.uniform(0.0, _SWING_M),
        rng.uniform(0.7, 1.1),
        rng.uniform(0.0, 2 * np.pi),
    )
    slow_m, slow_hz = rng.uniform(0.0, _SWING_M), rng.uniform(0.02, 0.1)

    def delay_s(times_s: FloatArray) -> FloatArray:
        swing = swing_m * np.sin(2 * np.pi * swing_hz * times_s + phase_rad)
        slow = slow_m * np.sin(2 * np.pi * slow_hz * times_s + 2 * phase_rad)
        return np.asarray((distance_m + swing + slow) / SOUND_M_S)

    return delay_s


def _add_delayed(
    out: Samples,
    wet: Samples,
    scene: Scene,
    microphone: Microphone,
    delay_s: Callable[[FloatArray], FloatArray],
) -> None:
    """Add the sound of one source, on the camera's clock and with its delay, to the recording."""
    rate, block = scene.rate_hz, round(_BLOCK_S * scene.rate_hz)
    for first in range(0, len(out), block):
        camera_s = np.arange(first, min(first + block, len(out))) / rate
        common_s = camera_s * (1.0 + 1e-6 * microphone.drift_ppm) + microphone.offset_s
        knots_s = np.arange(common_s[0], common_s[-1] + 0.02, 0.01)
        late_s = np.interp(common_s, knots_s, delay_s(knots_s))
        position = (common_s - late_s - scene.start_s) * rate
        out[first : first + block] += _interpolated(wet, position)


def _interpolated(values: Samples, position: npt.NDArray[np.float64]) -> Samples:
    """Return the values at fractional indices by a cubic through four samples; 0 outside."""
    index = np.floor(position).astype(np.int64)
    t = (position - index).astype(np.float32)
    inside = (index >= 1) & (index < len(values) - 2)
    index = np.clip(index, 1, len(values) - 3)
    a, b, c, d = (values[index + step] for step in (-1, 0, 1, 2))
    cubic = b + 0.5 * t * (c - a + t * (2 * a - 5 * b + 4 * c - d + t * (3 * (b - c) + d - a)))
    return np.where(inside, cubic, 0.0).astype(np.float32)


def _room_response(
    rng: np.random.Generator, rate_hz: int, distance_m: float, band_hz: tuple[float, float]
) -> Samples:
    """Return the response (K,) of room and microphone: the direct sound, early echoes, a tail that decays."""
    decay_s = rng.uniform(*_REVERBERATION_S)
    times = np.arange(round(0.6 * decay_s * rate_hz)) / rate_hz
    tail = rng.standard_normal(len(times)) * np.exp(-6.9 * times / decay_s)
    tail[: round(0.004 * rate_hz)] = 0.0
    # The tail has the same power at each place of the room; the direct sound falls with the distance.
    tail *= rng.uniform(0.3, 0.5) / np.sqrt((tail**2).sum())
    for _ in range(4):
        tail[round(rng.uniform(0.003, 0.03) * rate_hz)] += rng.uniform(-0.4, 0.4) / (distance_m + 2.0)
    tail[0] = 1.0 / distance_m
    band = _filter(2, (band_hz[0], min(band_hz[1], 0.45 * rate_hz)), rate_hz)
    return np.asarray(sosfilt(band, tail), np.float32)


@functools.lru_cache(maxsize=64)
def _filter(order: int, band_hz: tuple[float, float], rate_hz: int) -> npt.NDArray[np.float32]:
    return np.asarray(butter(order, band_hz, "bandpass", fs=rate_hz, output="sos"), np.float32)


def _band_power(samples: Samples, rate_hz: int) -> float:
    """Return the mean square of the samples in `NOISE_BAND_HZ`, from the spectra of blocks of a second."""
    size = min(rate_hz, len(samples))
    inside = slice(round(NOISE_BAND_HZ[0] * size / rate_hz), round(NOISE_BAND_HZ[1] * size / rate_hz) + 1)
    blocks = samples[: len(samples) // size * size].reshape(-1, size)
    total = sum(float((np.abs(np.fft.rfft(block)[inside]) ** 2).sum()) for block in blocks)
    return 2.0 * total / (len(blocks) * size * size)


def _voice(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return phrases of syllables: pulses or noise through three formants, with pauses between phrases."""
    out = np.zeros(count, np.float32)
    position = int(rng.uniform(0.0, 1.0) * rate_hz)
    while position < count:
        for _ in range(int(rng.integers(3, 12))):
            syllable = _syllable(int(rng.uniform(0.1, 0.3) * rate_hz), rate_hz, rng)
            part = out[position : position + len(syllable)]
            part += syllable[: len(part)]
            position += int(len(syllable) * rng.uniform(0.8, 1.2))
        position += int(rng.uniform(0.4, 2.5) * rate_hz)
    return out


def _syllable(length: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    pitch = np.linspace(rng.uniform(90, 220), rng.uniform(90, 220), length)
    phase = np.cumsum(pitch / rate_hz)
    pulses = np.diff(np.floor(phase), prepend=0.0)
    source = pulses * 8.0 + 0.3 * rng.standard_normal(length)
    consonant = int(length * rng.uniform(0.1, 0.4))
    source[:consonant] = rng.standard_normal(consonant)
    voice = np.zeros(length)
    for low, high in ((300, 800), (900, 2200), (2300, 3400)):
        centre = round(rng.uniform(low, high), -2)
        voice += sosfilt(_filter(1, (centre * 0.88, centre * 1.12), rate_hz), source)
    if consonant:
        hiss = sosfilt(_filter(1, (2500.0, min(7000.0, 0.45 * rate_hz)), rate_hz), source[:consonant])
        voice[:consonant] += 0.7 * hiss
    envelope = np.sin(np.pi * np.linspace(0, 1, length)) ** 0.5
    return (rng.uniform(0.4, 1.0) * envelope * voice).astype(np.float32)


def _bursts(
    count: int, rate_hz: int, rng: np.random.Generator, starts: npt.NDArray[np.float64], decay_s: float
) -> Samples:
    """Return bursts of noise that decay, each with a colour of its own, at the start times (seconds)."""
    out = np.zeros(count, np.float32)
    length = int(6 * decay_s * rate_hz)
    decay = np.exp(-np.arange(length) / (decay_s * rate_hz))
    for start in starts:
        low = round(10 ** rng.uniform(2.0, 3.0), -1)
        shape = _filter(1, (low, min(low * 10.0, 0.45 * rate_hz)), rate_hz)
        burst = sosfilt(shape, rng.standard_normal(length) * decay) * rng.uniform(0.4, 1.0)
        part = out[int(start * rate_hz) :][:length]
        part += burst[: len(part)].astype(np.float32)
    return out


def _steps(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return footsteps, nearly periodic; the person stands still at times."""
    seconds, period = count / rate_hz, rng.uniform(0.5, 0.65)
    starts = np.cumsum(period * (1.0 + 0.03 * rng.standard_normal(int(seconds / period) + 1)))
    walking = np.sin(2 * np.pi * starts / rng.uniform(15.0, 40.0) + rng.uniform(0, 6.28)) > -0.5
    return _bursts(count, rate_hz, rng, starts[walking & (starts < seconds)], _STEP_DECAY_S)


def _claps(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return single loud sounds, some twenty seconds apart."""
    seconds = count / rate_hz
    starts = np.sort(rng.uniform(0.0, seconds, max(1, round(seconds / 20.0))))
    return _bursts(count, rate_hz, rng, starts, 0.004)


def _distant(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return noise whose loudness and colour vary, as of a street or a running tap."""
    noise = sosfilt(_filter(1, (200.0, min(4000.0, 0.45 * rate_hz)), rate_hz), rng.standard_normal(count))
    knots = max(2, int(count / rate_hz))
    loudness = np.interp(np.arange(count), np.linspace(0, count, knots + 1), rng.uniform(0.1, 1.0, knots + 1))
    return (noise * loudness).astype(np.float32)


def _music(count: int, rate_hz: int, rng: np.random.Generator) -> Samples:
    """Return a bar of two seconds that repeats without any change."""
    bar: npt.NDArray[np.float64] = np.zeros(2 * rate_hz)
    times = np.arange(rate_hz // 4) / rate_hz
    for beat in range(8):
        tone = 220.0 * 2 ** (rng.integers(0, 24) / 12)
        phases = rng.uniform(0, 6.28, 8)
        waves = [np.sin(2 * np.pi * tone * (k + 1) * times + phases[k]) / (k + 1) for k in range(8)]
        note = np.sum(waves, axis=0)
        hit = rng.standard_normal(len(times)) * np.exp(-times / 0.02)
        bar[beat * rate_hz // 4 :][: len(times)] += (0.5 * note + hit) * np.exp(-times / 0.15)
    return np.resize(bar, count).astype(np.float32)
