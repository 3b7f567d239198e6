"""Which way is up: everything that has a say, what was taken, and how far the others are off."""

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
    vertical_from_planes,
)

_LEAN_SAMPLES = 3.0
"""How many independent moments a clip's leaning counts for: a habit lasts all of it."""
_PLANE_SHARE_NATS = 6.0
"""What a vertical costs that none of the planes' points agree with."""
_WALK_NATS, _BODY_NATS = 1.5, 12.0
"""What it costs to believe the walk rather than planes that agree with the body as well as it does, and to
believe the body's leaning alone."""
_SCENE_NATS = 4.0
"""A trunk that moves further up and down than it stands high climbs stairs; and a room's points lie above
its floor."""
_FLOOR_NATS = 2.0
_FLOOR_TOLERANCE, _MAX_SHARE_BELOW = 0.35, 0.02
"""How far the floor may be from where a trunk's height has it (a rough scale, bent knees); share of points
below it that are wrong."""
_MIN_MARGIN_NATS = 3.0
"""Twenty to one."""
_STATED_SIGMAS = 3.0
_DISTINCT_DEG = 20.0
_SEARCH_DEG = 5.0
_SAME_DEG, _MAX_FLOOR_TILT_DEG = 1.0, 5.0
_MIN_PLANE_SIGMA_DEG, _WALK_SIGMA_DEG, _BODY_SIGMA_DEG = 0.7, 2.0, 15.0
"""Walls and floors agree with the truth to 0.3 to 1.3 degrees on five captures; a walk's ground and bounce
are level to two; what a camera's mount is turned by looks like a lean."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerticalHypothesis:
    """What one source has to say about up.

    Attributes:
        source: "map" (its planes), "walk", "body" or "marker board".
        up: (3,) in the solved frame.
        sigma_deg: How far off it may be, if it is the right one of several directions.
        share: Of the planes' points that agree; 0 where it is no map's.
        nats: How strange all of the rest would be, were it right.
    """

    source: str
    up: FloatArray
    sigma_deg: float
    share: float = 0.0
    negative_log_likelihood: float = 0.0


@dataclass(frozen=True, slots=True)
class Vertical:
    """Up in the solved frame, and what it rests on.

    Attributes:
        up: (3,).
        source: What it was taken from.
        body_off_deg: Angle to the body's own idea of it; None where that was taken.
        plane_share: Of the planes' points that agree with it.
        sigma_deg: How far off it may be.
        others: The best each other source has to say, and the best that is far from what was taken.
        nats: How strange all of the rest is with it.
        margin_nats: How much stranger it is with the best far one, of those that the job states if it does;
            None where there is none.
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
        """Whether the next best direction is clearly worse, and a lasting lean would have shown."""
        if self.rests_on_lean_only():
            return False
        return self.margin_nats is None or self.margin_nats >= _MIN_MARGIN_NATS

    def rests_on_lean_only(self) -> bool:
        """Whether it rests on nothing but a leaning that may have lasted all the time."""
        return self.source == "body" and self.sigma_deg > _DISTINCT_DEG


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneContext:
    """What lies about a trunk.

    Attributes:
        points_m: (P,3) map points in the solved frame.
        path_m: (N,3) path of the trunk's camera.
        standing_m: Height of the trunk's joint over the soles of who stands.
        walks: Whether the body walks most of the time.
    """

    points_m: FloatArray
    path_m: FloatArray
    standing_m: float
    walks: bool = False


def estimate_vertical(
    body: TrunkOrientation,
    around: SceneContext,
    rng: np.random.Generator,
    stated: Sequence[VerticalHypothesis] = (),
) -> Vertical:
    """Weigh the verticals of the map's planes, of the walk and of the body's leaning against each other.

    A room's planes leave six directions or more; which of them is up is told by how the trunk would lean
    (forwards, hardly backwards or sideways), how far it would rise and fall, and whether a floor lies where
    one has to.

    Args:
        body: How the trunk leans.
        around: The map and the trunk's path.
        rng: Draws the planes' hypotheses.
        stated: What the job itself says; the best of it is taken, or the planes that agree with that,
            whatever the others say.
    """
    planes = find_planes(around.points_m, rng)
    hints = [body.modal_up(), body.mean_up(), body.upright_up()]
    says = [
        *_hypotheses_from_planes(planes, hints),
        *(
            VerticalHypothesis(
                source="walk", up=up, sigma_deg=_WALK_SIGMA_DEG, negative_log_likelihood=_WALK_NATS
            )
            for up in (vertical_from_path(around.path_m, hint) for hint in hints)
            if up is not None
        ),
        *(
            VerticalHypothesis(
                source="body",
                up=up,
                sigma_deg=_body_sigma_deg(body, up, around.walks),
                negative_log_likelihood=_BODY_NATS,
            )
            for up in hints[2:]
        ),
        *stated,
    ]
    leans = _LEAN_SAMPLES * body.negative_log_likelihood(np.array([say.up for say in says]))
    says = [
        VerticalHypothesis(
            source=say.source,
            up=say.up,
            sigma_deg=say.sigma_deg,
            share=say.share,
            negative_log_likelihood=say.negative_log_likelihood
            + lean
            + _scene_penalty(say.up, planes, around),
        )
        for say, lean in zip(says, leans.tolist(), strict=True)
    ]
    sources = {say.source for say in stated}
    return _vertical_from_hypotheses(_select(says, sources), says, sources, hints[2])


def _select(says: Sequence[VerticalHypothesis], stated: Collection[str]) -> VerticalHypothesis:
    """The least strange; of stated ones, if any, and then as exact as planes that agree have it."""
    best = min(
        (say for say in says if not stated or say.source in stated),
        key=lambda say: say.negative_log_likelihood,
    )
    agree = [
        say
        for say in says
        if stated and say.source == "map" and angle_deg(say.up, best.up) < _STATED_SIGMAS * best.sigma_deg
    ]
    return min(agree, key=lambda say: say.negative_log_likelihood, default=best)


def _vertical_from_hypotheses(
    chosen: VerticalHypothesis, says: Sequence[VerticalHypothesis], stated: Collection[str], erect: FloatArray
) -> Vertical:
    """What was taken, beside what else might have been: of what the job states, another of that."""
    best: dict[str, VerticalHypothesis] = {}
    for say in sorted(says, key=lambda say: say.negative_log_likelihood):
        if say.source != chosen.source:
            best.setdefault(say.source, say)
    far = [
        say
        for say in says
        if angle_deg(say.up, chosen.up) > _DISTINCT_DEG
        and (say.source in stated if stated else say.source != "body")
    ]
    rival = min(far, key=lambda say: say.negative_log_likelihood, default=None)
    others = list(best.values())
    if rival is not None and all(rival is not say for say in others):
        others.append(rival)
    return Vertical(
        up=chosen.up,
        source=chosen.source,
        body_off_deg=None if chosen.source == "body" else angle_deg(chosen.up, erect),
        plane_share=chosen.share,
        sigma_deg=chosen.sigma_deg,
        alternatives=tuple(others),
        negative_log_likelihood=chosen.negative_log_likelihood,
        margin_nats=None if rival is None else rival.negative_log_likelihood - chosen.negative_log_likelihood,
    )


def _hypotheses_from_planes(planes: Sequence[Plane], hints: Sequence[FloatArray]) -> list[VerticalHypothesis]:
    """All the directions that most planes near them are level or upright to."""
    normals = [plane.normal for plane in planes]
    level = [np.cross(a, b) for i, a in enumerate(normals) for b in normals[:i]]
    axes = [axis / np.linalg.norm(axis) for axis in (*normals, *level) if np.linalg.norm(axis) > 0.5]
    searches = [(hint, limit) for hint in hints for limit in (TILT_LIMIT_DEG, BENT_TILT_LIMIT_DEG)]
    searches += [(sign * axis, _SEARCH_DEG) for axis in axes for sign in (1.0, -1.0)]
    out: list[VerticalHypothesis] = []
    for hint, limit_deg in searches:
        if limit_deg == _SEARCH_DEG and any(angle_deg(hint, say.up) < _SAME_DEG for say in out):
            continue
        found = vertical_from_planes(planes, hint, limit_deg)
        if found is None or any(angle_deg(found[0], say.up) < 0.1 * _SAME_DEG for say in out):
            continue
        out.append(
            VerticalHypothesis(
                source="map",
                up=found[0],
                sigma_deg=_plane_sigma_deg(planes, found[0]),
                share=found[1],
                negative_log_likelihood=_PLANE_SHARE_NATS * (1.0 - found[1]),
            )
        )
    return out


def _plane_sigma_deg(planes: Sequence[Plane], up: FloatArray) -> float:
    """How well planes that agree within a degree and a half fix a vertical."""
    angle = np.degrees(np.arccos(np.clip([abs(float(plane.normal @ up)) for plane in planes], 0.0, 1.0)))
    off = np.minimum(angle, 90.0 - angle)
    near = off[off < 1.5]
    return float(np.hypot(_MIN_PLANE_SIGMA_DEG, np.sqrt((near**2).sum()) / max(len(near) - 1, 1)))


def _body_sigma_deg(body: TrunkOrientation, up: FloatArray, walks: bool) -> float:
    """Who walks is upright but for a camera's tilt, which looks like a lean: that, and half of how it moves.

    Who sits, stands or works may lean all the time, and nothing tells by how much.
    """
    if not walks:
        return body.posterior_spread_deg(up)
    moved = np.degrees(np.arccos(np.clip(body.axes[:, :, 2] @ up, -1.0, 1.0)))
    return float(np.hypot(_BODY_SIGMA_DEG, 0.5 * np.sqrt((moved**2).mean())))


def _scene_penalty(up: FloatArray, planes: Sequence[Plane], around: SceneContext) -> float:
    """What the room and the way through it say against a direction, nats."""
    heights = around.path_m @ up
    low, high = np.percentile(heights, [2.0, 98.0])
    nats = _SCENE_NATS if high - low > around.standing_m else 0.0
    deepest = high - (1.0 + _FLOOR_TOLERANCE) * around.standing_m
    if len(around.points_m) and float((around.points_m @ up < deepest).mean()) > _MAX_SHARE_BELOW:
        nats += _SCENE_NATS
    for plane in planes:
        along = float(plane.normal @ up)
        if abs(along) > np.cos(np.radians(_MAX_FLOOR_TILT_DEG)):
            depth = high - plane.offset_m * float(np.sign(along))
            if abs(depth - around.standing_m) < _FLOOR_TOLERANCE * around.standing_m + PLANE_HALF_THICKNESS_M:
                return nats - _FLOOR_NATS
    return nats


def angle_deg(first: FloatArray, second: FloatArray) -> float:
    """Angle between two unit directions (3,), degrees."""
    return float(np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0))))
