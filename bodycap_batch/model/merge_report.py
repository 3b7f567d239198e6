"""The types of the merging stage's report: sources, values, residuals and warnings.

The names of the fields are the keys in the stored result, and the keys of ``merge`` in ``metrics.json``.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

_OMIT_NONE = {"omit_none": True}
"""Metadata of a field that is omitted from the plain values if the field is None."""
_EMPTY_IF_NONE = {"empty_if_none": True}
"""Metadata of a field that becomes an empty mapping in the plain values if the field is None."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """The median and the 95th percentile of a set of values.

    Attributes:
        p50: The median.
        p95: The 95th percentile.
    """

    p50: float
    p95: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSourceReport:
    """One source of the metric scale.

    Attributes:
        name: Name of the source.
        metres_per_map_unit: Scale from this source, metres per map unit.
        relative_sigma: Sigma of the logarithm of this scale.
        off: Natural logarithm of the ratio: this scale / selected scale.
        used: False if the source was rejected, or replaced by a better source.
    """

    name: str
    metres_per_map_unit: float
    relative_sigma: float
    off: float
    used: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyScaleReport:
    """The metric scale that follows from the bone lengths only.

    Attributes:
        metres_per_map_unit: The scale, metres per map unit.
        relative_sigma: Sigma of the logarithm of the scale.
        costs: Pairs (scale, cost), one pair for each scale for which the calibration graph was solved.
    """

    metres_per_map_unit: float
    relative_sigma: float
    costs: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleReport:
    """The selected metric scale, with its sources and its uncertainty.

    Attributes:
        source: Names of the sources in use, joined in one text.
        metres_per_map_unit: The selected scale, metres per map unit.
        relative_sigma: Sigma of the logarithm of the selected scale.
        sources: All sources of the scale, used or not.
        chi2: Chi-square of the scales of the sources about their mean.
        degrees_of_freedom: Number of degrees of freedom of the chi-square.
        body_alone: The scale that follows from the bone lengths only.
        trunk_over_floor_m: Height above the floor, metres, of the joint that the reference camera is mounted
            on; None if no floor was found.
        known_to: Sentence about the uncertainty of the scale, with advice.
    """

    source: str
    metres_per_map_unit: float
    relative_sigma: float
    sources: tuple[ScaleSourceReport, ...]
    chi2: float
    degrees_of_freedom: int
    body_alone: BodyScaleReport
    trunk_over_floor_m: float | None
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SpanReport:
    """The start and the end of a part of the motion.

    Attributes:
        from_s: Start of the part, seconds after tick 0.
        to_s: End of the part, seconds after tick 0.
    """

    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherVerticalReport:
    """A candidate for the vertical that was not selected.

    Attributes:
        name: Source of this candidate.
        off_deg: Angle between this candidate and the selected vertical, degrees.
        sigma_deg: Sigma of this candidate, degrees.
        less_likely_nats: Log-likelihood of the selected vertical minus the log-likelihood of this candidate,
            nats.
    """

    name: str
    off_deg: float
    sigma_deg: float
    less_likely_nats: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VerticalReport:
    """The selected vertical direction, with its source and its uncertainty.

    Attributes:
        source: Source of the selected vertical.
        sigma_deg: Sigma of the selected vertical, degrees.
        body_off_deg: Angle between the selected vertical and the vertical from the body, degrees. None if the
            vertical from the body was selected.
        plane_points_share: Of all map points on planes, the fraction (0 to 1) that is on a plane that agrees
            with the selected vertical.
        others: The candidates from other sources. They were not selected.
        known_to: Sentence about the uncertainty of the vertical, with advice.
    """

    source: str
    sigma_deg: float
    body_off_deg: float | None
    plane_points_share: float
    others: tuple[OtherVerticalReport, ...]
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorReport:
    """The floor that was found, and the number of points that support it.

    Attributes:
        source: Name of the method that found the floor.
        points: Number of map points that support the floor.
    """

    source: str
    points: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunnerUpRollReport:
    """The second best roll of a camera in its mount, for judging how clear the choice of the roll was.

    Attributes:
        roll_deg: The second best roll, degrees.
        half_squared_sigmas_more: Cost of this roll minus the cost of the selected roll. For the cost, each
            residual is divided by its sigma and squared. The cost is half the sum of these squares.
    """

    roll_deg: float
    half_squared_sigmas_more: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MountReport:
    """The solved mount of one camera: its pose on the bone, the uncertainty, and the change from the prior.

    Attributes:
        role: Anatomical name of the bone that the camera is mounted on.
        roll_deg: The selected roll, degrees; None if the roll was not searched.
        roll_runner_up: The second best roll; None if the roll was not searched.
        joint_from_cam: (4,4) pose of the camera in the frame of the joint, metres.
        sigma_deg: Sigma of the rotation, degrees per axis.
        sigma_m: Sigma of the position, metres per axis.
        from_prior_deg: Angle between the solved rotation and the prior rotation, degrees.
        from_prior_m: Distance between the solved position and the prior position, metres.
        from_usual_deg: Angle between the solved rotation and the usual rotation with the selected roll; None
            if the job gives the rotation.
        known_to: Sentence about the uncertainty of the mount, with advice.
    """

    role: str
    roll_deg: float | None = field(default=None, metadata=_OMIT_NONE)
    roll_runner_up: RunnerUpRollReport | None = field(default=None, metadata=_OMIT_NONE)
    joint_from_cam: tuple[tuple[float, ...], ...]
    sigma_deg: float
    sigma_m: float
    from_prior_deg: float
    from_prior_m: float
    from_usual_deg: float | None = field(default=None, metadata=_OMIT_NONE)
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraReport:
    """The measurements of one camera.

    Attributes:
        measurements: Number of poses in use.
        dropped_as_gross_errors: Number of poses that were removed as gross errors.
        down_weighted: Number of poses with a robust weight below a quarter.
        residual_m: Percentiles of the distance between the measured and the solved camera centre, metres.
        residual_deg: Percentiles of the angle between the measured and the solved rotation, degrees.
        longest_gap_s: Longest time without a measurement, seconds.
    """

    measurements: int
    dropped_as_gross_errors: int
    down_weighted: int
    residual_m: Percentiles
    residual_deg: Percentiles
    longest_gap_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SwappedSidesReport:
    """The cameras on limbs that were found on the wrong side of the body, as if left and right were swapped.

    Attributes:
        cameras: By camera name, the fraction (0 to 1) of time that the camera is on the wrong side.
        says: Sentence about these cameras for the user.
    """

    cameras: Mapping[str, float]
    says: str


@dataclass(frozen=True, slots=True, kw_only=True)
class InvertedCamerasReport:
    """The cameras that are mounted upside down, although the job does not say so.

    Attributes:
        rolls_deg: By camera name, the roll of the solved mount relative to the usual mount, degrees. It is
            between −180 and 180.
        says: Sentence about these cameras for the user.
    """

    rolls_deg: Mapping[str, float]
    says: str


@dataclass(frozen=True, slots=True, kw_only=True)
class MountSlipReport:
    """A slip of a camera's mount: after it, the camera has another pose on its bone.

    Attributes:
        at_s: Time of the slip, seconds after tick 0.
        turned_deg: Angle by which the camera turned, degrees.
        moved_m: Distance by which the camera moved, metres.
        sigma_deg: Sigma of the turn, degrees per axis.
        sigma_m: Sigma of the move, metres per axis.
        joint_from_cam: (4,4) pose of the camera in the frame of the joint after the slip, metres.
    """

    at_s: float
    turned_deg: float
    moved_m: float
    sigma_deg: float
    sigma_m: float
    joint_from_cam: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SlippedMountsReport:
    """The cameras whose mounts slipped.

    Attributes:
        cameras: By camera name, the slip of its mount.
        says: Sentence about these cameras for the user.
    """

    cameras: Mapping[str, MountSlipReport]
    says: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedCameraReport:
    """The sigmas of the pose of a map that was aligned with another map: degrees and metres, per axis.

    Attributes:
        sigma_deg: Sigma of the map's rotation, degrees per axis.
        sigma_m: Sigma of the map's position, metres per axis.
    """

    sigma_deg: float
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HingeReport:
    """A hinge joint, such as the elbow, that the motion bends out of the hinge's plane.

    Attributes:
        sigma_m: Sigma, metres, that the solver used for the distance of a point from the hinge's plane. The
            point is the far end of the bone below the hinge.
        known_to: Sentence about the violation, with advice.
    """

    sigma_m: float
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ActivityReport:
    """The soft rules of the activity.

    Attributes:
        name: Name of the activity.
        rules_active: By name of the rule, the fraction of ticks, 0 to 1, at which the rule is violated.
        rules_pressed_m: By name of the rule, percentiles of the size of the violation, metres. Only the ticks
            at which the rule is violated are used.
    """

    name: str
    rules_active: Mapping[str, float]
    rules_pressed_m: Mapping[str, Percentiles]


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverReport:
    """The size of the factor graph of the motion, and the remaining errors of its solution.

    Attributes:
        ticks: Number of ticks.
        bones: Number of bones.
        iterations: Number of iterations of the solver.
        half_squared_error: By kind of factor, the remaining error. For this error, each residual is divided
            by its sigma and squared. The error is half the sum of these squares.
    """

    ticks: int
    bones: int
    iterations: int
    half_squared_error: Mapping[str, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class MergeReport:
    """The report of the merging stage.

    Attributes:
        scale: The metric scale.
        t_pose: The T-pose; None if no T-pose was found.
        up: The vertical.
        floor: The floor.
        mounts: By camera name, the solved mount.
        cameras: By camera name, the measurements of the camera.
        exchanged_sides: Cameras that seem to be on the wrong side of the body; None if there are none.
        inverted_cameras: Cameras that are mounted upside down; None if there are none.
        slipped_mounts: Cameras whose mounts slipped; None if there are none.
        still_cameras: By name of a camera on a limb that stands still in the room for some time while the
            trunk moves, the time in which its frames are not used for the body.
        unused_cameras: By camera name, the reason why the camera's map could not be linked to the body. Only
            cameras with such a map have an entry.
        joined_cameras: By name of a camera in an aligned map, the uncertainty of the map's pose.
        joint_gap_m: By role of a joint, percentiles of its gap: the distance, metres, between the ends of the
            two bones that meet at the joint.
        posture_sigmas: By role of a joint, distance of its rotation from the rest pose, in sigmas of its
            everyday range (root mean square over axes and over ticks outside the T-pose).
        mean_posture_sigmas: As `posture_sigmas`, for the mean rotation over these ticks.
        joint_sigma_m: By role of a joint, then by ``observed`` or ``filled``, percentiles of the sigma of the
            joint's centre, metres per axis.
        flexion_sigma_deg: By role of the bone below an elbow or a knee, then by ``observed`` or ``filled``,
            percentiles of the sigma of its flexion, degrees.
        hinge_off_plane_m: By role of a joint, percentiles of its distance, metres, from the plane of a hinge.
            The joint is at the far end of the bone below the hinge.
        loose_hinges: By role of the bone below a hinge, the violation of the hinge. Hinges that the motion
            does not violate have no entry.
        activity: The soft rules of the activity.
        foot_contact: By foot, figures on how often the foot stands and how fast the standing foot slides.
        solver: The solution of the motion graph.
    """

    scale: ScaleReport
    t_pose: SpanReport | None
    up: VerticalReport
    floor: FloorReport
    mounts: Mapping[str, MountReport]
    cameras: Mapping[str, CameraReport]
    exchanged_sides: SwappedSidesReport | None = field(metadata=_EMPTY_IF_NONE)
    inverted_cameras: InvertedCamerasReport | None = field(default=None, metadata=_OMIT_NONE)
    slipped_mounts: SlippedMountsReport | None = field(default=None, metadata=_OMIT_NONE)
    still_cameras: Mapping[str, SpanReport]
    unused_cameras: Mapping[str, str]
    joined_cameras: Mapping[str, AlignedCameraReport]
    joint_gap_m: Mapping[str, Percentiles]
    posture_sigmas: Mapping[str, float]
    mean_posture_sigmas: Mapping[str, float]
    joint_sigma_m: Mapping[str, Mapping[str, Percentiles]]
    flexion_sigma_deg: Mapping[str, Mapping[str, Percentiles]]
    hinge_off_plane_m: Mapping[str, Percentiles]
    loose_hinges: Mapping[str, HingeReport]
    activity: ActivityReport
    foot_contact: Mapping[str, Mapping[str, float]]
    solver: SolverReport

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain JSON values, the form that is stored and written to ``metrics.json``."""
        return dict(_to_plain(self))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MergeReport:
        """Return the report from plain JSON values.

        Missing values become empty or NaN, and unknown keys are ignored. Therefore results of other versions
        can be read.
        """
        return typing.cast(MergeReport, _from_plain(values, cls))


def _to_plain(value: Any) -> Any:
    """Convert a value of the report to plain JSON values."""
    if dataclasses.is_dataclass(value):
        out = {}
        for item in dataclasses.fields(value):
            part = getattr(value, item.name)
            if part is None and item.metadata.get("omit_none"):
                continue
            out[item.name] = {} if part is None and item.metadata.get("empty_if_none") else _to_plain(part)
        return out
    if isinstance(value, Mapping):
        return {key: _to_plain(part) for key, part in value.items()}
    return [_to_plain(part) for part in value] if isinstance(value, tuple) else value


def _from_plain(value: Any, hint: Any) -> Any:
    """Convert plain JSON values to the type `hint`. None becomes the empty value of the type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        (inner,) = (argument for argument in arguments if argument is not type(None))
        is_missing = value is None or (value == {} and dataclasses.is_dataclass(inner))
        return None if is_missing else _from_plain(value, inner)
    if dataclasses.is_dataclass(hint):
        hints, values = typing.get_type_hints(hint), value or {}
        parts = {name: _from_plain(values.get(name), inner) for name, inner in hints.items()}
        return typing.cast(type, hint)(**parts)
    if origin is tuple:
        inners = arguments[:1] * len(value or ()) if arguments[1:] == (Ellipsis,) else arguments
        return tuple(_from_plain(part, inner) for part, inner in zip(value or (), inners, strict=True))
    if origin is Mapping:
        return {key: _from_plain(part, arguments[1]) for key, part in (value or {}).items()}
    if value is None:
        return math.nan if hint is float else hint()
    return value
