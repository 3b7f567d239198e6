"""The vertical: hypotheses from the map, the walk, the body and the job are weighed against each other.

Each hypothesis has a negative log-likelihood (nats) of everything that is observed, if it were right. The
terms are set by hand.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body.trunk_lean import TrunkOrientation
from bodycap_batch.merging.graph.posture import vertical_from_path
from bodycap_batch.merging.world.planes import (
    BENT_TILT_LIMIT_DEG,
    PLANE_HALF_THICKNESS_M,
    TILT_LIMIT_DEG,
    Plane,
    find_planes,
    misalignment_deg,
    vertical_from_planes,
)

_LEAN_SAMPLES = 3.0
"""Number of independent observations that the lean of a whole capture is worth: the posture's systematic bias
is the same in all of them. Evidence: none."""
_PLANE_SHARE_NATS = 6.0
"""Cost in nats of a vertical that none of the planes' points agree with. Evidence: none."""
_WALK_NATS, _BODY_NATS = 1.5, 12.0
"""Cost in nats of a vertical from the walk, and from the body's lean alone. A vertical from planes is
preferred to these if it agrees with the body as well. Evidence: none."""
_SCENE_NATS = 4.0
"""Cost in nats of a trunk that moves farther up and down than its standing height, as on stairs; and of a
scene with points below its floor. Evidence: none."""
_FLOOR_NATS = 2.0
"""Gain in nats of a level plane where the floor must be. Evidence: none."""
_FLOOR_TOLERANCE, _MAX_SHARE_BELOW = 0.35, 0.02
"""Largest error of the floor's height, over the trunk's height, because of a rough scale or bent knees; and
largest ratio of wrong points below the floor. Evidence: none."""
_MIN_MARGIN_NATS = 3.0
"""Smallest difference in nats to the next best direction that determines the vertical: odds of twenty to
one."""
_STATED_SIGMAS = 3.0
"""Largest angle, in sigmas, at which planes agree with a stated vertical."""
_DISTINCT_DEG = 20.0
"""Angle in degrees above which another direction is a rival, and not an error of the same one. Evidence:
none."""
_SEARCH_DEG = 5.0
"""Radius in degrees of the search about a normal, or about a direction parallel to two planes. Evidence:
none."""
_SAME_DEG, _MAX_FLOOR_TILT_DEG = 1.0, 5.0
"""Angle in degrees within which a direction was searched already; and largest tilt of a floor. Evidence:
none."""
_MIN_PLANE_SIGMA_DEG, _WALK_SIGMA_DEG, _BODY_SIGMA_DEG = 0.7, 2.0, 15.0
"""Sigmas in degrees. Planes: docs/decisions/merging.md. A walk's ground and bounce are level to two degrees.
A rotation of the camera's mount looks like a lean of the body."""
_PLANE_SIGMA_LIMIT_DEG = 1.5
"""Largest angle in degrees of the planes from which the sigma of a vertical is computed. Evidence: none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerticalHypothesis:
    """A direction that may be the vertical.

    Attributes:
        source: "map" (its planes), "walk", "body" or "marker board".
        up: (3,) in the solved frame.
        sigma_deg: Its error, if it is the right one of several directions.
        share: Ratio of the planes' points that agree; 0 if it does not come from planes.
        negative_log_likelihood: Of everything observed if it is right, nats.
    """

    source: str
    up: FloatArray
    sigma_deg: float
    share: float = 0.0
    negative_log_likelihood: float = 0.0


@dataclass(frozen=True, slots=True)
class Vertical:
    """The vertical in the solved frame.

    Attributes:
        up: (3,).
        source: Of the hypothesis.
        body_off_deg: Angle to the upright body; None if the vertical comes from the body.
        plane_share: Ratio of the planes' points that agree with it.
        sigma_deg: Its error.
        alternatives: The best hypothesis of each other source, and the best rival.
        negative_log_likelihood: Of everything observed, nats.
        margin_nats: Negative log-likelihood of the best rival minus that of the vertical; None without a
            rival. If the job states the vertical, only stated directions are rivals.
    """

    up: FloatArray
    source: str
    body_off_deg: float | None
    plane_share: float
    sigma_deg: float = 0.0
    alternatives: tuple[VerticalHypothesis, ...] = ()
    negative_log_likelihood: float = 0.0
    margin_nats: float | None = None

    def is_determined(self) -> bool:
        """Return whether the best rival is clearly less likely, and a constant lean would have shown."""
        if self.rests_on_lean_only():
            return False
        return self.margin_nats is None or self.margin_nats >= _MIN_MARGIN_NATS

    def rests_on_lean_only(self) -> bool:
        """Return whether it comes from a lean alone that may have been the same all the time."""
        return self.source == "body" and self.sigma_deg > _DISTINCT_DEG


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneContext:
    """The map around a trunk, and its path.

    Attributes:
        points_m: (P,3) map points in the solved frame.
        path_m: (N,3) path of the trunk's camera.
        standing_m: Height of the trunk's joint above the soles of the standing person.
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
    """Select the most likely vertical among those of the planes, the walk, the body and the job.

    A room's planes leave six directions or more. Three observations show which of them is up: how the trunk
    leans (forward, seldom backward or sideways), how far it rises and falls, and whether there is a floor
    where it must be.

    Args:
        body: The trunk over time.
        scene: The map and the trunk's path.
        rng: Draws the hypotheses of the planes.
        stated: From the job. The most likely of them is selected, whatever the others say, and replaced by
            that of planes that agree with it.
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
        VerticalHypothesis(
            source=each.source,
            up=each.up,
            sigma_deg=each.sigma_deg,
            share=each.share,
            negative_log_likelihood=each.negative_log_likelihood
            + lean
            + _scene_penalty(each.up, planes, scene),
        )
        for each, lean in zip(hypotheses, leans.tolist(), strict=True)
    ]
    stated_sources = {each.source for each in stated}
    selected = _select(hypotheses, stated_sources)
    return _vertical_from_hypotheses(selected, hypotheses, stated_sources, upright)


def _cost(hypothesis: VerticalHypothesis) -> float:
    return hypothesis.negative_log_likelihood


def _select(hypotheses: Sequence[VerticalHypothesis], stated: Collection[str]) -> VerticalHypothesis:
    """Return the hypothesis with the lowest negative log-likelihood.

    If the job states the vertical, choose among the stated ones, and take the direction of map planes that
    agree within 3 sigma.
    """
    best = min((each for each in hypotheses if not stated or each.source in stated), key=_cost)
    agreeing = [
        each
        for each in hypotheses
        if stated and each.source == "map" and angle_deg(each.up, best.up) < _STATED_SIGMAS * best.sigma_deg
    ]
    return min(agreeing, key=_cost, default=best)


def _vertical_from_hypotheses(
    selected: VerticalHypothesis,
    hypotheses: Sequence[VerticalHypothesis],
    stated: Collection[str],
    upright: FloatArray,
) -> Vertical:
    """Return the selected vertical with its alternatives and the margin to its best rival.

    Args:
        selected: The most likely hypothesis.
        hypotheses: All of them.
        stated: Sources of the stated ones; only these are rivals then.
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
        up=selected.up,
        source=selected.source,
        body_off_deg=None if selected.source == "body" else angle_deg(selected.up, upright),
        plane_share=selected.share,
        sigma_deg=selected.sigma_deg,
        alternatives=tuple(alternatives),
        negative_log_likelihood=selected.negative_log_likelihood,
        margin_nats=None if rival is None else _cost(rival) - _cost(selected),
    )


def _hypotheses_from_planes(planes: Sequence[Plane], hints: Sequence[FloatArray]) -> list[VerticalHypothesis]:
    """Return all directions to which most planes are parallel or perpendicular.

    Args:
        planes: Of the map.
        hints: Up directions of the body, where the search starts besides the planes' own normals.
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
    """Return the sigma (degrees) of a vertical from the planes that nearly agree with it."""
    off = misalignment_deg(np.array([float(plane.normal @ up) for plane in planes]))
    near = off[off < _PLANE_SIGMA_LIMIT_DEG]
    return float(np.hypot(_MIN_PLANE_SIGMA_DEG, np.sqrt((near**2).sum()) / max(len(near) - 1, 1)))


def _body_sigma_deg(body: TrunkOrientation, up: FloatArray, walks: bool) -> float:
    """Return the sigma (degrees) of a vertical from the body alone.

    A person who walks is upright. The sigma then contains a rotation of the camera's mount, which looks like
    a lean, and half of the trunk's movement. A person who sits, stands or works may lean all the time.
    """
    if not walks:
        return body.posterior_spread_deg(up)
    moved = np.degrees(np.arccos(np.clip(body.axes[:, :, 2] @ up, -1.0, 1.0)))
    return float(np.hypot(_BODY_SIGMA_DEG, 0.5 * np.sqrt((moved**2).mean())))


def _scene_penalty(up: FloatArray, planes: Sequence[Plane], scene: SceneContext) -> float:
    """Return the negative log-likelihood (nats) of the room and of the path through it for a vertical."""
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
