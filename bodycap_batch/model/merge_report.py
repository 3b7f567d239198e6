"""The report of the merging stage: sources, values, residuals and doubts, typed.

The names of the fields are the keys of the stored result and of ``merge`` in ``metrics.json``.
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
"""Metadata of a field that has no key if it is None."""
_EMPTY_IF_NONE = {"empty_if_none": True}
"""Metadata of a field that is an empty mapping if it is None."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Percentiles:
    """Median and 95th percentile of some values."""

    p50: float
    p95: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleSourceReport:
    """One source of the metric scale.

    Attributes:
        name: Its name.
        metres_per_map_unit: Its scale.
        relative_sigma: Sigma of the logarithm of the scale.
        off: Logarithm of its scale over the scale that was taken.
        used: False if it was rejected, or replaced by a better one.
    """

    name: str
    metres_per_map_unit: float
    relative_sigma: float
    off: float
    used: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyScaleReport:
    """The scale from the bones alone.

    Attributes:
        metres_per_map_unit: The scale.
        relative_sigma: Sigma of its logarithm.
        costs: (scale, cost) of every solution of the calibration graph.
    """

    metres_per_map_unit: float
    relative_sigma: float
    costs: tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LimbScalesReport:
    """The scale of each limb alone.

    Attributes:
        alone: The scales.
        chi2: Chi-square of the scales about their mean.
        degrees_of_freedom: Of the chi-square.
    """

    alone: tuple[ScaleSourceReport, ...]
    chi2: float
    degrees_of_freedom: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ScaleReport:
    """The metric scale.

    Attributes:
        source: Names of the sources in use.
        metres_per_map_unit: The scale that was taken.
        relative_sigma: Sigma of its logarithm.
        sources: All sources.
        chi2: Chi-square of all sources about their mean.
        degrees_of_freedom: Of the chi-square.
        body_alone: The scale from the bones alone.
        trunk_over_floor_m: Height of the reference camera's joint over the floor; None if no floor was found.
        known_to: A sentence on the uncertainty, with advice.
        limbs: The scale of each limb alone; None if there are fewer than two limbs.
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
    limbs: LimbScalesReport | None = field(default=None, metadata=_OMIT_NONE)


@dataclass(frozen=True, slots=True, kw_only=True)
class TPoseReport:
    """The time of a T-pose, seconds from tick 0."""

    from_s: float
    to_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class OtherVerticalReport:
    """A vertical that was not taken.

    Attributes:
        name: Its source.
        off_deg: Angle to the vertical that was taken.
        sigma_deg: Its uncertainty.
        less_likely_nats: Negative log-likelihood beyond that of the vertical that was taken.
    """

    name: str
    off_deg: float
    sigma_deg: float
    less_likely_nats: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VerticalReport:
    """The vertical.

    Attributes:
        source: Its source.
        sigma_deg: Its uncertainty.
        body_off_deg: Angle to the vertical from the body alone; None if that was taken.
        plane_points_share: Part of the planes' points that agree with it, 0 to 1.
        others: Verticals of other sources.
        known_to: A sentence on the uncertainty, with advice.
    """

    source: str
    sigma_deg: float
    body_off_deg: float | None
    plane_points_share: float
    others: tuple[OtherVerticalReport, ...]
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class FloorReport:
    """The floor.

    Attributes:
        source: Its source.
        points: Number of map points in it.
    """

    source: str
    points: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RunnerUpRollReport:
    """The best roll that was not taken.

    Attributes:
        roll_deg: The roll.
        half_squared_sigmas_more: Half the sum of squares beyond that of the roll that was taken.
    """

    roll_deg: float
    half_squared_sigmas_more: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MountReport:
    """A solved mount.

    Attributes:
        role: Anatomical name of the bone.
        roll_deg: The roll that was taken; None if it was not searched.
        roll_runner_up: The best other roll; None if the roll was not searched.
        joint_from_cam: (4,4) pose of the camera in the joint's frame.
        sigma_deg: Uncertainty of the rotation, per axis.
        sigma_m: Uncertainty of the position, per axis.
        from_prior_deg: Angle to the prior.
        from_prior_m: Distance from the prior.
        known_to: A sentence on the uncertainty, with advice.
    """

    role: str
    roll_deg: float | None = field(default=None, metadata=_OMIT_NONE)
    roll_runner_up: RunnerUpRollReport | None = field(default=None, metadata=_OMIT_NONE)
    joint_from_cam: tuple[tuple[float, ...], ...]
    sigma_deg: float
    sigma_m: float
    from_prior_deg: float
    from_prior_m: float
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraReport:
    """The measurements of one camera.

    Attributes:
        measurements: Number of poses in use.
        dropped_as_gross_errors: Number of poses that were dropped.
        down_weighted: Number of poses with a robust weight below a quarter.
        residual_m: Distance of the measured centre from the solved one.
        residual_deg: Angle of the measured rotation to the solved one.
        longest_gap_s: Longest time without a measurement.
    """

    measurements: int
    dropped_as_gross_errors: int
    down_weighted: int
    residual_m: Percentiles
    residual_deg: Percentiles
    longest_gap_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockReport:
    """A camera with a suspicious clock.

    Attributes:
        shift_s: Time to add to its timestamps.
        scatter_left: Part of the scatter of its positions on the body that remains after the shift, 0 to 1.
        offset_s: The clock offset that includes the shift.
        says: A sentence for the user.
    """

    shift_s: float
    scatter_left: float
    offset_s: float
    says: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SwappedSidesReport:
    """Limbs' cameras that stay on the other side of the body.

    Attributes:
        cameras: By camera, the part of its time on the wrong side, 0 to 1.
        says: A sentence for the user.
    """

    cameras: Mapping[str, float]
    says: str


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignedCameraReport:
    """The uncertainty of an aligned map's pose, per axis."""

    sigma_deg: float
    sigma_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class HingeReport:
    """A hinge that the motion violates.

    Attributes:
        sigma_m: Sigma by which the far end of the bone below leaves the hinge's plane.
        known_to: A sentence on the violation, with advice.
    """

    sigma_m: float
    known_to: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ActivityReport:
    """The soft rules of the activity.

    Attributes:
        name: Name of the activity.
        rules_active: By rule, the part of the ticks at which it is violated, 0 to 1.
        rules_pressed_m: By rule, by how much it is violated at these ticks.
    """

    name: str
    rules_active: Mapping[str, float]
    rules_pressed_m: Mapping[str, Percentiles]


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverReport:
    """The solution of the motion graph.

    Attributes:
        ticks: Number of ticks.
        bones: Number of bones.
        iterations: Number of iterations.
        half_squared_error: By kind of factor, half the sum of squares.
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
        t_pose: The T-pose; None without one.
        up: The vertical.
        floor: The floor.
        mounts: By camera, its solved mount.
        cameras: By camera, its measurements.
        doubted_clocks: By camera, a clock that seems wrong.
        exchanged_sides: Cameras that seem to be on the wrong side; None if there are none.
        unused_cameras: By camera that is no part of the body, the reason.
        joined_cameras: By camera of an aligned map, the uncertainty of its map's pose.
        joint_gap_m: By role, the gap of the joint.
        joint_sigma_m: By role, then ``observed`` or ``filled``, the sigma of the joint's centre per axis.
        hinge_off_plane_m: By role, the distance of a hinged bone's far end from the hinge's plane.
        loose_hinges: By role, a hinge that the motion violates.
        activity: The soft rules.
        foot_contact: By foot, how often it stands and how fast it slides meanwhile.
        solver: The solution of the motion graph.
    """

    scale: ScaleReport
    t_pose: TPoseReport | None
    up: VerticalReport
    floor: FloorReport
    mounts: Mapping[str, MountReport]
    cameras: Mapping[str, CameraReport]
    doubted_clocks: Mapping[str, ClockReport]
    exchanged_sides: SwappedSidesReport | None = field(metadata=_EMPTY_IF_NONE)
    unused_cameras: Mapping[str, str]
    joined_cameras: Mapping[str, AlignedCameraReport]
    joint_gap_m: Mapping[str, Percentiles]
    joint_sigma_m: Mapping[str, Mapping[str, Percentiles]]
    hinge_off_plane_m: Mapping[str, Percentiles]
    loose_hinges: Mapping[str, HingeReport]
    activity: ActivityReport
    foot_contact: Mapping[str, Mapping[str, float]]
    solver: SolverReport

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values, as they are stored and written to ``metrics.json``."""
        return dict(_to_plain(self))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> MergeReport:
        """Return the report from plain values.

        Missing values become empty or NaN, and unknown keys are dropped. So results of other versions can be
        read.
        """
        return typing.cast(MergeReport, _from_plain(values, cls))


def _to_plain(value: Any) -> Any:
    """Return plain JSON values."""
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
    """Return plain JSON values as a type; None as the empty value of that type."""
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
