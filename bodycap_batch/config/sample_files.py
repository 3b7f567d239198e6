"""Find the file with inertial samples that lies beside the videos of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from bodycap_batch.config.folder import real_path

SAMPLE_SUFFIXES = (".imu.csv", ".gcsv")
"""Ends of the names of the files, in small letters."""


def samples_beside(videos: Sequence[Path], camera: str = "", stated: Sequence[Path] = ()) -> Path | None:
    """Return the file with inertial samples of a camera; None if there is none.

    The file lies beside the first video or beside the folder of the chapters. For a symbolic link, it is
    looked for beside the link, then beside its target.

    Args:
        videos: Paths of the chapters.
        camera: Name of the camera; "" if it is unknown.
        stated: The videos or the folder as the job states them, before links are followed.
    """
    named = [*stated, videos[0], *([videos[0].parent] if len(videos) > 1 else [])]
    for place in dict.fromkeys(path for each in named for path in (each, real_path(each))):
        for stem in dict.fromkeys((place.stem, place.name, camera)):
            for suffix in (*SAMPLE_SUFFIXES, *map(str.upper, SAMPLE_SUFFIXES)):
                if stem and place.name and (path := place.with_name(stem + suffix)).is_file():
                    return path
    return None
