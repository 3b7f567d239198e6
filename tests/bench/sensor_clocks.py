"""Measure the clocks from inertial sensors: ``python -m tests.bench clocks --only sensors``.

Inertial samples of generated walks and of recorded motions with the errors of a consumer's sensor, cut so
that each camera starts at another time. Pairs of the first camera with each other one. Besides: pairs of
different motions, and parts of one motion that share no moment.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from bodycap_batch.clocks.sensor_offsets import measure_sensor_offset
from bodycap_batch.clocks.sensor_signals import RATE_HZ, SensorTrack, sensor_track
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.synthetic.camera_renderer import camera_poses_at
from bodycap_batch.synthetic.imu import write_imu
from bodycap_batch.synthetic.imu_options import ImuOptions
from bodycap_batch.synthetic.making import Subject, draw_subject
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.telemetry.text_files import read_imu_file
from tests.bench.motion_clocks import LONG_S, Outcome, length_s

CAMERAS = ("torso", "left_palm", "right_palm", "head", "left_upper_arm", "right_thigh")
WRONG_S, FAR_S = 0.020, 0.050
START_S = 0.1
"""Start of the used part of a recorded motion: its first frame may be a pose without motion."""
WALKS: Mapping[str, Mapping[str, object]] = {
    "simple": {},
    "gait": {"walk": "gait"},
    "posture": {"posture_spread": 1.0},
    "spot": {"on_the_spot": True},
}


def run(data: Path, share: float, seed: int) -> tuple[list[str], int]:
    """Run all trials.

    Returns:
        The lines of the table, and the number of offsets that are far off or of unrelated recordings.
    """
    motions = {path.stem: path for path in sorted((data / "motions").glob("*.bvh"))}
    lengths_s = {kind: length_s(path) - START_S for kind, path in motions.items()}
    kinds = [*WALKS, *(kind for kind, length_s in lengths_s.items() if length_s >= 5.0)]
    outcomes: list[Outcome] = []
    tracks: list[tuple[str, int, Mapping[str, SensorTrack]]] = []
    for number, kind in enumerate(kinds):
        for index in range(max(1, round(12 * share))):
            own = seed + 1000 * number + index
            found, starts_s = trial(kind, own, motions.get(kind), lengths_s.get(kind, 25.0))
            tracks.append((kind, index, found))
            outcomes += measured(kind, found, starts_s)
    lines = [f"{'motion':10} {'camera':15} accepted  > 20 ms  > 50 ms  median  95 %    in 2 sigma"]
    for kind in [*kinds, "recorded", "all"]:
        some = [each for each in outcomes if _belongs(each.kind, kind, motions)]
        for camera in (*CAMERAS[1:], "all") if kind in ("recorded", "all") else ("all",):
            lines.append(f"{kind:10} {camera:15} {_row([e for e in some if camera in ('all', e.camera)])}")
    for name, least_s, most_s in (("short", 0.0, LONG_S), ("long", LONG_S, np.inf)):
        lines.append(f"{name:26} {_row([e for e in outcomes if least_s <= e.common_s < most_s])}")
    apart = unrelated(tracks)
    for name, accepted in apart.items():
        lines.append(f"{name}: {sum(accepted)} of {len(accepted)} accepted")
    far = sum(each.accepted and abs(each.error_s) > FAR_S for each in outcomes)
    return lines, far + sum(map(sum, apart.values()))


def trial(
    kind: str, seed: int, motion: Path | None, longest_s: float
) -> tuple[dict[str, SensorTrack], dict[str, float]]:
    """Return the signals of all cameras, and the common time at which each camera started, seconds."""
    rng = np.random.default_rng(seed)
    seconds = float(rng.uniform(min(6.0, longest_s), longest_s))
    options: dict[str, object] = {"seed": seed, "seconds": seconds, "cameras": CAMERAS, **WALKS.get(kind, {})}
    if motion is not None:
        start_s = START_S + float(rng.uniform(0.0, longest_s - seconds))
        options |= {"motion": motion, "motion_start_s": start_s}
    subject = draw_subject(SynthOptions.model_validate(options))
    latest_s = min(3.0, seconds / 4)
    tracks, starts_s = {}, {}
    for index, mount in enumerate(subject.mounts):
        start_s = float(rng.uniform(0.0, latest_s))
        end_s = seconds - float(rng.uniform(0.0, latest_s)) * (rng.uniform() < 0.5)
        tracks[mount.camera] = signals(subject, index, start_s, end_s, seed)
        starts_s[mount.camera] = start_s
    return tracks, starts_s


def signals(subject: Subject, index: int, start_s: float, end_s: float, seed: int) -> SensorTrack:
    """Return the signals of a consumer's sensor on a camera that records a part of a motion."""
    mount = subject.mounts[index]

    def world_from_cam_at(camera_s: FloatArray) -> FloatArray:
        return camera_poses_at(subject.motion, mount, camera_s + start_s)

    with tempfile.TemporaryDirectory(prefix="bodycap-sensors-") as folder:
        place = Path(folder)
        (place / "gt").mkdir()
        sequence = np.random.SeedSequence([seed, index])
        write_imu(place, mount.camera, ImuOptions(), end_s - start_s, world_from_cam_at, sequence)
        return sensor_track(mount.camera, read_imu_file(place / f"{mount.camera}.imu.csv"))


def measured(kind: str, tracks: Mapping[str, SensorTrack], starts_s: Mapping[str, float]) -> list[Outcome]:
    """Return the outcome of each camera but the first one."""
    first = tracks[CAMERAS[0]]
    out = []
    for camera in CAMERAS[1:]:
        second = tracks[camera]
        if first.problem or second.problem:
            out.append(Outcome(kind, camera, 0.0, accepted=False, error_s=np.nan, sigma_s=np.nan))
            continue
        found = measure_sensor_offset(first, second)
        true_s = starts_s[camera] - starts_s[CAMERAS[0]]
        ends_s = _end_s(first), _end_s(second) + true_s
        common_s = min(ends_s) - max(first.start_s, second.start_s + true_s)
        error_s = found.offset_s - true_s
        out.append(Outcome(kind, camera, common_s, found.accepted, error_s, found.sigma_s))
    return out


def unrelated(tracks: Sequence[tuple[str, int, Mapping[str, SensorTrack]]]) -> dict[str, list[bool]]:
    """Return which pairs that share no moment are accepted, by the kind of the pair."""
    out: dict[str, list[bool]] = {"different motions": [], "two parts of one motion": []}
    for number, (kind, index, own) in enumerate(tracks):
        for other, (other_kind, other_index, others) in enumerate(tracks):
            camera = CAMERAS[1:][(number + other) % 5]
            if kind != other_kind and index == other_index:
                pair = own["torso"], others[camera]
                if not (pair[0].problem or pair[1].problem):
                    out["different motions"].append(measure_sensor_offset(*pair).accepted)
        for camera in CAMERAS[1:]:
            first, second = own["torso"], own[camera]
            half = min(len(first.vertical), len(second.vertical)) // 2
            if first.problem or second.problem or half < 450:
                continue
            early, late = _part(first, 0, half - 50), _part(second, half + 50, len(second.vertical))
            out["two parts of one motion"].append(measure_sensor_offset(early, late).accepted)
    return out


def _end_s(track: SensorTrack) -> float:
    """Return the time of the last sample on the clock of the camera, seconds."""
    return track.start_s + (len(track.vertical) - 1) / RATE_HZ


def _part(track: SensorTrack, begin: int, end: int) -> SensorTrack:
    return SensorTrack(camera=track.camera, vertical=track.vertical[begin:end], turn=track.turn[begin:end])


def _belongs(kind: str, group: str, motions: Mapping[str, Path]) -> bool:
    return group in ("all", kind) or (group == "recorded" and kind in motions)


def _row(some: Sequence[Outcome]) -> str:
    done = [each for each in some if each.accepted]
    error_s = np.abs([each.error_s for each in done])
    if not done:
        return f"{0:3}/{len(some):3}"
    inside = np.mean(error_s <= 2 * np.array([each.sigma_s for each in done]))
    median, most = 1e3 * np.quantile(error_s, [0.5, 0.95])
    return (
        f"{len(done):3}/{len(some):3}   {np.sum(error_s > WRONG_S):5}   {np.sum(error_s > FAR_S):6}   "
        f"{median:5.0f}  {most:5.0f} ms  {100 * inside:5.0f} %"
    )
