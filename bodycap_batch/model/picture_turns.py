"""How a camera turned its pictures relative to its lens: stabilisation by rotation.

The centre of the camera stays where it is. So the pictures of a stabilised video are mapped and
registered as they are. Only what is fixed to the camera, such as its mount and its inertial sensor, needs the
axes of the lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, set_array
from bodycap_batch.model.geometry import make_transform, rotation_angle_rad
from bodycap_batch.model.scene import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureTurns:
    """The turns of the N pictures of a stabilised camera.

    Attributes:
        mode: Mode of the stabilisation; "" if it is unknown.
        cam_from_picture: (N,3,3) rotation from the axes of each picture to those of the lens. The identity if
            it is not recorded.
        sigma_rad: (N,) standard deviation of this rotation per axis, radians; 0 if it is recorded.
    """

    mode: str
    cam_from_picture: FloatArray
    sigma_rad: FloatArray

    def __post_init__(self) -> None:
        set_array(self, "cam_from_picture", (None, 3, 3))
        set_array(self, "sigma_rad", (len(self.cam_from_picture),))

    @property
    def recorded(self) -> BoolArray:
        """Mask (N,) of the pictures whose turn is recorded."""
        return np.asarray(self.sigma_rad == 0.0)

    def exact(self) -> PictureTurns:
        """Return the turns without their uncertainty."""
        return replace(self, sigma_rad=np.zeros(len(self.sigma_rad)))

    def camera_path(self, pictures: Trajectory) -> Trajectory:
        """Return the path of the camera, with the axes of its lens.

        Args:
            pictures: The path with the axes of the pictures.

        Returns:
            The path. Where the turn is not recorded, the covariance contains its uncertainty.
        """
        return self._turned(pictures, self.cam_from_picture, 1.0)

    def picture_path(self, camera: Trajectory) -> Trajectory:
        """Return the path with the axes of the pictures: the inverse of `camera_path`."""
        return self._turned(camera, np.swapaxes(self.cam_from_picture, 1, 2), -1.0)

    def _turned(self, path: Trajectory, new_from_old: FloatArray, sign: float) -> Trajectory:
        """Return a path in turned axes; the variance of the turn is multiplied by a sign and added."""
        old_from_new = make_transform(np.swapaxes(new_from_old, 1, 2), np.zeros(3))
        both = np.zeros((len(new_from_old), 6, 6))
        both[:, :3, :3] = both[:, 3:, 3:] = new_from_old
        covariance = both @ path.covariance @ np.swapaxes(both, 1, 2)
        covariance[:, range(3), range(3)] += sign * self.sigma_rad[:, None] ** 2
        return replace(path, gauge_from_cam=path.gauge_from_cam @ old_from_new, covariance=covariance)

    def says(self) -> str:
        """Return a sentence for the user: what was found, what is done, and what it costs."""
        known = self.recorded
        missing = f" of {int((~known).sum())} of {len(known)} frames" if known.any() else ""
        return stabilisation_note(self.mode, recorded=bool(known.all()), missing=missing)

    def figures(self) -> dict[str, Any]:
        """Return the turns as plain JSON values for ``metrics.json``."""
        known, angles = self.recorded, rotation_angle_rad(self.cam_from_picture)
        return {
            "mode": self.mode,
            "reason": self.says(),
            "frames_recorded": int(known.sum()),
            "frames_unrecorded": int((~known).sum()),
            "turn_rms_deg": round(float(np.degrees(np.sqrt((angles[known] ** 2).mean()))), 3)
            if known.any()
            else None,
        }


def stabilisation_note(mode: str, *, recorded: bool, missing: str = "") -> str:
    """Return a sentence for the user about a stabilised video: what is done, what it costs, what to do.

    Args:
        mode: Mode of the stabilisation; "" if it is unknown.
        recorded: Whether the orientations of all pictures are recorded.
        missing: Words that say which orientations are missing; "" for all.
    """
    level = f" ({mode})" if mode.lower() not in {"", "on"} else ""
    used = (
        "their recorded orientations turn the poses back for the body: only the cropped edges are lost"
        if recorded
        else f"without a record of their orientations{missing}, the body takes the camera as turning on its "
        "mount: the joints near it are less certain, and its path is not affected"
    )
    return (
        f"the camera stabilised the video{level}; the turned and cropped pictures are used as they are, and "
        f"{used}. Next time, switch the stabilisation (HyperSmooth) off"
    )
