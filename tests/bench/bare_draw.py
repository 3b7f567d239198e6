"""Draw captures in which one camera looks at plain surfaces for a part of the time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.synthetic import SynthOptions
from bodycap_batch.synthetic.lens import ray_grid
from bodycap_batch.synthetic.making import draw_subject, walked_extent_m
from bodycap_batch.synthetic.moving_body import camera_poses_at
from bodycap_batch.synthetic.room import HEIGHT_M, half_size_m

CAMERAS = ("torso", "left_palm", "right_palm")
SURFACES = ("ceiling", "floor", "north", "east", "south", "west")
MIN_SHARE, MAX_SHARE = 0.2, 0.8
"""Limits of the share of frames in which the camera looks at plain surfaces. Origin: the target."""
_MIN_PICTURE = 0.6
"""Minimum share of the picture that plain surfaces fill in such a frame. Evidence: none."""
_RAY_STEP_PX = 32
"""Step (px) between the tested viewing rays of a picture. Evidence: none."""
_BROWN = (395.0, 402.0, 322.0, 236.0, -0.21, 0.055, 0.001, -0.0008)
"""Parameters of a lens with distortion at 640×480 px (model OPENCV). Evidence: none."""
_MAX_DRAWS = 4000
"""Maximum number of draws for one capture. Evidence: none."""


@dataclass(frozen=True, slots=True)
class BareCapture:
    """One drawn capture.

    Attributes:
        name: Name of the capture.
        settings: Options of the capture, as `bodycap synth` reads them.
        camera: The camera that looks at plain surfaces.
        shares: For each camera, the share of frames in which plain surfaces fill most of the picture.
    """

    name: str
    settings: dict[str, Any]
    camera: str
    shares: dict[str, float]

    @property
    def options(self) -> SynthOptions:
        """The validated options of the capture."""
        return SynthOptions.model_validate(self.settings)


def draw_captures(number: int, seed: int, motions: Path, width_px: int = 640) -> Iterator[BareCapture]:
    """Yield captures of 4 to 6 seconds: recorded motions and built-in walks, one third with rolling shutters.

    Args:
        number: Number of captures.
        seed: Seed of all draws. A capture does not depend on the number of captures.
        motions: Folder of BVH files. Without files, all captures show built-in walks.
        width_px: Width of the pictures, px; a multiple of 8. The lens is scaled with it.
    """
    lengths = {path: _length_s(path) for path in sorted(motions.glob("*.bvh"))}
    sources = [None, *(path for path, length in lengths.items() if length > 4.0)]
    for index in range(number):
        rng = np.random.default_rng([seed, index])
        source = sources[int(rng.integers(len(sources)))]
        for _ in range(_MAX_DRAWS):
            settings = _draw(rng, source, 0.0 if source is None else lengths[source])
            shares = bare_shares(SynthOptions.model_validate(settings))
            most = max(shares, key=lambda name: shares[name])
            rest = [share for name, share in shares.items() if name != most]
            if MIN_SHARE <= shares[most] <= MAX_SHARE and max(rest) < MIN_SHARE:
                yield BareCapture(f"bare_{seed}_{index:02}", _with_width(settings, width_px), most, shares)
                break
        else:
            raise SystemExit(f"no capture of {source} shows enough of the plain surfaces")


def _with_width(settings: dict[str, Any], width_px: int) -> dict[str, Any]:
    """Return the options with another size of the pictures, 4:3."""
    ratio = width_px / 640
    out = {**settings, "width": width_px, "height": 3 * width_px // 4}
    if "lens_params" in settings:
        params = settings["lens_params"]
        out["lens_params"] = (*(ratio * value for value in params[:4]), *params[4:])
    return out


def bare_shares(options: SynthOptions) -> dict[str, float]:
    """Return, for each camera, the share of frames in which plain surfaces fill most of the picture.

    Furniture and flat pictures are not taken into account.
    """
    subject = draw_subject(options)
    times_s = np.arange(0.0, options.seconds, 0.1)
    rays = ray_grid(options.camera()).in_cam[::_RAY_STEP_PX, ::_RAY_STEP_PX].reshape(-1, 3)
    half = np.array([*half_size_m(walked_extent_m(options, subject)), HEIGHT_M / 2])
    out = {}
    for mount in subject.mounts:
        poses = camera_poses_at(subject.motion, mount, times_s)
        seen = _seen_surfaces(poses, rays, half)
        bare = np.isin(seen, [SURFACES.index(name) for name in options.bare])
        out[mount.camera] = float((bare.mean(axis=1) >= _MIN_PICTURE).mean())
    return out


def _seen_surfaces(poses: FloatArray, rays: FloatArray, half: FloatArray) -> FloatArray:
    """Return the index in `SURFACES` (T,N) of the surface that each ray (N,3) of a camera (T,4,4) meets."""
    origins = poses[:, None, :3, 3] - [0.0, 0.0, half[2]]
    directions = rays @ np.swapaxes(poses[:, :3, :3], 1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (np.sign(directions) * half - origins) / directions
    axis = np.argmin(np.where(np.isfinite(distance), distance, np.inf), axis=2)
    positive = np.take_along_axis(directions, axis[..., None], axis=2)[..., 0] > 0.0
    names = np.array([["west", "east"], ["south", "north"], ["floor", "ceiling"]])
    index = np.vectorize(SURFACES.index)(names)
    return np.asarray(index[axis, positive.astype(int)])


def _draw(rng: np.random.Generator, motion: Path | None, length_s: float) -> dict[str, Any]:
    """Draw the options of one capture."""
    seconds = round(float(rng.uniform(4.0, 6.0)), 1)
    chosen = rng.choice(len(SURFACES), size=int(rng.integers(1, 4)), replace=False)
    settings: dict[str, Any] = {
        "cameras": CAMERAS,
        "seed": int(rng.integers(1 << 20)),
        "bare": tuple(SURFACES[number] for number in sorted(chosen.tolist())),
        "flat_pictures": int(rng.integers(0, 5)),
        "mount_sigma_deg": 25.0,
    }
    if rng.uniform() < 0.5:
        settings |= {"lens": "OPENCV", "lens_params": _BROWN}
    if rng.uniform() < 1.0 / 3.0:
        settings["rolling_shutter_s"] = round(float(rng.uniform(0.006, 0.016)), 4)
    if motion is not None:
        seconds = min(seconds, float(np.floor(10.0 * (length_s - 0.1)) / 10.0))
        settings |= {"motion": motion, "motion_start_s": round(float(rng.uniform(0, length_s - seconds)), 2)}
    return {**settings, "seconds": seconds}


def command_line(settings: dict[str, Any]) -> Sequence[str]:
    """Return the arguments of `bodycap synth` for the options of a capture."""
    out = []
    for key, value in settings.items():
        text = f"[{','.join(map(str, value))}]" if isinstance(value, tuple) else str(value)
        out += ["--set", f"{key}={text}"]
    return out


def _length_s(path: Path) -> float:
    motion = read_bvh(path)[1]
    return 0.0 if motion is None else (len(motion.root_in_world_m) - 2) / motion.fps
