"""Measure the clocks from sound and motion: ``python -m tests.bench clocks``.

Pairs of generated recordings, encoded with AAC at 16 kHz, each with its own room response, band, gain, cloth
noise and clock. The ratio is the power of the sound over that of the cloth noise in 200 to 6000 Hz: at +6 dB
the sound is louder. A pair is wrong if it is accepted and its offset is more than 15 ms off. Besides: pairs
that share no moment, two captures with known clocks, and two real recordings delayed against themselves.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bodycap_batch.clocks import estimate_clocks
from bodycap_batch.clocks.joint_offsets import WAY_SIGMA_S, solve_clocks
from bodycap_batch.clocks.pair_offsets import measure_pair
from bodycap_batch.clocks.sound_track import RATE_HZ, SoundPiece, SoundTrack, read_sound_file
from bodycap_batch.config.job import load_job
from bodycap_batch.synthetic.sound import Microphone, Samples, make_scene, record
from tests.bench import motion_clocks
from tests.bench.rows import DATA
from tests.sounds import write_sound

RATIOS_DB = (6.0, 0.0, -6.0)
DURATIONS_S = (6.0, 20.0, 60.0, 300.0, 600.0)
SHARES = (8, 8, 6, 5, 3)
"""How many of 30 pairs have each duration."""
WRONG_S = 0.015
UNRELATED = 40
ALL = ("voice", "steps", "claps", "distant")


@dataclass(frozen=True)
class Case:
    """One pair of recordings."""

    seed: int
    seconds: float
    ratio_db: float
    drift_ppm: float
    related: bool = True


@dataclass(frozen=True)
class Outcome:
    """What was found for a case; errors are estimate − truth."""

    case: Case
    accepted: bool
    reason: str
    error_s: float
    sigma_s: float
    drift_error_ppm: float
    drift_sigma_ppm: float
    drift_measured: bool
    rival_ratio: float
    log_chance: float


def main(arguments: Sequence[str]) -> int:
    """Run the benchmark; the exit code is 0 if no pair is wrong and no unrelated pair is accepted."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench clocks", description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="part of the pairs to run (1)")
    parser.add_argument("--min-seconds", type=float, default=0.0, help="shortest recordings (0)")
    parser.add_argument("--max-seconds", type=float, default=600.0, help="longest recordings (600)")
    parser.add_argument("--seed", type=int, default=1000, help="first seed (1000)")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--json", type=Path, help="file for all outcomes as JSON")
    parser.add_argument("--only", choices=("sound", "motion"), help="run only one source")
    parser.add_argument(
        "--stored", type=Path, nargs="*", default=[], help="folders of trajectories for the motion (TUM)"
    )
    options = parser.parse_args(arguments)
    bad = 0
    if options.only in (None, "motion"):
        lines, bad = motion_clocks.run(options.data, options.share, options.seed, options.stored)
        print("\n".join(lines))
    if options.only == "motion":
        return 1 if bad else 0
    chosen = [
        case
        for case in cases(options.share, options.seed)
        if options.min_seconds <= case.seconds <= options.max_seconds
    ]
    outcomes = []
    with ProcessPoolExecutor(options.processes) as pool:
        for outcome in pool.map(run_case, sorted(chosen, key=lambda case: -case.seconds)):
            outcomes.append(outcome)
            if options.json:
                options.json.write_text(json.dumps([asdict(each) for each in outcomes]), encoding="utf-8")
    print("\n".join(table(outcomes)))
    print("\n".join([*capture_lines(options.data), *real_lines(options.data)]))
    wrong = [each for each in outcomes if is_wrong(each)]
    return 1 if wrong or bad else 0


def cases(share: float, seed: int) -> Iterable[Case]:
    """Yield the pairs: 30 for each ratio and drift, and the unrelated ones."""
    seeds = itertools.count(seed)
    for ratio, drift in itertools.product(RATIOS_DB, (0.0, 50.0)):
        for seconds, count in zip(DURATIONS_S, SHARES, strict=True):
            for _ in range(max(1, round(share * count))):
                yield Case(next(seeds), seconds, ratio, drift)
    for index in range(max(1, round(share * UNRELATED))):
        yield Case(next(seeds), (6.0, 20.0, 60.0, 120.0)[index % 4], (20.0, 6.0)[index // 4 % 2], 0.0, False)


def run_case(case: Case) -> Outcome:
    """Generate, encode, read and measure one pair."""
    rng = np.random.default_rng(case.seed)
    offset_s = float(rng.uniform(-0.25, 0.25) * min(case.seconds, 40.0))
    start, end = min(0.0, offset_s), case.seconds + max(0.0, offset_s) + 1.0
    # Sounds without a distant source are hard to tell apart if they are unrelated: bursts in silence.
    kinds = (ALL, ("claps", "distant"), ("steps", "distant"), ("voice", "music"), ("claps", "steps"))
    sources = ALL if case.related else kinds[case.seed % len(kinds)]
    scenes = [make_scene(start, end, seed=case.seed, rate_hz=RATE_HZ, sources=sources)]
    scenes.append(
        scenes[0]
        if case.related
        else make_scene(start, end, seed=case.seed + 500_000, rate_hz=RATE_HZ, sources=sources)
    )
    clocks = ((0.0, 0.0), (offset_s, case.drift_ppm))
    tracks = []
    with tempfile.TemporaryDirectory(prefix="bodycap-clocks-") as folder:
        for index, (offset, drift) in enumerate(clocks):
            microphone = Microphone(
                seed=int(rng.integers(1 << 30)),
                seconds=case.seconds,
                offset_s=offset,
                drift_ppm=drift,
                noise_ratio_db=case.ratio_db,
                gain_db=float(rng.uniform(-20.0, 0.0)),
                band_hz=(float(rng.uniform(80, 300)), float(rng.uniform(4500, 7500))),
            )
            path = write_sound(Path(folder) / f"{index}.m4a", record(scenes[index], microphone), RATE_HZ)
            tracks.append(SoundTrack(camera=str(index), pieces=read_sound_file(path).pieces))
    return measured(case, tracks, offset_s)


def measured(case: Case, tracks: Sequence[SoundTrack], offset_s: float) -> Outcome:
    """Measure two tracks, whose clocks differ by an offset and the drift of the case."""
    pair = measure_pair(tracks[0], tracks[1])
    clock = None
    if pair.accepted:
        starts_s = {track.camera: track.start_s for track in tracks}
        clock = solve_clocks("0", [pair], starts_s, dict.fromkeys(starts_s, WAY_SIGMA_S)).clocks["1"]
    nan = float("nan")
    return Outcome(
        case=case,
        accepted=pair.accepted,
        reason=pair.reason,
        error_s=nan if clock is None else clock.offset_s - offset_s,
        sigma_s=nan if clock is None else clock.sigma_s,
        drift_error_ppm=nan if clock is None else clock.drift_ppm - case.drift_ppm,
        drift_sigma_ppm=nan if clock is None else clock.drift_sigma_ppm,
        drift_measured=pair.drift_measured,
        rival_ratio=pair.rival_ratio,
        log_chance=pair.log_chance,
    )


def is_wrong(outcome: Outcome) -> bool:
    """Return True for an accepted pair that is unrelated or far off."""
    return outcome.accepted and (not outcome.case.related or abs(outcome.error_s) > WRONG_S)


def table(outcomes: Sequence[Outcome]) -> list[str]:
    """Return the table: a line for each ratio and duration, then the pooled figures."""
    related = [each for each in outcomes if each.case.related]
    lines = ["  dB  seconds  accepted  wrong  |error| 95 %  drift 95 %  in 2 sigma: offset  drift"]
    for ratio in RATIOS_DB:
        for seconds in (*DURATIONS_S, None):
            some = [
                each
                for each in related
                if each.case.ratio_db == ratio and seconds in (None, each.case.seconds)
            ]
            if some:
                lines.append(
                    f"{ratio:+4.0f}  {'all' if seconds is None else round(seconds):>7}  {_row(some)}"
                )
    lines.append(f"pooled           {_row(related)}")
    for drift in (0.0, 50.0):
        lines.append(f"drift {drift:2.0f} ppm     {_row([e for e in related if e.case.drift_ppm == drift])}")
    unrelated = [each for each in outcomes if not each.case.related]
    lines.append(f"share no moment: {sum(each.accepted for each in unrelated)} of {len(unrelated)} accepted")
    return lines


def _row(some: Sequence[Outcome]) -> str:
    done = [each for each in some if each.accepted]
    error = np.abs([each.error_s for each in done])
    drifts = [each for each in done if each.drift_measured]
    drift = np.abs([each.drift_error_ppm for each in drifts])
    inside = error <= 2 * np.array([each.sigma_s for each in done])
    drift_inside = drift <= 2 * np.array([each.drift_sigma_ppm for each in drifts])
    return (
        f"{len(done):3}/{len(some):3}   {sum(map(is_wrong, done)):4}   "
        f"{1e3 * np.quantile(error, 0.95) if done else np.nan:8.2f} ms   "
        f"{np.quantile(drift, 0.95) if drifts else np.nan:6.1f} ppm    "
        f"{100 * inside.mean() if done else np.nan:8.0f} %   "
        f"{100 * drift_inside.mean() if drifts else np.nan:8.0f} %"
    )


def capture_lines(data: Path) -> list[str]:
    """Return the errors of the captures with true clocks."""
    lines = []
    for truth in sorted(data.glob("*/gt/clocks.json")):
        folder = truth.parent.parent
        offsets = json.loads(truth.read_text(encoding="utf-8"))["offsets_s"]
        estimates = estimate_clocks(load_job(folder).capture)
        for clock in estimates.cameras:
            if clock.camera == estimates.reference:
                continue
            if not clock.is_known:
                lines.append(f"{folder.name} {clock.camera}: none: {', '.join(clock.reasons)}")
                continue
            error = clock.offset_s - (offsets[clock.camera] - offsets[estimates.reference])
            lines.append(
                f"{folder.name} {clock.camera}: {1e3 * error:+.2f} ms (sigma {1e3 * clock.sigma_s:.2f} ms)"
            )
    return lines


def real_lines(data: Path) -> list[str]:
    """Return the errors for real recordings, delayed against themselves with noise and drift."""
    lines = []
    sounds = {path.stem: read_sound_file(path) for path in sorted(data.glob("gopro/*.mp4"))}
    for name, sound in sounds.items():
        samples = sound.samples(0.0, round(sound.end_s * RATE_HZ)) / 32768
        for ratio_db, drift in itertools.product((6.0, 0.0, -6.0), (0.0, 50.0)):
            case = Case(round(abs(ratio_db) + drift), len(samples) / RATE_HZ, ratio_db, drift)
            tracks = [track_of("0", samples), track_of("1", delayed(samples, 0.7123, case))]
            found = measured(case, tracks, 0.7123)
            what = f"{1e3 * found.error_s:+.2f} ms" if found.accepted else f"none: {found.reason}"
            lines.append(f"{name} delayed, noise at {ratio_db:+.0f} dB, {drift:.0f} ppm: {what}")
    for first, second in itertools.combinations(sounds, 2):
        tracks = [
            SoundTrack(camera=str(index), pieces=sounds[name].pieces)
            for index, name in enumerate((first, second))
        ]
        found = measured(Case(0, 0.0, 0.0, 0.0, related=False), tracks, 0.0)
        lines.append(f"{first} and {second}: {'ACCEPTED' if found.accepted else 'refused: ' + found.reason}")
    return lines


def delayed(samples: Samples, offset_s: float, case: Case) -> Samples:
    """Return a recording of a camera whose clock has an offset and a drift, with white noise."""
    rng = np.random.default_rng(case.seed)
    common = np.arange(len(samples)) / RATE_HZ * (1 + 1e-6 * case.drift_ppm) + offset_s
    # Linear interpolation between samples at four times the rate, by a transform with zeros at its end.
    fine = np.fft.irfft(np.fft.rfft(samples), 4 * len(samples)) * 4
    moved = np.interp(common * RATE_HZ * 4, np.arange(len(fine)), fine, right=0.0)
    noise = rng.standard_normal(len(samples)) * moved.std() * 10 ** (-case.ratio_db / 20)
    return (moved + noise).astype(np.float32)


def track_of(camera: str, samples: Samples) -> SoundTrack:
    """Return samples as the sound of a camera that starts at camera time 0."""
    peak = max(1.0, float(np.abs(samples).max()))
    return SoundTrack(camera=camera, pieces=(SoundPiece(0.0, (samples / peak * 32767).astype(np.int16)),))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
