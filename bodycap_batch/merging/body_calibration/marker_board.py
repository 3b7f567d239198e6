"""Metric scale and vertical from a marker board of known size in the room, observed in keyframes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np

from bodycap_batch.config.options import MarkerBoard
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.percent import format_percent
from bodycap_batch.merging.body_calibration.samples import MAP_ERROR_DURATION_S, MAP_ERROR_M
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.world.vertical import VerticalHypothesis
from bodycap_batch.model.geometry import Similarity, invert, nearest_rotation, so3_exp, so3_log
from bodycap_batch.model.merge_data import BoardView
from bodycap_batch.model.scene import Trajectory

SOURCE_NAME = "marker board"
_MIN_VIEWS = 3
"""Minimum number of views of the board.

Two views always agree on the size of the board, even if a view is wrong. A third view reveals such an error.
"""
_MIN_SIGMA = 0.003
"""Minimum sigma of the log of the scale from a board.

Derivation: the printed size of the board has an error of about a millimetre in 30 cm.
"""
_MAX_SIGMA = 0.05
"""Maximum sigma of the log of the scale for a usable board.

For comparison: the height of the subject alone gives the scale with a sigma of 4 %.
"""
_REWEIGHTINGS = 3
"""Number of successive fits. The residuals before each fit determine the width of its loss.

The third fit changes the result by less than a tenth of its sigma.
"""
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Rotation by 180° about the normal of the board."""
_PLACED_SIGMA_DEG = 1.5
"""Sigma of the vertical from a board, degrees.

The value is for a board that a person hung straight by eye. The same value is used for lying boards, although
floors and tables are more exactly horizontal.
"""


@dataclass(frozen=True, slots=True)
class LocatedBoard:
    """The marker board in the map.

    Attributes:
        scale: The scale of the main map, estimated from the board.
        axes: (3,3) matrix with three unit vectors as columns, in the main map's gauge. The first two are
            along the edges of the board. The third is the normal of the board towards the cameras.
    """

    scale: ScaleSource
    axes: FloatArray

    def verticals(self, placed: Literal["lying", "hanging"] | None) -> tuple[VerticalHypothesis, ...]:
        """Return the possible verticals.

        Args:
            placed: How the board is placed. The vertical is the normal of a lying board, or one of the four
                edge directions of a hanging board.

        Returns:
            The possible verticals. Empty if `placed` is None.
        """
        if placed is None:
            return ()
        edges = [sign * self.axes[:, axis] for axis in (0, 1) for sign in (1.0, -1.0)]
        ups = [self.axes[:, 2]] if placed == "lying" else edges
        return tuple(VerticalHypothesis(source=SOURCE_NAME, up=up, sigma_deg=_PLACED_SIGMA_DEG) for up in ups)


@dataclass(frozen=True, slots=True)
class _BoardObservations:
    """The views of the board in one map.

    Attributes:
        map_from_cam: (V,4,4) camera pose of each view.
        cam_from_board: (V,4,4) pose of the board in metres, estimated from each view alone.
        view: (N,) index of the view of each observed corner.
        board_m: (N,3) corners in the frame of the board, relative to the middle of the board, metres.
        rays: (N,2) undistorted observations of the corners, at depth 1.
        group: (V,) group number of each view. The views of a group share one error of the map.
    """

    map_from_cam: FloatArray
    cam_from_board: FloatArray
    view: IntArray
    board_m: FloatArray
    rays: FloatArray
    group: IntArray


def locate_board(
    trajectories: Sequence[Trajectory],
    views: Sequence[BoardView],
    board: MarkerBoard | None,
    main_from_gauge: Mapping[str, Similarity],
) -> LocatedBoard | None:
    """Locate the marker board of the job in the map.

    A fit estimates the board's position, orientation and size in the map. It minimises the reprojection error
    of the board's corners in all keyframes. The keyframe poses are fixed.

    A jackknife over groups of views estimates the uncertainty of the size. A group holds the views of one
    camera in one second, because the poses of these views share one error of the map. With few groups, the
    jackknife underestimates the uncertainty. Therefore the uncertainty has a lower limit: the error of the
    size that the usual bend of a map causes.

    Args:
        trajectories: The trajectories of the keyframes.
        views: The views of the board.
        board: The board that the job describes; None if the job describes none.
        main_from_gauge: By gauge of each used map, similarity from this map to the main map. The main map is
            the first.

    Returns:
        The board in the map; None if the job describes no board.

    Raises:
        EstimationError: The board was found in too few keyframes, the keyframes are near to each other, or
            their poses contradict each other.

    Source: B. Efron, C. Stein, "The jackknife estimate of variance", Annals of Statistics 1981.
    """
    if board is None:
        return None
    gauge, seen = _select_observations(
        trajectories, views, main_from_gauge, has_half_turns=board.kind == "chessboard"
    )
    found, weight = _fit(seen, _initial_fit(seen))
    spread = max(_jackknife_sigma(seen, found, weight), _map_bend_sigma(seen, found))
    sigma = float(np.hypot(spread, _MIN_SIGMA))
    if not sigma < _MAX_SIGMA:
        raise EstimationError(
            f"the scale from the marker board has an uncertainty of {format_percent(sigma)}, which is too "
            f"large: its {len(seen.map_from_cam)} views are from nearly the same place, or the poses of "
            "these views contradict each other",
            hint="walk past the board, so that the cameras see the board from several sides; or leave out "
            "merge.marker_board",
        )
    to_main = main_from_gauge[gauge]
    axes = so3_exp(found[None, :3])[0]
    # Detectors disagree on the sign of the normal. The cameras always see the front of a board.
    axes[:, 2] *= np.sign((seen.map_from_cam[:, :3, 3] - found[3:6]).mean(axis=0) @ axes[:, 2])
    scale = ScaleSource(name=SOURCE_NAME, scale=float(np.exp(-found[6])) / to_main.scale, sigma_log=sigma)
    return LocatedBoard(scale, to_main.rotation @ axes)


def _select_observations(
    trajectories: Sequence[Trajectory],
    views: Sequence[BoardView],
    main_from_gauge: Mapping[str, Similarity],
    *,
    has_half_turns: bool,
) -> tuple[str, _BoardObservations]:
    """Select the views of the board in one map.

    The main map is selected if it has enough views, else the map with the most views.

    Returns:
        The gauge of the selected map, and the observations of the board in this map.
    """
    paths = {each.camera: each for each in trajectories}
    by_gauge: dict[str, list[BoardView]] = {}
    for view in views:
        path = paths[view.camera]
        if path.localised[view.frame] and path.gauge in main_from_gauge:
            by_gauge.setdefault(path.gauge, []).append(view)
    gauge, selected = max(by_gauge.items(), key=lambda item: len(item[1]), default=("", []))
    main = next(iter(main_from_gauge))
    if len(by_gauge.get(main, [])) >= _MIN_VIEWS:
        gauge, selected = main, by_gauge[main]  # the scale of an aligned map is less certain
    if len(selected) < _MIN_VIEWS:
        raise EstimationError(
            f"the marker board was found in only {len(selected)} keyframes of one map, but {_MIN_VIEWS} "
            "keyframes are needed",
            hint="check that merge.marker_board describes the filmed board (kind, columns, rows, dictionary, "
            "legacy), that this board is sharp in the video, and that its squares are at least 10 px wide; "
            "a chessboard must be completely visible",
        )
    duration_ns = round(1e9 * MAP_ERROR_DURATION_S)
    shared = [f"{v.camera} {int(paths[v.camera].times_ns[v.frame]) // duration_ns}" for v in selected]
    _, group = np.unique(shared, return_inverse=True)
    map_from_cam = np.array([paths[v.camera].gauge_from_cam[v.frame] for v in selected])
    return gauge, _with_one_orientation(selected, map_from_cam, group, has_half_turns=has_half_turns)


def _with_one_orientation(
    views: Sequence[BoardView], map_from_cam: FloatArray, group: IntArray, *, has_half_turns: bool
) -> _BoardObservations:
    """Return the views with corners relative to the middle of the board, in one orientation of the board.

    Many chessboards look the same after a rotation by 180°. A detector may then number the corners from
    either end. If `has_half_turns` is True, this function rotates such views into the orientation of the
    first view. For a ChArUco board it is False: the markers have numbers, so a view that is rotated by 180°
    is an error and remains unchanged.
    """
    corners = np.concatenate([view.board_m for view in views])
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    poses, board = [], []
    first = map_from_cam[0] @ views[0].cam_from_board
    for view, pose in zip(views, map_from_cam, strict=True):
        own = view.cam_from_board.copy()
        own[:3, 3] += own[:3, :3] @ middle
        flip = np.eye(3)
        # A rotation matrix with a trace below 1 rotates by more than a right angle.
        if has_half_turns and float(np.trace(first[:3, :3].T @ (pose @ own)[:3, :3])) < 1.0:
            flip = _HALF_TURN
        own[:3, :3] = own[:3, :3] @ flip
        poses.append(own)
        board.append((view.board_m - middle) @ flip)
    counts = [len(view.rays) for view in views]
    return _BoardObservations(
        map_from_cam=map_from_cam,
        cam_from_board=np.array(poses),
        view=np.repeat(np.arange(len(views)), counts),
        board_m=np.concatenate(board),
        rays=np.concatenate([view.rays for view in views]),
        group=group if len(np.unique(group)) >= _MIN_VIEWS else np.arange(len(views)),
    )


def _initial_fit(seen: _BoardObservations) -> FloatArray:
    """Return an initial fit (7,): rotation vector, position and log of the size of the board in the map.

    The size is in map units per metre. The initial fit uses the pose of the board in each view, which was
    estimated from this view alone.
    """
    rotation = seen.map_from_cam[:, :3, :3]
    turn = nearest_rotation((rotation @ seen.cam_from_board[:, :3, :3]).sum(axis=0))
    ray = np.einsum("vij,vj->vi", rotation, seen.cam_from_board[:, :3, 3])
    centre = seen.map_from_cam[:, :3, 3]
    # For every view, centre + size · ray = position. The mean is subtracted from both sides.
    ray_off, centre_off = ray - ray.mean(axis=0), centre - centre.mean(axis=0)
    size = -float((ray_off * centre_off).sum()) / max(float((ray_off**2).sum()), 1e-12)
    if size <= 0.0:
        extent = float(np.linalg.norm(centre_off, axis=1).max())
        size = max(extent, 1e-9) / max(float(np.linalg.norm(ray, axis=1).mean()), 1e-9)
    position = (centre + size * ray).mean(axis=0)
    return np.concatenate([so3_log(turn[None])[0], position, [np.log(size)]])


def _residuals(seen: _BoardObservations, fit: FloatArray) -> FloatArray:
    """Return the residuals (2N,): predicted minus observed corners, at depth 1."""
    x_in_map = np.exp(fit[6]) * seen.board_m @ so3_exp(fit[None, :3])[0].T + fit[3:6]
    cam_from_map = invert(seen.map_from_cam)[seen.view]
    x_in_cam = np.einsum("nij,nj->ni", cam_from_map[:, :3, :3], x_in_map) + cam_from_map[:, :3, 3]
    depth = np.maximum(x_in_cam[:, 2:], 1e-6)
    return np.asarray((x_in_cam[:, :2] / depth - seen.rays).ravel())


def _fit(seen: _BoardObservations, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the fit (7,) with the Cauchy loss, and the robust weight of each residual (2N,).

    The width of the loss is twice the standard deviation of the residuals. This standard deviation is
    estimated from the median of the absolute residuals.
    """
    from scipy.optimize import least_squares

    fit, width = start, 1.0
    for _ in range(_REWEIGHTINGS):
        width = 2.0 * 1.4826 * float(np.median(np.abs(_residuals(seen, fit)))) + 1e-9
        fit = least_squares(partial(_residuals, seen), fit, loss="cauchy", f_scale=width, x_scale="jac").x
    return np.asarray(fit), 1.0 / (1.0 + (_residuals(seen, fit) / width) ** 2)


def _jackknife_sigma(seen: _BoardObservations, fit: FloatArray, weight: FloatArray) -> float:
    """Return the jackknife sigma of the log of the board's size.

    The fit is repeated several times. Each time, one group of views is excluded. The variation of the results
    gives the sigma.

    Args:
        seen: The observations of the board.
        fit: (7,) the fit to all views.
        weight: (2N,) robust weight of each residual.

    Returns:
        The sigma of the log of the size.
    """
    step = 1e-6 * np.maximum(1.0, np.abs(fit))
    jacobian = np.stack(
        [
            (_residuals(seen, fit + change) - _residuals(seen, fit - change)) / (2.0 * change.sum())
            for change in np.diag(step)
        ],
        axis=1,
    )
    residual, group = _residuals(seen, fit), np.repeat(seen.group[seen.view], 2)
    weighted = jacobian * weight[:, None]
    normal = weighted.T @ jacobian
    changes = []
    for number in np.unique(group):
        rows = group == number
        rest = normal - weighted[rows].T @ jacobian[rows]
        changes.append(np.linalg.lstsq(rest, weighted[rows].T @ residual[rows], rcond=None)[0][6])
    count = len(changes)
    # A jackknife over few groups underestimates the error. With four groups, the usual jackknife gives only
    # 0.87 of the error. The factor (n + 1) / (n - 1) on the usual variance compensates for this.
    variance = (count + 1) / count * np.sum((np.array(changes) - np.mean(changes)) ** 2)
    return float(np.sqrt(variance))


def _map_bend_sigma(seen: _BoardObservations, fit: FloatArray) -> float:
    """Return the sigma of the log of the board's size that the usual error of a map causes.

    The usual error is assumed at both ends of the path of the views. The path is the straight line along
    which the camera centres of the views are spread farthest.
    """
    centre = seen.map_from_cam[:, :3, 3]
    along = np.linalg.svd(centre - centre.mean(axis=0), full_matrices=False)[2][0]
    length_m = float(np.ptp(centre @ along)) / float(np.exp(fit[6]))
    return float(np.sqrt(2.0)) * MAP_ERROR_M / max(length_m, 1e-9)
