"""Find the file with inertial samples that lies beside the videos of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

IMU_SUFFIX, GYROFLOW_SUFFIX = ".imu.csv", ".gcsv"
"""Ends of the names of the files."""


def samples_beside(videos: Sequence[Path], camera: str) -> Path | None:
    """Return the file with inertial samples of a camera; None if there is none.

    The file lies beside the first video or, if there are several chapters, beside their folder.

    Args:
        videos: Paths of the chapters.
        camera: Name of the camera; "" if it is unknown.
    """
    places = [videos[0], videos[0].parent] if len(videos) > 1 else [videos[0]]
    for place in places:
        for stem in dict.fromkeys((place.stem, place.name, camera)):
            for suffix in (IMU_SUFFIX, GYROFLOW_SUFFIX):
                path = place.with_name(stem + suffix) if stem else place
                if stem and path.is_file():
                    return path
    return None
