"""Maps that share no view: the body whose cameras made them puts them into one.

A joint's centre is the same point of both segments that meet there, whichever map each segment's camera is
in; so the body's own calibration, with a similarity per further map among its unknowns, places the maps. It
starts from the walk, which all cameras share once their swinging is averaged out, and from the body at ease.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.body import MergeInputs
from bodycap_batch.errors import EstimationError
from bodycap_batch.geometry import Similarity, so3_exp
from bodycap_batch.merging.bones import Bone, graph_bones
from bodycap_batch.merging.calibrate import Calibration
from bodycap_batch.merging.common_walk import require_common_time, starts_of
from bodycap_batch.merging.constants import early_up, points_around
from bodycap_batch.merging.mount_spread import PRIOR, SolvedMounts
from bodycap_batch.merging.samples import take_samples
from bodycap_batch.merging.tracks import Track, clean, in_gauge, make_track, moved
from bodycap_batch.scene import Trajectory

MAX_SIGMA_M = 0.06
"""A map whose cameras are known less well than this, per axis, is not placed."""
_SAMPLES = 240
_LOOSENED = (16.0, 4.0, 1.0)
"""Slack of the joints in turn: a start that is a decimetre off must pull, not be taken for gross errors."""
_STEPS = 8
_CLOSE = 1e-3
"""Share of the cost by which a step changes it that is the last."""
_REACH_SIGMA = 0.05
"""Of the log of the scale that the limbs' reach gives: walking elbows keep 15 to 30 degrees of flexion. With
maps of their own, mounts and scale can make up for each other."""
_APART_SIGMA = 0.15
"""The same where no map holds the trunk and a limb's end: mounts are off by a tenth of half an arm. On 12
walks with cameras on upper arms and palms it was 0 to 27 % too small, 12 % in the mean square."""
_UNTOLD_SIGMA = 0.4
"""The same where nothing tells it but that, or two cameras that sit close together: palms alone gave 0.69
and 0.72 of the true scale, and lay 20 to 30 cm too low at 5 cm stated."""
_MAX_STRAIN = 2.0
"""Sigmas between that scale and the solved one above which the body does not tell where the maps lie."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Joined:
    """A further map's place.

    Attributes:
        gauge: The map.
        cameras: Its cameras.
        main_from_gauge: Where it lies in the main map.
        sigma_rad: How well its rotation is known there, per axis.
        sigma_m: How well its cameras' positions are, per axis.
        reason: Why it is not used; None where it is.
    """

    gauge: str
    cameras: tuple[str, ...]
    main_from_gauge: Similarity
    sigma_rad: float
    sigma_m: float
    reason: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Together:
    """The cameras that can be used together.

    Attributes:
        trajectories: In the main map's gauge, the trunk's first.
        places: By gauge, where each used map lies in the main one.
        sigmas: By camera of a further map, how well its place is known: rotation (rad), position (m).
        unused: By camera, why it is left out.
    """

    trajectories: tuple[Trajectory, ...]
    places: Mapping[str, Similarity]
    sigmas: Mapping[str, tuple[float, float]]
    unused: Mapping[str, str]

    def report(self) -> dict[str, Any]:
        """Plain JSON values: how well each joined camera is placed."""
        return {
            camera: {"sigma_deg": round(float(np.degrees(turn)), 3), "sigma_m": round(shift, 5)}
            for camera, (turn, shift) in self.sigmas.items()
        }


def use_together(
    inputs: MergeInputs,
    main: Sequence[Trajectory],
    further: Sequence[Trajectory],
    step: Callable[[], None],
) -> Together:
    """Bring the cameras of further maps into the main one, as far as the body tells where they are.

    Args:
        inputs: Skeleton, mounts and clocks.
        main: The main map's cameras, the trunk's first.
        further: Cameras of other maps.
        step: Called after each iteration; may raise to stop.
    """
    here = Similarity(1.0, np.eye(3), np.zeros(3))
    if not further:
        return Together(trajectories=tuple(main), places={main[0].gauge: here}, sigmas={}, unused={})
    bones = graph_bones(inputs.skeleton, {inputs.mount_of(each.camera).role for each in (*main, *further)})
    index = {bone.role: place for place, bone in enumerate(bones)}
    tracks: dict[str, list[Track]] = {}
    for each in (*main, *further):
        track = make_track(inputs, each, index[inputs.mount_of(each.camera).role])
        tracks.setdefault(each.gauge, []).append(track)
    joined, unused = _joined(inputs, bones, tracks, step)
    good = {item.gauge: item for item in joined if item.reason is None}
    moved_here = [
        in_gauge(each, good[each.gauge].main_from_gauge, main[0].gauge)
        for each in further
        if each.gauge in good
    ]
    return Together(
        trajectories=(*main, *moved_here),
        places={main[0].gauge: here} | {gauge: item.main_from_gauge for gauge, item in good.items()},
        sigmas={camera: (item.sigma_rad, item.sigma_m) for item in good.values() for camera in item.cameras},
        unused=unused
        | {
            camera: _cannot(item.gauge, (main[0].camera, main[0].gauge), item.reason)
            for item in joined
            if item.reason is not None
            for camera in item.cameras
        },
    )


def _joined(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    tracks: dict[str, list[Track]],
    step: Callable[[], None],
) -> tuple[tuple[Joined, ...], dict[str, str]]:
    """The further maps' places, and by camera why others were not even tried."""
    (main, (trunk, *_)), *others = tracks.items()
    unused: dict[str, str] = {}

    def leave(gauge: str, why: str) -> None:
        for track in tracks.pop(gauge):
            unused[track.camera] = _cannot(gauge, (trunk.camera, main), why)

    for gauge, group in others:
        try:
            require_common_time(trunk, group)
        except EstimationError as error:
            leave(gauge, error.message)
    if len(tracks) == 1:
        return (), unused
    try:
        return join_maps(inputs, bones, tracks, step), unused
    except EstimationError as error:
        if len(tracks) == 2:
            leave(next(name for name in tracks if name != main), error.message)
            return (), unused
    # One map that fits no body spoils all of the others' places: each on its own.
    found: tuple[Joined, ...] = ()
    for gauge in [name for name in tracks if name != main]:
        try:
            found += join_maps(inputs, bones, {main: tracks[main], gauge: tracks[gauge]}, step)
        except EstimationError as error:
            leave(gauge, error.message)
    return found, unused


def _cannot(gauge: str, trunk: tuple[str, str], why: str) -> str:
    """Why a camera is left out whose map is not the trunk's (camera, gauge)."""
    return f"its map {gauge} shares no view with {trunk[0]}'s {trunk[1]}, and the body cannot place it: {why}"


def join_maps(
    inputs: MergeInputs,
    bones: Sequence[Bone],
    tracks: Mapping[str, Sequence[Track]],
    step: Callable[[], None],
) -> tuple[Joined, ...]:
    """Place further maps in the main one.

    Args:
        inputs: Skeleton and mounts.
        bones: The graph's bones, those of all cameras.
        tracks: By gauge, its cameras' tracks; the main map's first, the trunk's camera first in it.
        step: Called after each iteration; may raise to stop.

    Raises:
        EstimationError: The cameras' distances or their movement fit no person, or they were hardly localised
            together.
    """
    mounts = {mount.camera: mount for mount in inputs.mounts}
    (_, main), *others = tracks.items()
    start = starts_of(bones, main, others, mounts)
    starts, provisional = start.places, start.metric
    together = [*main, *(moved(track, starts[gauge]) for gauge, group in others for track in group)]
    together = [clean(each, provisional, inputs.clocks[each.camera].nominal_fps)[0] for each in together]
    trunk = together[0].scaled(provisional)
    points_m = provisional * points_around(inputs, trunk.camera)
    known_up = early_up(inputs.skeleton, bones, (trunk, mounts[trunk.camera]), points_m)
    samples = take_samples(together, provisional, _SAMPLES, known_up)
    calibration = Calibration(inputs.skeleton, bones, samples, mounts, provisional, step)
    names = {gauge: tuple(track.camera for track in group) for gauge, group in others}
    known = _REACH_SIGMA if start.spanned else _APART_SIGMA
    reach_sigma = known if start.told else _UNTOLD_SIGMA
    problem = Placing(calibration, list(names.values()), provisional, reach_sigma=reach_sigma)
    problem.solve()
    strain = abs(problem.from_reach())
    if strain > _MAX_STRAIN:
        raise EstimationError(
            f"the limbs' reach and the way the cameras move disagree on the scale by "
            f"{100 * strain * reach_sigma:.0f} %",
            hint="a longer walk with turns tells more",
        )
    out = []
    for index, (gauge, cameras) in enumerate(names.items()):
        sigma_rad, sigma_m = problem.sigmas(index)
        why = None
        if not sigma_m <= MAX_SIGMA_M:
            why = (
                f"the body tells it only to {100 * sigma_m:.0f} cm; bending forward and aside, turns in the "
                "walk, an upper arm's camera or a common view settle it"
            )
        out.append(
            Joined(
                gauge=gauge,
                cameras=cameras,
                main_from_gauge=problem.moved[index].after(starts[gauge]),
                sigma_rad=sigma_rad,
                sigma_m=sigma_m,
                reason=why,
            )
        )
    return tuple(out)


class Placing:
    """A calibration whose further maps may move: their similarities by Gauss-Newton, all else eliminated.

    Args:
        calibration: At a provisional place of all maps.
        groups: The cameras of each further map.
        scale: Metres per unit of the main map, provisional.
        reach_sigma: Of its logarithm.
    """

    def __init__(
        self,
        calibration: Calibration,
        groups: Sequence[tuple[str, ...]],
        scale: float,
        *,
        reach_sigma: float = _REACH_SIGMA,
    ) -> None:
        self._calibration, self._scale, self._reached = calibration, scale, scale
        self._reach_sigma = reach_sigma
        cameras = calibration.samples.cameras
        self._members = [[cameras.index(name) for name in group] for group in groups]
        self.moved = [Similarity(1.0, np.eye(3), np.zeros(3)) for _ in groups]
        self._covariance = np.zeros((0, 0))

    def solve(self) -> None:
        """Move the maps until the body's cost no longer falls, its joints stiffer step by step."""
        for slack in _LOOSENED:
            self._calibration.slack_factor = slack
            self._descend()
        mounts, shifts = self._linearised()
        self._calibration.reweigh(mounts, mounts.eliminated(shifts))
        self._descend()
        self._covariance = self._step(0.0)[1]

    def _descend(self) -> None:
        cost = self._cost()
        damping = 1e-4
        for _ in range(_STEPS):
            change, _ = self._step(damping)
            before = self._calibration.samples, self._scale, list(self.moved)
            self._apply(change)
            trial = self._cost()
            close = abs(trial - cost) < _CLOSE * max(cost, 1.0)
            if trial > cost:
                self._calibration.move(before[0])
                _, self._scale, self.moved = before
                self._calibration.solve(self._scale)
                damping = max(100.0 * damping, 1e-2)
            else:
                cost, damping = trial, 0.1 * damping
            if close:
                break

    def sigmas(self, index: int) -> tuple[float, float]:
        """Sigma per axis of a map's rotation (rad) and its cameras' positions (m), over the samples."""
        centres, middle = self._centres(index)
        mine = slice(1 + 7 * index, 8 + 7 * index)
        values, vectors = np.linalg.eigh(self._covariance[mine, mine])
        half = vectors * np.sqrt(np.maximum(values, 0.0))
        off = (centres - middle)[:, :, None]
        arms = np.cross(half[None, :3].swapaxes(1, 2), off.swapaxes(1, 2)).swapaxes(1, 2)
        shifts = arms + off * half[None, 3:4] + half[None, 4:]
        position = (shifts**2).sum(axis=(1, 2)).mean()
        return float(np.sqrt((half[:3] ** 2).sum() / 3.0)), float(np.sqrt(position / 3.0))

    def _centres(self, index: int) -> tuple[FloatArray, FloatArray]:
        samples, members = self._calibration.samples, self._members[index]
        centres = self._scale * samples.map_from_cam[members][samples.valid[members], :3, 3]
        return centres, centres.mean(axis=0)

    def _step(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Change (1 + 7 G) of log scale and maps that lowers the cost, and its covariance."""
        mounts, shifts = self._linearised()
        solved = mounts.eliminated(shifts)
        count = shifts.shape[1]
        reach = np.zeros(solved.influence.shape[1])
        reach[-count] = 1.0 / self._reach_sigma
        influence = np.vstack([solved.influence, reach])
        right = np.append(mounts.linear.right, -self.from_reach())
        normal = influence.T @ influence
        variance = self._calibration.row_variance(mounts, solved)[np.append(mounts.kinds, PRIOR)]
        gain = _solved(normal, influence.T)
        # A posture that is the wearer's habit, not the prior's, bends mounts and maps alike.
        habit = (mounts.habit_shifts().T @ gain[:, :-1].T).T
        covariance = (gain * variance) @ gain.T + habit @ habit.T
        free = np.arange(len(normal) - count, len(normal))
        normal[free, free] *= 1.0 + damping
        change = _solved(normal, influence.T @ right)[-count:]
        return np.asarray(change, dtype=np.float64), np.asarray(covariance[-count:, -count:])

    def _linearised(self) -> tuple[SolvedMounts, FloatArray]:
        """The graph's derivatives by bones and mounts, and (R,1 + 7 G) those by log scale and maps."""
        mounts = self._calibration.solved()
        shifts = -self._calibration.measurement_shifts(mounts.linear, self._directions())
        shifts[:, 0] -= self._calibration.unit_shifts(mounts)
        return mounts, shifts

    def _cost(self) -> float:
        return self._calibration.solve(self._scale) + 0.5 * self.from_reach() ** 2

    def from_reach(self) -> float:
        """How far the scale has left the one that the limbs' reach gave, in sigmas."""
        return float(np.log(self._scale / self._reached)) / self._reach_sigma

    def _directions(self) -> FloatArray:
        """(C,K,P,6) movement of each camera's pose in metres, turn and shift in the main map's axes."""
        samples = self._calibration.samples
        centres = self._scale * samples.map_from_cam[..., :3, 3]
        out = np.zeros((*centres.shape[:2], 1 + 7 * len(self._members), 6))
        seen = samples.valid
        out[:, :, 0, 3:] = centres - centres[seen].mean(axis=0)
        for index, members in enumerate(self._members):
            first = 1 + 7 * index
            off = centres[members] - self._centres(index)[1]
            for axis, unit in enumerate(np.eye(3)):
                out[members, :, first + axis, :3] = unit
                out[members, :, first + axis, 3:] = np.cross(unit, off)
                out[members, :, first + 4 + axis, 3 + axis] = 1.0
            out[members, :, first + 3, 3:] = off
        return out

    def _apply(self, change: FloatArray) -> None:
        """Move the samples and remember where the maps went."""
        samples = self._calibration.samples
        poses = samples.map_from_cam.copy()
        for index, members in enumerate(self._members):
            turn, stretch, shift = np.split(change[1 + 7 * index : 8 + 7 * index], [3, 4])
            middle = self._centres(index)[1] / self._scale
            rotation, factor = so3_exp(turn), float(np.exp(stretch[0]))
            update = Similarity(factor, rotation, middle + shift / self._scale - factor * rotation @ middle)
            poses[members] = update.apply_to_poses(poses[members])
            self.moved[index] = update.after(self.moved[index])
        self._calibration.move(replace(samples, map_from_cam=poses))
        self._scale *= float(np.exp(change[0]))


def _solved(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve the normal equations of the maps' places.

    Raises:
        EstimationError: They are singular.
    """
    try:
        return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise EstimationError(
            "the body's movement does not determine where the map lies",
            hint="bending, turns in the walk, an upper arm's camera or a common view settle it",
        ) from error
