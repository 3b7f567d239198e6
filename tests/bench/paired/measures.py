"""Measures of one result: against its truth, of its lens, and of its verdict.

The measures are those of this working tree for both sides, so both are measured alike.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from bodycap_batch import Result
from bodycap_batch.config.calibration import read_calibration
from bodycap_batch.core.arrays import FloatArray, IntArray
from bodycap_batch.core.errors import BodycapError
from bodycap_batch.evaluate import relative_camera_error
from bodycap_batch.evaluate.trajectories import interpolate_truth
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import Similarity, align_points, nearest_rotation, rotation_angle_rad
from tests.bench.bare import robust_alignment
from tests.bench.paired.captures import BenchCapture
from tests.bench.poses import shown_truth

RIGHT_M, LEAST_M, RIGHT_DEG = 0.10, 0.01, 5.0
SMALL_SHARE, LARGE_SHARE = 0.2, 0.02
"""A frame is right against the truth if its centre is within 10 cm and its rotation within 5 degrees: the
limits of the other benchmarks and of the measure without a truth. The limit of the centre is at most 20 % of
the diagonal of the true path's box, for a head that hardly moves is always within 10 cm; and at least 1 cm,
the noise of a truth from glasses, and 2 % of the diagonal, the drift of a truth from wheels."""
MAX_WRONG, MIN_RIGHT = 0.02, 0.9
"""A result is wrong if more than 2 % of its posed frames are wrong. It is right if at least 90 % of all
frames are right and it is not wrong."""
_PARTS = 4
"""Number of parts of each path that the alignment by the majority starts from."""
_STARTS = 64
"""Number of frames whose rotations the alignment of the rotations starts from."""
_ROUNDS = 6
_LEAST = 3
_LENS_AT = (0.2, 0.4)
"""Distances from the centre of the picture, in its widths, at which a lens is compared."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Paths:
    """The posed frames of a result that have a truth.

    Attributes:
        camera: (N,) name of the camera of each frame.
        times_ns: (N,) times.
        mine: (N,4,4) delivered poses.
        true: (N,4,4) true poses.
        is_measured: True if the truth is of a tracked body, in which the camera has an unknown constant
            rotation.
    """

    camera: npt.NDArray[np.str_]
    times_ns: IntArray
    mine: FloatArray
    true: FloatArray
    is_measured: bool = False

    def chosen(self, keep: IntArray) -> Paths:
        """Return the frames with these indices."""
        return replace(
            self,
            camera=self.camera[keep],
            times_ns=self.times_ns[keep],
            mine=self.mine[keep],
            true=self.true[keep],
        )

    def save(self, file: Path) -> None:
        """Write the frames to a file."""
        np.savez(file, **{name: getattr(self, name) for name in Paths.__slots__})

    @staticmethod
    def load(file: Path) -> Paths:
        """Read the frames from a file."""
        with np.load(file) as saved:
            arrays = {name: saved[name] for name in ("camera", "times_ns", "mine", "true")}
            return Paths(**arrays, is_measured=bool(saved["is_measured"]))


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthFigures:
    """Errors of the posed frames against the truth. Lengths are in metres of the truth.

    Attributes:
        right: Number of right frames.
        wrong: Number of wrong frames.
        ate_m: Root mean square error of the centres after one similarity for all of them.
        worst_m: Largest error after the similarity that fits most frames.
        off: Number of frames that are more than 10 cm off after the same similarity.
        median_deg: Median error of the rotations.
        worst_deg: Largest error of the rotations.
    """

    right: int
    wrong: int
    ate_m: float
    worst_m: float
    off: int
    median_deg: float
    worst_deg: float


def read_paths(results: Path, truth: Path) -> Paths | None:
    """Return the posed frames of a result with their true poses; None without any.

    Cameras whose poses are in a map of their own have no frames here.
    """
    truth, parts = shown_truth(truth), []
    for name, path in sorted(Result(results).placed_trajectories().items()):
        known = truth / f"{name}.tum" if truth.is_dir() else truth
        if not known.exists():
            continue
        mine = path.poses
        true, found = interpolate_truth(read_tum(known), mine.times_ns)
        parts.append(
            (np.full(found.sum(), name), mine.times_ns[found], mine.world_from_cam[found], true[found])
        )
    if sum(len(part[0]) for part in parts) < _LEAST:
        return None
    camera, times, mine_all, true_all = (np.concatenate([part[side] for part in parts]) for side in range(4))
    return Paths(camera=camera, times_ns=times, mine=mine_all, true=true_all, is_measured=truth.is_file())


def truth_figures(paths: Paths) -> TruthFigures | None:
    """Return the errors of the posed frames; None if no similarity can be computed."""
    try:
        aligned = _majority_alignment(paths)
        ate_m = ate(paths)
    except ValueError:  # the centres coincide
        return None
    true = paths.true[:, :3, 3]
    error_m = np.linalg.norm(aligned.apply(paths.mine[:, :3, 3]) - true, axis=1)
    error_deg = rotation_errors_deg(
        paths.mine[:, :3, :3], paths.true[:, :3, :3], is_measured=paths.is_measured
    )
    size_m = float(np.linalg.norm(np.ptp(true, axis=0)))
    limit_m = max(LEAST_M, min(RIGHT_M, SMALL_SHARE * size_m), LARGE_SHARE * size_m)
    right = int(((error_m <= limit_m) & (error_deg <= RIGHT_DEG)).sum())
    return TruthFigures(
        right=right,
        wrong=len(error_m) - right,
        ate_m=ate_m,
        worst_m=float(error_m.max()),
        off=int((error_m > RIGHT_M).sum()),
        median_deg=float(np.median(error_deg)),
        worst_deg=float(error_deg.max()),
    )


def ate(paths: Paths) -> float:
    """Return the root mean square error (m) of the centres after one similarity for all of them."""
    mine, true = paths.mine[:, :3, 3], paths.true[:, :3, 3]
    return float(np.sqrt(((align_points(mine, true).apply(mine) - true) ** 2).sum(axis=1).mean()))


def ates_of_common(a: Paths, b: Paths) -> tuple[float, float] | None:
    """Return the errors (m) of two results on the frames that both have; None if these are too few."""
    # Times of perturbed videos are rounded, so they are compared to a tenth of a millisecond.
    keys = [
        list(zip(each.camera.tolist(), np.rint(each.times_ns * 1e-5).tolist(), strict=True))
        for each in (a, b)
    ]
    common = set(keys[0]) & set(keys[1])
    if len(common) < _LEAST:
        return None
    kept = [np.flatnonzero([key in common for key in own]) for own in keys]
    try:
        return ate(a.chosen(kept[0])), ate(b.chosen(kept[1]))
    except ValueError:
        return None


def rotation_errors_deg(mine: FloatArray, true: FloatArray, *, is_measured: bool) -> FloatArray:
    """Return the errors (N,) of rotations (N,3,3) under the rotation of the world that fits most of them.

    The rotations themselves give it: a similarity of a short path's centres is turned by more than their
    errors.

    Args:
        mine: The delivered rotations.
        true: The true rotations.
        is_measured: True to estimate a constant rotation in the camera's axes, too.
    """
    change = true @ mine.transpose(0, 2, 1)
    starts = change[np.unique(np.linspace(0, len(change) - 1, _STARTS).astype(int))]
    spread = [np.median(rotation_angle_rad(change @ start.T)) for start in starts]
    world, own = starts[int(np.argmin(spread))], np.eye(3)
    error = rotation_angle_rad(world @ mine @ own @ true.transpose(0, 2, 1))
    for _ in range(_ROUNDS):
        keep = error <= max(3.0 * float(np.median(error)), np.deg2rad(0.1))
        world = nearest_rotation((true[keep] @ (mine[keep] @ own).transpose(0, 2, 1)).sum(axis=0))
        if is_measured:
            own = nearest_rotation(((world @ mine[keep]).transpose(0, 2, 1) @ true[keep]).sum(axis=0))
        error = rotation_angle_rad(world @ mine @ own @ true.transpose(0, 2, 1))
    return np.asarray(np.rad2deg(error))


def palm_error_m(results: Path, truth: Path, reference: str) -> float | None:
    """Return the mean error of the positions of the cameras from the reference; None if it is unknown."""
    estimates = {name: path.poses for name, path in Result(results).placed_trajectories().items()}
    if reference not in estimates or not truth.is_dir():
        return None
    errors = []
    for name in sorted(set(estimates) - {reference}):
        try:
            truths = {each: read_tum(truth / f"{each}.tum") for each in (name, reference)}
            found = relative_camera_error(estimates, truths, name, reference)
            errors.append(found.vector_m.mean)
        except BodycapError:
            continue
    return float(np.mean(errors)) if errors else None


def lens_figures(results: Path, capture: BenchCapture) -> dict[str, float]:
    """Return the largest error of a lens, degrees, at each distance; and the largest spread of models.

    The angle of a pixel is that between its ray and the ray of the centre of the picture. ``spread`` is the
    largest difference between the models of one camera.
    """
    angles: dict[str, list[FloatArray]] = {}
    for folder in sorted((results / "colmap").glob("*/")):
        scene = pycolmap.Reconstruction(str(folder))
        lenses = {image.name.rpartition("/")[0]: image.camera for image in scene.images.values()}
        for name, lens in lenses.items():
            size = {"width_px": lens.width, "height_px": lens.height}
            angles.setdefault(name, []).append(
                lens_angles_deg(Camera(model=lens.model.name, params=lens.params, **size))
            )
    out: dict[str, float] = {}
    spreads = [float(np.ptp(np.array(each), axis=0).max()) for each in angles.values() if len(each) > 1]
    if spreads:
        out["spread"] = max(spreads)
    if capture.lens is not None and capture.lens.exists():
        errors = []
        for name, found in angles.items():
            true = read_calibration(capture.lens, name).calibration.camera()
            errors.append(np.abs(np.array(found) - lens_angles_deg(true)).max(axis=0))
        if errors:
            out |= {f"{at:g}": float(v) for at, v in zip(_LENS_AT, np.max(errors, axis=0), strict=True)}
    return {name: value for name, value in out.items() if np.isfinite(value)}


def lens_angles_deg(lens: Camera) -> FloatArray:
    """Return the mean angle, degrees, of the pixels on both sides of the centre, at each distance."""
    centre = np.array([lens.width_px / 2, lens.height_px / 2])
    steps = np.array([[side * at * lens.width_px, 0.0] for at in _LENS_AT for side in (-1, 1)])
    rays = np.pad(lens.unproject(np.vstack([centre, centre + steps])), ((0, 0), (0, 1)), constant_values=1.0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(np.rad2deg(np.arccos(np.clip(rays[1:] @ rays[0], -1, 1))).reshape(-1, 2).mean(axis=1))


def frame_counts(results: Path) -> tuple[int, int]:
    """Return the number of frames of all cameras, and of those with a pose in the main map."""
    found = Result(results)
    posed = sum(int(path.localised.sum()) for path in found.placed_trajectories().values())
    return sum(len(frames.status) for frames in found.frames().values()), posed


def rotations_alone(results: Path, truth: Path | None) -> tuple[int, float | None]:
    """Return the number of frames with a rotation and no position, and their median error in degrees."""
    count, errors = 0, list[FloatArray]()
    for name, path in sorted(Result(results).trajectories().items()):
        turned = path.frames.rotation_only
        count += int(turned.sum())
        if truth is None or not turned.any():
            continue
        known = shown_truth(truth) / f"{name}.tum" if truth.is_dir() else truth
        if not known.exists():
            continue
        true, found = interpolate_truth(read_tum(known), path.frames.times_ns[turned])
        mine = path.rotations[turned][found]
        if len(mine) >= _LEAST:
            errors.append(rotation_errors_deg(mine, true[found, :3, :3], is_measured=False))
    return count, float(np.median(np.concatenate(errors))) if errors else None


def digest_of_results(results: Path) -> str:
    """Return a digest of poses, map, lenses and motion. Comments, which name versions, do not count."""
    digest = hashlib.sha256()
    names = ("trajectories/**/*.tum", "map.ply", "colmap/*/cameras.bin", "*.bvh")
    for file in sorted(path for name in names for path in results.glob(name)):
        lines = file.read_bytes().split(b"\n") if file.suffix == ".tum" else [file.read_bytes()]
        content = b"\n".join(line for line in lines if not line.startswith(b"#"))
        digest.update(f"{file.relative_to(results)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def wrong_verdict(grade: str, frames: int, right: int, wrong: int) -> str:
    """Return how a verdict contradicts the frames: "trusted" or "distrusted"; empty if it does not.

    Args:
        grade: Word of the grade of the cameras.
        frames: Number of all frames.
        right: Number of right frames.
        wrong: Number of wrong frames.
    """
    is_wrong = wrong > MAX_WRONG * max(right + wrong, 1)
    if grade in ("good", "usable with care") and is_wrong:
        return "trusted"
    is_right = right >= MIN_RIGHT * frames and not is_wrong
    return "distrusted" if grade in ("poor", "no result") and is_right else ""


def _majority_alignment(paths: Paths) -> Similarity:
    """Return the similarity that fits most of the frames, from parts of each camera's path."""
    parts = {}
    for camera in np.unique(paths.camera).tolist():
        for number, rows in enumerate(np.array_split(np.flatnonzero(paths.camera == camera), _PARTS)):
            if len(rows):
                parts[f"{camera}/{number}"] = (rows, paths.mine[rows, :3, 3], paths.true[rows, :3, 3])
    return robust_alignment(parts)
