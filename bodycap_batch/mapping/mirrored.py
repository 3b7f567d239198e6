"""Cameras whose picture is flipped: they see the room's mirror image, which has no place in the room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bodycap_batch.errors import EstimationError
from bodycap_batch.mapping.database import DATABASE_NAME, ImageRef, image_ids
from bodycap_batch.mapping.likeness import Descriptors, clear_matches, largest
from bodycap_batch.scene import KeyframeSelection, MapResult

Features = npt.NDArray[np.float32]
"""(K,F,128) descriptors of the largest features of some pictures."""

MIRRORED = "mirrored_cameras"
"""The log's list of cameras that were left out for it."""

_LOOKED_AT = 12
"""Keyframes of each camera, evenly spread."""
_ALIKE, _SURELY = 14, 3.0
"""Pictures with so many features alike count; all of theirs the one way are so many times those of the other.
Between 13 pairs of cameras of three captures 10 times and more, symmetrical posters and all;
counting pictures with 6 features alike it would be 1.8."""
_LEAST = 60
_HINT = (
    "a front camera's setting, or an app, may flip the picture; flip it back: ffmpeg -i in -vf hflip out.mp4"
)


def flipped(descriptors: Descriptors) -> Descriptors:
    """SIFT descriptors (N,128) as the mirrored picture has them: rows and turns the other way round."""
    cells = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return np.ascontiguousarray(cells[..., (8 - np.arange(8)) % 8].reshape(-1, 128))


def without_mirrored(workspace: Path, selections: Sequence[KeyframeSelection]) -> list[KeyframeSelection]:
    """The selections of cameras that see the room the right way round: the larger part, if they differ.

    Args:
        workspace: Folder of the database, features extracted.
        selections: Keyframes of each camera.

    Raises:
        EstimationError: As many cameras see it one way round as the other: which is right cannot be told.
    """
    if len(selections) < 2:
        return list(selections)
    wrong = _mirrored([item.camera for item in selections], _handedness(workspace, selections))
    return [item for item in selections if item.camera not in wrong]


def told(
    built: tuple[MapResult, EstimationError | None],
    selections: Sequence[KeyframeSelection],
    straight: Sequence[KeyframeSelection],
) -> tuple[MapResult, EstimationError | None]:
    """A map of the straight cameras, and what is to be said of it; its log lists those left out."""
    left_out = sorted({item.camera for item in selections} - {item.camera for item in straight})
    return replace(built[0], log={**built[0].log, MIRRORED: left_out}), built[1]


def mirror_note(camera: str) -> str:
    """What to say of a camera that was left out."""
    return f"camera {camera} shows the room mirrored (left and right exchanged) and is left out: {_HINT}"


def _handedness(workspace: Path, selections: Sequence[KeyframeSelection]) -> dict[tuple[str, str], int]:
    """By pair of cameras 1 where they see the same way round, -1 where mirrored, none where nothing tells."""
    straight, mirrored = _features(workspace, selections)
    out = {}
    for one, other in combinations(straight, 2):
        same, turned = (_likeness(straight[one], each[other]) for each in (straight, mirrored))
        if max(same, turned) >= max(_LEAST, _SURELY * min(same, turned)):
            out[one, other] = 1 if same > turned else -1
    return out


def _likeness(one: Features, other: Features) -> int:
    """How many features are alike, in pairs of pictures that show the same."""
    counts = np.concatenate([clear_matches(image, other) for image in one])
    return int(counts[counts >= _ALIKE].sum())


def _features(
    workspace: Path, selections: Sequence[KeyframeSelection]
) -> tuple[dict[str, Features], dict[str, Features]]:
    """By camera the largest features (K,F,128) of some keyframes, as they are and flipped."""
    import pycolmap

    straight, mirrored = {}, {}
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = image_ids(database)
        for item in selections:
            count = len(item.frames)
            some = item.frames[np.unique(np.linspace(0, count - 1, min(count, _LOOKED_AT)).astype(int))]
            images = [ids[ImageRef(item.camera, int(frame))] for frame in some]
            points = [np.asarray(database.read_keypoints(image)) for image in images]
            found = [np.asarray(database.read_descriptors(image).data) for image in images]
            pairs = list(zip(found, points, strict=True))
            straight[item.camera] = np.array([largest(each, where) for each, where in pairs])
            mirrored[item.camera] = np.array([largest(flipped(each), where) for each, where in pairs])
    return straight, mirrored


def _mirrored(cameras: Sequence[str], signs: Mapping[tuple[str, str], int]) -> set[str]:
    """The cameras of the smaller side; each group of cameras that hang together is judged by itself."""
    sign = {**signs, **{(other, one): each for (one, other), each in signs.items()}}
    left, wrong = list(cameras), set[str]()
    while left:
        side, waiting = {left[0]: 1}, [left[0]]
        while waiting:
            here = waiting.pop()
            fresh = [other for other in left if other not in side and (here, other) in sign]
            side |= {other: side[here] * sign[here, other] for other in fresh}
            waiting += fresh
        left = [name for name in left if name not in side]
        one, other = ([name for name, which in side.items() if which == way] for way in (1, -1))
        if len(one) == len(other):
            raise EstimationError(
                f"{', '.join(one)} and {', '.join(other)} see mirror images of each other: in one of the two "
                "pictures left and right are exchanged",
                hint=f"a text in the picture tells which one is wrong; {_HINT}",
            )
        wrong |= set(one if len(one) < len(other) else other)
    return wrong
