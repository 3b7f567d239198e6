"""Metric scale, and up, from a board of known squares that keyframes saw in the room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body_calibration.samples import MAP_ERROR_DURATION_S, MAP_ERROR_M
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.world.vertical import VerticalHypothesis
from bodycap_batch.model.geometry import Similarity, invert, so3_exp, so3_log
from bodycap_batch.model.merge_data import BoardView, MergeInputs

SOURCE_NAME = "marker board"
_MIN_VIEWS = 3
"""Two views always agree on a board's size; the third tells whether they are right."""
_MIN_SIGMA = 0.003
"""Printers and rulers: a millimetre in 30 cm."""
_MAX_SIGMA = 0.05
"""Beyond this the body's own proportions know the scale as well (a height alone: 4 %)."""
_REWEIGHTINGS = 3
"""Times the loss's width is taken from the residuals anew: the third changes it by less than a tenth."""
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])
_PLACED_SIGMA_DEG = 1.5
"""A board hung by eye; a level floor or table is off by less."""


@dataclass(frozen=True, slots=True)
class LocatedBoard:
    """The marker board in the room.

    Attributes:
        scale: What it says of the scale.
        axes: (3,3) its two edges and its normal, towards the cameras, as columns in the tracks' gauge.
    """

    scale: ScaleSource
    axes: FloatArray

    def ups(self, placed: Literal["lying", "hanging"] | None) -> tuple[VerticalHypothesis, ...]:
        """What it says of up: its normal where it lies, any of its edges where it hangs."""
        if placed is None:
            return ()
        edges = [sign * self.axes[:, axis] for axis in (0, 1) for sign in (1.0, -1.0)]
        ups = [self.axes[:, 2]] if placed == "lying" else edges
        return tuple(VerticalHypothesis(source=SOURCE_NAME, up=up, sigma_deg=_PLACED_SIGMA_DEG) for up in ups)


@dataclass(frozen=True, slots=True)
class _BoardObservations:
    """Views of one board in one map.

    Attributes:
        map_from_cam: (V,4,4).
        cam_from_board: (V,4,4) metres, each view's own.
        view: (N,) which view each corner belongs to.
        board_m: (N,3) corners about the board's middle.
        rays: (N,2) where they were seen, at depth 1.
        group: (V,) views that share their map's error.
    """

    map_from_cam: FloatArray
    cam_from_board: FloatArray
    view: IntArray
    board_m: FloatArray
    rays: FloatArray
    group: IntArray


def locate_board(
    inputs: MergeInputs, options: MergeOptions, places: Mapping[str, Similarity] | None = None
) -> LocatedBoard | None:
    """The scale and the way up from the job's marker board, None where it names none.

    The board's place, orientation and size in the map are fitted to its corners in all keyframes at once, by
    reprojection, with the keyframes' poses held; how well that is known is the jackknife's spread over
    stretches of a second of a camera, whose poses are off together; of few stretches, which hide how far they
    are off, at least what maps are known to bend over the way.

    Args:
        inputs: ``board``, and the trajectories the keyframes belong to.
        options: ``marker_board``.
        places: By gauge, the main one first, where each used map lies in it; None where all are in one map.

    Raises:
        EstimationError: It was not found, or in too few keyframes, or only from one place.

    Source: B. Efron, C. Stein, "The jackknife estimate of variance", Annals of Statistics 1981.
    """
    if options.marker_board is None:
        return None
    gauge, seen = _select_observations(inputs, places, turns=options.marker_board.kind == "chessboard")
    start = _initial_fit(seen)
    found, weight = _fit(seen, start)
    sigma = float(
        np.hypot(max(_jackknife_sigma(seen, found, weight), _map_bend_sigma(seen, found)), _MIN_SIGMA)
    )
    if not sigma < _MAX_SIGMA:
        raise EstimationError(
            f"the marker board tells the scale to {sigma:.0%} only: its {len(seen.map_from_cam)} views are "
            "from nearly the same place, or their poses contradict each other",
            hint="walk past it, so that it is seen from several sides; or leave merge.marker_board out",
        )
    unit, turn = (1.0, np.eye(3)) if places is None else (places[gauge].scale, places[gauge].rotation)
    axes = so3_exp(found[None, :3])[0]
    # Whichever way the detector's normal points, a board is seen from its front.
    axes[:, 2] *= np.sign((seen.map_from_cam[:, :3, 3] - found[3:6]).mean(axis=0) @ axes[:, 2])
    scale = ScaleSource(name=SOURCE_NAME, scale=float(np.exp(-found[6])) / unit, sigma_log=sigma)
    return LocatedBoard(scale, turn @ axes)


def _select_observations(
    inputs: MergeInputs, places: Mapping[str, Similarity] | None, *, turns: bool
) -> tuple[str, _BoardObservations]:
    """The views of the main map; of the map that has most where the main one has too few."""
    paths = {each.camera: each for each in inputs.trajectories}
    by_gauge: dict[str, list[BoardView]] = {}
    for view in inputs.board:
        path = paths[view.camera]
        if path.localised[view.frame] and (places is None or path.gauge in places):
            by_gauge.setdefault(path.gauge, []).append(view)
    gauge, views = max(by_gauge.items(), key=lambda item: len(item[1]), default=("", []))
    main = next(iter(places or {}), gauge)
    if len(by_gauge.get(main, [])) >= _MIN_VIEWS:
        gauge, views = main, by_gauge[main]  # a joined map's own scale is known less well
    if len(views) < _MIN_VIEWS:
        raise EstimationError(
            f"the marker board was found in {len(views)} keyframes of one map, {_MIN_VIEWS} are needed",
            hint="is merge.marker_board the board that was filmed (kind, columns, rows, dictionary, legacy)? "
            "It has to be sharp, whole (a chessboard) and near: its squares 10 px and more",
        )
    stretch = round(1e9 * MAP_ERROR_DURATION_S)
    shared = [f"{v.camera} {int(paths[v.camera].times_ns[v.frame]) // stretch}" for v in views]
    _, group = np.unique(shared, return_inverse=True)
    map_from_cam = np.array([paths[v.camera].gauge_from_cam[v.frame] for v in views])
    return gauge, _with_one_orientation(views, map_from_cam, group, turns=turns)


def _with_one_orientation(
    views: Sequence[BoardView], map_from_cam: FloatArray, group: IntArray, *, turns: bool
) -> _BoardObservations:
    """Views with corners about the board's middle, all the same way round.

    Half a turn maps many a chessboard onto itself (`turns`): its detector may begin at either end. A ChArUco
    board's markers have numbers: a view half a turn off is wrong.
    """
    corners = np.concatenate([view.board_m for view in views])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    placed, board = [], []
    first = map_from_cam[0] @ views[0].cam_from_board
    for view, pose in zip(views, map_from_cam, strict=True):
        own = view.cam_from_board.copy()
        own[:3, 3] += own[:3, :3] @ middle
        flip = np.eye(3)
        if turns and float(np.trace(first[:3, :3].T @ (pose @ own)[:3, :3])) < 1.0:  # more than a right angle
            flip = _HALF_TURN
        own[:3, :3] = own[:3, :3] @ flip
        placed.append(own)
        board.append((view.board_m - middle) @ flip)
    counts = [len(view.rays) for view in views]
    return _BoardObservations(
        map_from_cam=map_from_cam,
        cam_from_board=np.array(placed),
        view=np.repeat(np.arange(len(views)), counts),
        board_m=np.concatenate(board),
        rays=np.concatenate([view.rays for view in views]),
        group=group if len(np.unique(group)) >= _MIN_VIEWS else np.arange(len(views)),
    )


def _initial_fit(seen: _BoardObservations) -> FloatArray:
    """Rotation vector, place and log of the size (7,): each view alone has the board's middle in metres."""
    rotation = seen.map_from_cam[:, :3, :3]
    u, _, vt = np.linalg.svd((rotation @ seen.cam_from_board[:, :3, :3]).sum(axis=0))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    ray = np.einsum("vij,vj->vi", rotation, seen.cam_from_board[:, :3, 3])
    centre = seen.map_from_cam[:, :3, 3]
    # centre + size · ray = place, for every view; the middle is taken out of both sides.
    moved, apart = ray - ray.mean(axis=0), centre - centre.mean(axis=0)
    size = -float((moved * apart).sum()) / max(float((moved**2).sum()), 1e-12)
    if size <= 0.0:
        extent = float(np.linalg.norm(apart, axis=1).max())
        size = max(extent, 1e-9) / max(float(np.linalg.norm(ray, axis=1).mean()), 1e-9)
    place = (centre + size * ray).mean(axis=0)
    return np.concatenate([so3_log(turn[None])[0], place, [np.log(size)]])


def _residuals(seen: _BoardObservations, value: FloatArray) -> FloatArray:
    """(2N,) where the corners are seen less where they should be, at depth 1."""
    placed = np.exp(value[6]) * seen.board_m @ so3_exp(value[None, :3])[0].T + value[3:6]
    back = invert(seen.map_from_cam)[seen.view]
    x_in_cam = np.einsum("nij,nj->ni", back[:, :3, :3], placed) + back[:, :3, 3]
    depth = np.maximum(x_in_cam[:, 2:], 1e-6)
    return np.asarray((x_in_cam[:, :2] / depth - seen.rays).ravel())


def _fit(seen: _BoardObservations, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The fit (7,) under Cauchy's loss at the views' own spread, and each residual's weight (2N,)."""
    from scipy.optimize import least_squares

    value, limit = start, 1.0
    for _ in range(_REWEIGHTINGS):
        limit = 2.0 * 1.4826 * float(np.median(np.abs(_residuals(seen, value)))) + 1e-9
        value = least_squares(partial(_residuals, seen), value, loss="cauchy", f_scale=limit, x_scale="jac").x
    return np.asarray(value), 1.0 / (1.0 + (_residuals(seen, value) / limit) ** 2)


def _jackknife_sigma(seen: _BoardObservations, value: FloatArray, weight: FloatArray) -> float:
    """Sigma of the log of the size: how far it moves as each group of views is left out."""
    step = 1e-6 * np.maximum(1.0, np.abs(value))
    jacobian = np.stack(
        [
            (_residuals(seen, value + change) - _residuals(seen, value - change)) / (2.0 * change.sum())
            for change in np.diag(step)
        ],
        axis=1,
    )
    residual, group = _residuals(seen, value), np.repeat(seen.group[seen.view], 2)
    weighted = jacobian * weight[:, None]
    whole = weighted.T @ jacobian
    moved = []
    for one in np.unique(group):
        mine = group == one
        rest = whole - weighted[mine].T @ jacobian[mine]
        moved.append(np.linalg.lstsq(rest, weighted[mine].T @ residual[mine], rcond=None)[0][6])
    count = len(moved)
    # Few groups know their own spread badly: without (n + 1) / (n - 1) four of them state 0.87 of the error.
    variance = (count + 1) / count * np.sum((np.array(moved) - np.mean(moved)) ** 2)
    return float(np.sqrt(variance))


def _map_bend_sigma(seen: _BoardObservations, value: FloatArray) -> float:
    """Sigma of the log of the size where the two ends of the way are off, each by as much as maps are."""
    centre = seen.map_from_cam[:, :3, 3]
    along = np.linalg.svd(centre - centre.mean(axis=0), full_matrices=False)[2][0]
    way_m = float(np.ptp(centre @ along)) / float(np.exp(value[6]))
    return float(np.sqrt(2.0)) * MAP_ERROR_M / max(way_m, 1e-9)
