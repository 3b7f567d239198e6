"""Select the vertical from hypotheses of the map, the walk, the body and the job (solved frame of reference).

For each hypothesis, the module computes the negative log-likelihood (nats) of all observations, on the
assumption that the hypothesis is right. The negative log-likelihood is a sum of terms. The constants of the
terms are set by hand.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.trunk_lean import TrunkOrientation
from bodycap_batch.merging.graph.posture import path_slopes, vertical_from_path
from bodycap_batch.merging.world.planes import (
    BENT_TILT_LIMIT_DEG,
    PLANE_HALF_THICKNESS_M,
    TILT_LIMIT_DEG,
    Plane,
    find_planes,
    misalignment_deg,
    vertical_from_planes,
)

ACCELEROMETERS = "accelerometers"
"""Source of a vertical that the accelerometers of the cameras measure."""
_LEAN_SAMPLES = 3.0
"""The tilt of the trunk (its lean) over a whole capture counts as this number of independent observations.
The number is small because the posture's systematic bias is equal at all instants. Evidence: none."""
_PLANE_SHARE_NATS = 6.0
"""Maximum cost (nats) of planes that do not agree with a vertical from planes. The cost is this maximum times
the fraction of the planes' points that do not agree. Evidence: none."""
_WALK_NATS, _BODY_NATS = 1.5, 12.0
"""Costs (nats) of a vertical from the walk, and of a vertical that is based only on the tilt of the trunk.
Because of these costs, a vertical from planes is preferred if it also agrees with the body. Evidence:
none."""
_SCENE_NATS = 4.0
"""Cost (nats) for each of two signs of a wrong vertical. First: along this vertical, the trunk moves up and
down by more than its standing height (stairs are rare). Second: map points lie below the floor. Evidence:
none."""
_FLOOR_NATS = 2.0
"""Gain (nats) of a vertical for which the map has a horizontal plane at the expected height of the floor.
Evidence: none."""
_FLOOR_TOLERANCE, _MAX_SHARE_BELOW = 0.35, 0.02
"""First: maximum error of the floor's height, as a ratio to the trunk's standing height. It allows for a
rough scale and for bent knees. Second: maximum fraction of map points below the floor; such points are wrong.
Evidence: none."""
_MIN_MARGIN_NATS = 3.0
"""Minimum difference (nats) between the negative log-likelihoods of the best rival and the vertical. With a
smaller difference, the vertical is not determined. Three nats are odds of twenty to one."""
_STATED_SIGMAS = 3.0
"""A vertical from planes replaces a vertical given in the job if the angle between the two is smaller than
this number of sigmas of the given vertical."""
_DISTINCT_DEG = 20.0
"""Minimum angle (degrees) between the vertical and a rival. A hypothesis at a smaller angle is treated as the
same vertical with a small error. Evidence: none."""
_SEARCH_DEG = 5.0
"""Radius (degrees) of the search about a plane's normal, or about a direction that is parallel to two planes.
Evidence: none."""
_SAME_DEG, _MAX_FLOOR_TILT_DEG = 1.0, 5.0
"""First: minimum angle (degrees) between a new start of the search and all directions that were found before.
Second: maximum angle (degrees) between a floor and the horizontal plane. Evidence: none."""
_MIN_PLANE_SIGMA_DEG, _WALK_SIGMA_DEG, _BODY_SIGMA_DEG = 0.7, 2.0, 15.0
"""Sigmas (degrees). First: minimum sigma of a vertical from planes. Evidence: docs/decisions/merging.md.
Second: sigma of a vertical from the walk. The path of a walking trunk is horizontal to two degrees. Third:
minimum sigma of a vertical from the body of a walker. This sigma allows for an error of the camera's mount,
which looks like a tilt of the body."""
_LEVEL_SIGMA_DEG = 0.6
"""Sigma (degrees) of the slope of a floor on which a person walks, along each axis. Derivation: 1 %, as
streets and floors with a drain."""
_SLOPING_DEG, _SLOPING_ODDS = 10.0, 0.1
"""First: sigma of the slope of stairs and ramps. Second: odds that a person walks on them. Evidence: none."""
_PLANE_SIGMA_LIMIT_DEG = 1.5
"""Maximum misalignment (degrees) of a plane that is used for the sigma of a vertical. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerticalHypothesis:
    """A direction that may be the vertical. The most likely hypothesis becomes the vertical.

    Attributes:
        source: Origin of the direction: "map" (planes of the map), "walk", "body", "marker board" or
            "accelerometers".
        up: (3,) unit vector in the solved frame of reference.
        sigma_deg: Sigma (degrees) of the direction, if this hypothesis is the right one.
        share: Fraction of the planes' points that agree with the direction; 0 if the direction does not come
            from planes.
        negative_log_likelihood: Negative log-likelihood (nats) of all observations, if this hypothesis is
            right.
    """

    source: str
    up: FloatArray
    sigma_deg: float
    share: float = 0.0
    negative_log_likelihood: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Vertical(VerticalHypothesis):
    """The vertical in the solved frame of reference: the selected hypothesis.

    Attributes:
        body_off_deg: Angle (degrees) to the up direction of the upright body; None if the vertical comes from
            the body.
        alternatives: Best hypothesis of each other source, and the best rival.
        margin_nats: Negative log-likelihood (nats) of the best rival minus `negative_log_likelihood`; None if
            there is no rival. A rival is a hypothesis with a clearly different direction that does not come
            from the body. If the job gives verticals, only these verticals can be rivals.
    """

    body_off_deg: float | None
    alternatives: tuple[VerticalHypothesis, ...] = ()
    margin_nats: float | None = None

    def is_determined(self) -> bool:
        """Return whether the observations determine the vertical.

        The best rival must be clearly less likely. A vertical that comes from the body must have a small
        sigma.
        """
        if self.rests_on_lean_only():
            return False
        return self.margin_nats is None or self.margin_nats >= _MIN_MARGIN_NATS

    def rests_on_lean_only(self) -> bool:
        """Return whether the vertical is based only on the tilt of the trunk and has a large sigma.

        A constant tilt of the trunk cannot be distinguished from an error of the vertical.
        """
        return self.source == "body" and self.sigma_deg > _DISTINCT_DEG


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneContext:
    """The map around a trunk, and the path of the trunk.

    Attributes:
        points_m: (P,3) map points in the solved frame of reference.
        path_m: (N,3) positions of the trunk's camera in the solved frame of reference.
        standing_m: Height (metres) of the trunk's joint above the soles of the standing person.
        walks: Whether the person walks most of the time.
    """

    points_m: FloatArray
    path_m: FloatArray
    standing_m: float
    walks: bool = False


def estimate_vertical(
    body: TrunkOrientation,
    scene: SceneContext,
    rng: np.random.Generator,
    stated: Sequence[VerticalHypothesis] = (),
) -> Vertical:
    """Select the most likely vertical among hypotheses from the planes, the walk, the body and the job.

    A vertical that accelerometers measure is preferred to all others.

    The planes of a room are compatible with six or more directions. Three observations show which direction
    is up. The first is the tilt of the trunk: often forward, seldom backward or sideways. The second is how
    far the trunk rises and falls. The third is whether the map has a floor at the expected height.

    Args:
        body: Orientation of the trunk over time.
        scene: The map and the path of the trunk.
        rng: Random generator for the search for planes.
        stated: Verticals given in the job, or measured by accelerometers. If there are any, the measured one
            is selected, else the most likely of them, even if another hypothesis is more likely. If a
            vertical from planes agrees with the selected vertical, the vertical from planes is used, unless
            the selected one was measured with a smaller sigma.
    """
    planes = find_planes(scene.points_m, rng)
    hints = [body.modal_up(), body.mean_up(), body.upright_up()]
    upright = hints[2]
    hypotheses = [
        *_hypotheses_from_planes(planes, hints),
        *(
            VerticalHypothesis(
                source="walk", up=up, sigma_deg=_WALK_SIGMA_DEG, negative_log_likelihood=_WALK_NATS
            )
            for up in (vertical_from_path(scene.path_m, hint) for hint in hints)
            if up is not None
        ),
        VerticalHypothesis(
            source="body",
            up=upright,
            sigma_deg=_body_sigma_deg(body, upright, scene.walks),
            negative_log_likelihood=_BODY_NATS,
        ),
        *stated,
    ]
    leans = _LEAN_SAMPLES * body.negative_log_likelihood(np.array([each.up for each in hypotheses]))
    hypotheses = [
        replace(
            each,
            negative_log_likelihood=_cost(each) + lean + _scene_penalty(each.up, planes, scene),
        )
        for each, lean in zip(hypotheses, leans.tolist(), strict=True)
    ]
    stated_sources = {each.source for each in stated}
    selected = _select(hypotheses, stated_sources)
    if scene.walks and selected.source == "map":
        selected = _levelled(selected, scene.path_m)
    return _vertical_from_hypotheses(selected, hypotheses, stated_sources, upright)


def _cost(hypothesis: VerticalHypothesis) -> float:
    return hypothesis.negative_log_likelihood


def _select(hypotheses: Sequence[VerticalHypothesis], stated: Collection[str]) -> VerticalHypothesis:
    """Return the hypothesis with the lowest negative log-likelihood.

    If the job gives verticals, only these verticals are candidates. A hypothesis from planes that agrees
    with the best candidate within 3 sigma then replaces this candidate. A vertical from accelerometers is the
    best candidate, and only a hypothesis from planes with a smaller sigma replaces it.
    """
    measured = [each for each in hypotheses if each.source == ACCELEROMETERS]
    candidates = measured or [each for each in hypotheses if not stated or each.source in stated]
    best = min(candidates, key=_cost)
    agreeing = [
        each
        for each in hypotheses
        if stated
        and each.source == "map"
        and angle_deg(each.up, best.up) < _STATED_SIGMAS * best.sigma_deg
        and (not measured or each.sigma_deg < best.sigma_deg)
    ]
    return min(agreeing, key=_cost, default=best)


def _levelled(vertical: VerticalHypothesis, path_m: FloatArray) -> VerticalHypothesis:
    """Return a vertical that is combined with the slope of a walk, because most floors are level.

    Along each principal axis of the path, the slope of the path is a measurement of the error of the
    vertical. Its variance contains that of floors, and that of the bounce of the trunk. The slope counts by
    the probability that the floor is level.

    Args:
        vertical: The vertical, and its sigma.
        path_m: (N,3) positions of the trunk's camera in the solved frame of reference.
    """
    slopes, variances, axes = path_slopes(path_m, vertical.up)
    before, level, sloping = (
        np.radians(each) ** 2 for each in (vertical.sigma_deg, _LEVEL_SIGMA_DEG, _SLOPING_DEG)
    )
    measured = before + variances + level
    anywhere = before + variances + sloping
    odds = _SLOPING_ODDS * np.sqrt(measured / anywhere)
    odds = odds * np.exp(0.5 * slopes**2 * (1.0 / measured - 1.0 / anywhere))
    gain = before / measured / (1.0 + odds)
    up = vertical.up - (gain * slopes) @ axes
    return replace(
        vertical,
        up=up / np.linalg.norm(up),
        sigma_deg=vertical.sigma_deg * float(np.sqrt(1.0 - gain.mean())),
    )


def _vertical_from_hypotheses(
    selected: VerticalHypothesis,
    hypotheses: Sequence[VerticalHypothesis],
    stated: Collection[str],
    upright: FloatArray,
) -> Vertical:
    """Return the selected vertical with its alternatives and the margin to its best rival.

    Args:
        selected: The most likely hypothesis.
        hypotheses: All hypotheses, including the selected one.
        stated: Sources of the verticals given in the job. If there are any, only hypotheses from these
            sources are rivals.
        upright: (3,) up direction of the upright body.
    """
    best: dict[str, VerticalHypothesis] = {}
    for each in sorted(hypotheses, key=_cost):
        if each.source != selected.source:
            best.setdefault(each.source, each)
    far = [
        each
        for each in hypotheses
        if angle_deg(each.up, selected.up) > _DISTINCT_DEG
        and (each.source in stated if stated else each.source != "body")
    ]
    rival = min(far, key=_cost, default=None)
    alternatives = list(best.values())
    if rival is not None and all(rival is not each for each in alternatives):
        alternatives.append(rival)
    return Vertical(
        **{item.name: getattr(selected, item.name) for item in fields(selected)},
        body_off_deg=None if selected.source == "body" else angle_deg(selected.up, upright),
        alternatives=tuple(alternatives),
        margin_nats=None if rival is None else _cost(rival) - _cost(selected),
    )


def _hypotheses_from_planes(planes: Sequence[Plane], hints: Sequence[FloatArray]) -> list[VerticalHypothesis]:
    """Return the directions that many planes are parallel or perpendicular to, without duplicates.

    Args:
        planes: Planes of the map.
        hints: Up directions of the body. The search starts from these directions, from the planes' normals,
            and from the directions that are parallel to two planes.
    """
    normals = [plane.normal for plane in planes]
    level = [np.cross(a, b) for i, a in enumerate(normals) for b in normals[:i]]
    axes = [axis / np.linalg.norm(axis) for axis in (*normals, *level) if np.linalg.norm(axis) > 0.5]
    searches = [(hint, limit) for hint in hints for limit in (TILT_LIMIT_DEG, BENT_TILT_LIMIT_DEG)]
    searches += [(sign * axis, _SEARCH_DEG) for axis in axes for sign in (1.0, -1.0)]
    out: list[VerticalHypothesis] = []
    for hint, limit_deg in searches:
        if limit_deg == _SEARCH_DEG and any(angle_deg(hint, each.up) < _SAME_DEG for each in out):
            continue
        found = vertical_from_planes(planes, hint, limit_deg)
        if found is None or any(angle_deg(found.up, each.up) < 0.1 * _SAME_DEG for each in out):
            continue
        out.append(
            VerticalHypothesis(
                source="map",
                up=found.up,
                sigma_deg=_plane_sigma_deg(planes, found.up),
                share=found.inlier_share,
                negative_log_likelihood=_PLANE_SHARE_NATS * (1.0 - found.inlier_share),
            )
        )
    return out


def _plane_sigma_deg(planes: Sequence[Plane], up: FloatArray) -> float:
    """Return the sigma (degrees) of a vertical, from the misalignments of the planes that nearly agree."""
    off = misalignment_deg(np.array([float(plane.normal @ up) for plane in planes]))
    near = off[off < _PLANE_SIGMA_LIMIT_DEG]
    return float(np.hypot(_MIN_PLANE_SIGMA_DEG, np.sqrt((near**2).sum()) / max(len(near) - 1, 1)))


def _body_sigma_deg(body: TrunkOrientation, up: FloatArray, walks: bool) -> float:
    """Return the sigma (degrees) of a vertical that is based only on the body.

    A walking person is upright. The sigma then combines two angles: the error of the camera's mount, and half
    of the trunk's RMS tilt. A person who sits, stands or works may tilt the trunk all the time. The sigma is
    then the spread of the verticals that the tilts allow.
    """
    if not walks:
        return body.posterior_spread_deg(up)
    moved = np.degrees(np.arccos(np.clip(body.axes[:, :, 2] @ up, -1.0, 1.0)))
    return float(np.hypot(_BODY_SIGMA_DEG, 0.5 * np.sqrt((moved**2).mean())))


def _scene_penalty(up: FloatArray, planes: Sequence[Plane], scene: SceneContext) -> float:
    """Return the negative log-likelihood (nats) of the map and of the trunk's path, given a vertical."""
    heights = scene.path_m @ up
    low, high = np.percentile(heights, [2.0, 98.0])
    nats = _SCENE_NATS if high - low > scene.standing_m else 0.0
    deepest = high - (1.0 + _FLOOR_TOLERANCE) * scene.standing_m
    if len(scene.points_m) and float((scene.points_m @ up < deepest).mean()) > _MAX_SHARE_BELOW:
        nats += _SCENE_NATS
    for plane in planes:
        along = float(plane.normal @ up)
        if abs(along) > np.cos(np.radians(_MAX_FLOOR_TILT_DEG)):
            depth = high - plane.offset_m * float(np.sign(along))
            if abs(depth - scene.standing_m) < _FLOOR_TOLERANCE * scene.standing_m + PLANE_HALF_THICKNESS_M:
                return nats - _FLOOR_NATS
    return nats


def angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Return the angle (degrees) between two unit vectors (3,)."""
    return float(np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0))))
