"""Find which camera was at which place on the body, from the motion of the cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.config.mounts import MOTION_PLACES
from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.geometry import poses_at, rotation_angle_rad
from bodycap_batch.model.scene import Trajectory

_RATE_HZ = 15.0
"""Rate, Hz, of the common instants. A hand swings at 1 to 3 Hz. Evidence: none."""
_MAX_GAP_NS = 150_000_000
"""Maximum gap, nanoseconds, between two localised frames that a pose is interpolated in. Evidence: none."""
_MIN_SECONDS = 2.0
"""Minimum time, seconds, in which all three cameras have a pose. It is two steps. Evidence: none."""
_MIN_CALM_RATIO = 1.5
"""Minimum ratio (no unit) of the motion of each hand's camera to that of the trunk's camera. Evidence:
docs/decisions/places.md."""
_MIN_OPPOSITE_SHARE = 0.9
"""Minimum fraction of the instants at which the hands are on opposite sides of the trunk. Evidence:
docs/decisions/places.md."""
_MIN_SIDE_SIGMAS = 2.0
"""Minimum ratio (no unit) of the mean to the standard deviation of the hands' distance from side to side.
Evidence: docs/decisions/places.md."""
_MIN_BELOW = 0.3
"""Minimum median cosine (no unit) between the downward direction and the direction from the trunk's camera
to the middle of the hands. Evidence: docs/decisions/places.md."""
_MIN_FORWARD_SHARE = 0.3
"""Minimum fraction of the path of the trunk's camera that goes where this camera looks, with backward motion
subtracted. Evidence: docs/decisions/places.md."""
_MIN_PATH_REACHES = 1.0
"""Minimum length of this path, as a multiple of the distance from the trunk to a hand. Evidence:
docs/decisions/places.md."""
_STRIDE_S = 0.5
"""Time, seconds, over which the direction of the path is measured. It is one step. Evidence: none."""
_MAX_STEEP = 0.85
"""Maximum cosine (no unit) between the viewing direction and the vertical. A steeper view shows no heading.
Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedPoses:
    """The localised frames of one camera.

    Attributes:
        common_ns: (N,) times of the frames on the common clock, nanoseconds, ascending.
        map_from_cam: (N,4,4) poses of the camera in the map.
    """

    common_ns: IntArray
    map_from_cam: FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class FoundPlaces:
    """Which camera was at which place.

    Attributes:
        by_camera: The place of each camera; empty if the motion does not determine the places.
        reason: Why the motion does not determine the places; "" if it does.
    """

    by_camera: Mapping[str, str]
    reason: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class _TrunkHypothesis:
    """The evidence that one camera is the trunk's, and the two others are those of the hands.

    Attributes:
        left: Name of the camera on the left of the body.
        right: Name of the camera on the right of the body.
        calm_ratio: Motion of the calmer hand over the motion of the trunk.
        opposite_share: Fraction of the instants at which the hands are on opposite sides.
        side_sigmas: Mean of the hands' distance from side to side, over its standard deviation.
        below: Median cosine between the downward direction and the direction to the middle of the hands.
        forward_share: Fraction of the path that goes where the camera looks.
        path_reaches: Length of the path over the distance from the trunk to a hand.
    """

    left: str
    right: str
    calm_ratio: float
    opposite_share: float
    side_sigmas: float
    below: float
    forward_share: float
    path_reaches: float

    def failed(self) -> list[str]:
        """Return the reasons why the hypothesis is not accepted, for the user."""
        tests = (
            (self.calm_ratio >= _MIN_CALM_RATIO, "no camera moves clearly less than the two others"),
            (self.below >= _MIN_BELOW, "the two others are not below it"),
            (
                self.opposite_share >= _MIN_OPPOSITE_SHARE and self.side_sigmas >= _MIN_SIDE_SIGMAS,
                "the two others do not stay on opposite sides of it",
            ),
            (
                self.forward_share >= _MIN_FORWARD_SHARE and self.path_reaches >= _MIN_PATH_REACHES,
                "the person does not walk where it looks, so left and right are not known",
            ),
        )
        return [reason for passed, reason in tests if not passed]


def find_places_with(
    clocks: Mapping[str, Mapping[str, ClockRelation]],
    paths: Sequence[Trajectory],
    stated: Mapping[str, str],
) -> FoundPlaces:
    """Find the places with the clocks that follow from each hypothesis about the camera on the trunk.

    A hypothesis is accepted if the places found with its clocks agree with it. One only may be accepted.

    Args:
        clocks: The clock of each camera, by camera name. One such mapping for each hypothesis, by name of the
            camera that is taken for the one on the trunk; "" for clocks that hold without a hypothesis.
        paths: The paths of the three cameras in one map, each on its own clock.
        stated: The known places, by camera name.
    """
    found = {trunk: _places_with(known, paths, stated) for trunk, known in clocks.items()}
    accepted = [
        each
        for trunk, each in found.items()
        if each.by_camera and (not trunk or each.by_camera[trunk] == MOTION_PLACES[0])
    ]
    if len(accepted) == 1:
        return accepted[0]
    if accepted:
        return _unknown("two answers are possible")
    reasons = [each.reason for each in found.values() if each.reason]
    return _unknown("; ".join(dict.fromkeys(reasons)) or "no answer agrees with the clocks that it needs")


def _places_with(
    clocks: Mapping[str, ClockRelation], paths: Sequence[Trajectory], stated: Mapping[str, str]
) -> FoundPlaces:
    """Find the places with known clocks, or say which clock is unknown."""
    unknown = [path.camera for path in paths if not clocks[path.camera].is_known]
    if unknown:
        return _unknown(f"the clock of {', '.join(unknown)} is unknown")
    poses = {
        path.camera: TimedPoses(
            common_ns=clocks[path.camera].common_ns(path.times_ns[path.localised]),
            map_from_cam=path.gauge_from_cam[path.localised],
        )
        for path in paths
    }
    return find_places(poses, stated)


def find_places(cameras: Mapping[str, TimedPoses], stated: Mapping[str, str]) -> FoundPlaces:
    """Find which of three cameras was on the torso, on the left palm and on the right palm.

    The torso's camera turns and shakes less than the others, and these move less in its frame. The hands are
    below it, and on opposite sides of it. Its picture shows where the body faces, and the person walks there.
    All of this must hold for one camera and for no other. The scale and the axes of the map may be any.

    Args:
        cameras: The poses of the three cameras in one map.
        stated: The known places, by camera name. An answer that contradicts them is no answer.
    """
    poses, seconds = _common_poses(list(cameras.values()))
    if seconds < _MIN_SECONDS:
        return _unknown(f"all three cameras are in one map together for only {seconds:.1f} s")
    names = list(cameras)
    hypotheses = {name: _hypothesis(names, poses, index) for index, name in enumerate(names)}
    accepted = [name for name, found in hypotheses.items() if not found.failed()]
    if len(accepted) != 1:
        return _unknown(_reason(hypotheses))
    trunk = accepted[0]
    order = (trunk, hypotheses[trunk].left, hypotheses[trunk].right)
    places = dict(zip(order, MOTION_PLACES, strict=True))
    for name, place in stated.items():
        if places[name] != place:
            return _unknown(
                f"the motion of camera {name} is that of {places[name]}, but it is stated as {place}"
            )
    return FoundPlaces(by_camera={name: places[name] for name in names})


def _unknown(reason: str) -> FoundPlaces:
    return FoundPlaces(by_camera={}, reason=reason)


def _reason(hypotheses: Mapping[str, _TrunkHypothesis]) -> str:
    name = max(hypotheses, key=lambda each: (-len(hypotheses[each].failed()), hypotheses[each].calm_ratio))
    failed = hypotheses[name].failed()
    return f"with camera {name} as the torso's: {'; '.join(failed)}" if failed else "two answers are possible"


def _common_poses(cameras: Sequence[TimedPoses]) -> tuple[FloatArray, float]:
    """Return the poses (C,T,4,4) of all cameras at the instants at which all have one, and their time, s."""
    first = max((int(each.common_ns[0]) for each in cameras if len(each.common_ns)), default=0)
    last = min((int(each.common_ns[-1]) for each in cameras if len(each.common_ns)), default=0)
    if last <= first or any(len(each.common_ns) < 2 for each in cameras):
        return np.zeros((len(cameras), 0, 4, 4)), 0.0
    ticks = np.arange(first, last, round(1e9 / _RATE_HZ), dtype=np.int64)
    sampled = [poses_at(each.common_ns, each.map_from_cam, ticks, max_gap_ns=_MAX_GAP_NS) for each in cameras]
    valid = np.all([found for _, found in sampled], axis=0)
    poses = np.stack([pose for pose, _ in sampled])
    poses[:, ~valid] = np.nan
    return poses, float(valid.sum() / _RATE_HZ)


def _hypothesis(names: Sequence[str], poses: FloatArray, trunk: int) -> _TrunkHypothesis:
    """Return the evidence that camera number `trunk` is that of the trunk. `poses` are (C,T,4,4)."""
    others = [index for index in range(len(names)) if index != trunk]
    motions = [_motion(poses, index) for index in range(len(names))]
    valid = ~np.isnan(poses[trunk, :, 0, 0])
    centre = poses[trunk, :, :3, 3]
    up = -np.mean(poses[trunk, valid, :3, 1], axis=0)
    up /= np.linalg.norm(up)
    view = poses[trunk, :, :3, 2]
    forward = _horizontal(view, up)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    level = valid & (np.abs(view @ up) <= _MAX_STEEP)
    to_left = np.cross(up, forward)
    a, b = (((poses[index, :, :3, 3] - centre) * to_left).sum(axis=1)[level] for index in others)
    apart, between = a - b, a * b < 0.0
    middle = poses[others, :, :3, 3].mean(axis=0) - centre
    below = -(middle[valid] @ up) / np.linalg.norm(middle[valid], axis=1)
    reach = float(np.median(np.linalg.norm(poses[others[0], valid, :3, 3] - centre[valid], axis=1)))
    forward_share, path = _walked(centre, forward, up)
    first, second = (names[index] for index in others)
    swap = len(apart) > 0 and float(np.median(apart)) < 0.0
    return _TrunkHypothesis(
        left=second if swap else first,
        right=first if swap else second,
        calm_ratio=float(min(np.prod(motions[index] / motions[trunk]) for index in others)),
        opposite_share=_side_share(apart, between, level, valid),
        side_sigmas=float(abs(apart.mean()) / max(apart.std(), 1e-12)) if len(apart) else 0.0,
        below=float(np.median(below)),
        forward_share=forward_share,
        path_reaches=path / max(reach, 1e-12),
    )


def _side_share(apart: FloatArray, between: BoolArray, level: BoolArray, valid: BoolArray) -> float:
    """Return the fraction of all instants at which the hands are on their own sides of the trunk."""
    if not len(apart):
        return 0.0
    on_own_side = between & (np.sign(apart) == np.sign(np.median(apart)))
    return float(on_own_side.sum() / valid.sum()) if level.any() else 0.0


def _motion(poses: FloatArray, camera: int) -> FloatArray:
    """Return three measures (3,) of how much a camera moves, up to factors that all cameras share.

    They are the spread of the other cameras in the frame of this camera, relative to their distance; its rate
    of rotation; and its speed relative to the middle of all cameras.
    """
    rotation, centre = poses[camera, :, :3, :3], poses[camera, :, :3, 3]
    spread = distance = 0.0
    for other in range(len(poses)):
        if other != camera:
            seen = np.einsum("tji,tj->ti", rotation, poses[other, :, :3, 3] - centre)
            spread += float(np.nanvar(seen, axis=0).sum())
            distance += float(np.nanmean((seen**2).sum(axis=1)))
    step = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    step = step[~np.isnan(step[:, 0, 0])]
    rate = float(np.sqrt((rotation_angle_rad(step) ** 2).mean()))
    speed = np.diff(centre - poses[:, :, :3, 3].mean(axis=0), axis=0)
    relative = float(np.sqrt(np.nanmean((speed**2).sum(axis=1))))
    return np.maximum([np.sqrt(spread / distance), rate, relative], 1e-12)


def _walked(centre: FloatArray, forward: FloatArray, up: FloatArray) -> tuple[float, float]:
    """Return the fraction of the path that goes forward, and the length of the path in units of the map."""
    stride = round(_STRIDE_S * _RATE_HZ)
    moved = _horizontal(centre[stride:] - centre[:-stride], up)
    ahead = (moved * forward[stride // 2 : stride // 2 + len(moved)]).sum(axis=1)
    length = np.linalg.norm(moved, axis=1)
    total = float(np.nansum(length))
    return float(np.nansum(ahead)) / max(total, 1e-12), total / stride


def _horizontal(vectors: FloatArray, up: FloatArray) -> FloatArray:
    """Return the horizontal part of vectors (N,3)."""
    return np.asarray(vectors - np.outer(vectors @ up, up))
