"""Cameras whose picture is flipped: they see the room's mirror image, which has no place in the room."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.config import MapOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    rewrite_without_cameras,
    read_image_ids,
)
from bodycap_batch.mapping.matching.retrieval import (
    Descriptors,
    count_ratio_test_matches,
    largest_descriptors,
)
from bodycap_batch.model.scene import KeyframeSelection

CameraDescriptors = npt.NDArray[np.float32]
"""(K,F,128) descriptors of the largest features of some pictures."""

FLIPPED_CAMERAS = "mirrored_cameras"
"""The log's list of cameras that were left out for it."""

UNDECIDED_GROUPS = "mirror_images"
"""The log's list of pairs of sides (camera names each) that see mirror images of each other, all kept."""

_NAMED, _LEFT_OUT = "named_initial_pair", "left_out"

_KEYFRAMES_PER_CAMERA = 12
"""Keyframes of each camera, evenly spread."""
_ALIKE, _SURELY = 14, 3.0
"""Pictures with so many features alike count; all of theirs the one way are so many times those of the other.
Between 13 pairs of cameras of three captures 10 times and more, symmetrical posters and all;
counting pictures with 6 features alike it would be 1.8."""
_LEAST = 60
_HINT = (
    "a front camera's setting, or an app, may flip the picture; flip it back: ffmpeg -i in -vf hflip out.mp4"
)

_MAYBE = (
    "that is right where one of them films a wall mirror, or where the room's halves are mirror images of "
    "each other; else the picture in which text reads backwards is flipped, and what comes of it is wrong"
)


def mirror_descriptors(descriptors: Descriptors) -> Descriptors:
    """SIFT descriptors (N,128) as the mirrored picture has them: rows and turns the other way round."""
    cells = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return np.ascontiguousarray(cells[..., (8 - np.arange(8)) % 8].reshape(-1, 128))


def exclude_flipped_cameras(
    workspace: Path, selections: Sequence[KeyframeSelection], options: MapOptions
) -> tuple[list[KeyframeSelection], MapOptions, dict[str, Any]]:
    """Take the cameras that see the room the wrong way round out of the database: the smaller part.

    Pictures alone do not tell a flipped one from one that shows a mirror, or the other half of a room whose
    halves are mirror images. So nobody is left out where as many cameras see it one way round as the other,
    or where what tells who is mirrored contradicts itself.

    Args:
        workspace: Folder of the database, features extracted; it is written anew where cameras are left out.
        selections: Keyframes of each camera.
        options: The stage's options.

    Returns:
        The selections of the cameras that are left; the options, without a first pair of which a picture is
        left out; for the log, who was left out (`FLIPPED_CAMERAS`), and who sees mirror images of whom where that
        is left open (`UNDECIDED_GROUPS`).
    """
    if len(selections) < 2:
        return list(selections), options, {}
    wrong, open_ = label_cameras([item.camera for item in selections], _pair_evidence(workspace, selections))
    log: dict[str, Any] = {UNDECIDED_GROUPS: open_} if open_ else {}
    if not wrong:
        return list(selections), options, log
    rewrite_without_cameras(workspace, wrong)
    log[FLIPPED_CAMERAS] = sorted(wrong)
    if lost := wrong & {name.rpartition(":")[0] for name in options.init_frames or ()}:
        options = options.model_copy(update={"init_frames": None})
        log[_NAMED] = {"failed": "a mirrored camera was left out", _LEFT_OUT: sorted(lost)}
    return [item for item in selections if item.camera not in wrong], options, log


def flip_notes(log: Mapping[str, Any]) -> list[str]:
    """What to say of mirrored cameras, from a map's log."""
    named = log.get(_NAMED, {}).get(_LEFT_OUT, ())
    return [
        *map(excluded_camera_note, log.get(FLIPPED_CAMERAS, ())),
        *(f"map.init_frames names camera {name}, which is left out: it is not used" for name in named),
        *(f"{_undecided_sentence(each)}: {_MAYBE}; {_HINT}" for each in log.get(UNDECIDED_GROUPS, ())),
    ]


def excluded_camera_note(camera: str) -> str:
    """What to say of a camera that was left out."""
    return f"camera {camera} shows the room mirrored (left and right exchanged) and is left out: {_HINT}"


def add_flip_hint(error: EstimationError | None, log: Mapping[str, Any]) -> EstimationError | None:
    """The same error; its hint begins with who sees mirror images of whom, where the log leaves that open."""
    if error is not None and log.get(UNDECIDED_GROUPS):
        error.hint = "; ".join(
            [*map(_undecided_sentence, log[UNDECIDED_GROUPS]), _MAYBE, _HINT, *filter(None, [error.hint])]
        )
    return error


def _undecided_sentence(sides: Sequence[Sequence[str]]) -> str:
    one, other = (", ".join(names) for names in sides)
    return f"cameras {one} and {other} see mirror images of each other"


def _pair_evidence(workspace: Path, selections: Sequence[KeyframeSelection]) -> dict[tuple[str, str], int]:
    """By pair of cameras how many more features are alike as they see it than mirrored.

    Negative where they see mirror images of each other; nothing of pairs where nothing tells.
    """
    straight, mirrored = _sample_descriptors(workspace, selections)
    out = {}
    for one, other in combinations(sorted(straight), 2):
        same, turned = (_count_similar_features(straight[one], each[other]) for each in (straight, mirrored))
        if max(same, turned) >= max(_LEAST, _SURELY * min(same, turned)):
            out[one, other] = same - turned
    return out


def _count_similar_features(one: CameraDescriptors, other: CameraDescriptors) -> int:
    """How many features are alike, in pairs of pictures that show the same."""
    counts = [count_ratio_test_matches(image, other) for image in one]
    return int(sum(each[each >= _ALIKE].sum() for each in counts))


def _stack(images: Sequence[CameraDescriptors]) -> CameraDescriptors:
    return np.array(images, dtype=np.float32).reshape(-1, 128, 128)


def _sample_descriptors(
    workspace: Path, selections: Sequence[KeyframeSelection]
) -> tuple[dict[str, CameraDescriptors], dict[str, CameraDescriptors]]:
    """By camera the largest features (K,F,128) of some keyframes, as they are and flipped."""
    import pycolmap

    straight, mirrored = {}, {}
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        for item in selections:
            count = len(item.frames)
            some = item.frames[
                np.unique(np.linspace(0, count - 1, min(count, _KEYFRAMES_PER_CAMERA)).astype(int))
            ]
            images = [ids[ImageRef(item.camera, int(frame))] for frame in some]
            points = [np.asarray(database.read_keypoints(image)) for image in images]
            found = [np.asarray(database.read_descriptors(image).data) for image in images]
            pairs = list(zip(found, points, strict=True))
            straight[item.camera] = _stack([largest_descriptors(each, where) for each, where in pairs])
            mirrored[item.camera] = _stack(
                [largest_descriptors(mirror_descriptors(each), where) for each, where in pairs]
            )
    return straight, mirrored


def label_cameras(
    cameras: Sequence[str], evidence: Mapping[tuple[str, str], int]
) -> tuple[set[str], list[list[list[str]]]]:
    """The cameras of each group's smaller side, and the two sides where that is left open.

    Groups are joined by the strongest evidence first. Evidence against what stronger evidence says leaves
    its group open, unless that is `_SURELY` times as strong.
    """
    groups = {name: {name: 1} for name in cameras}
    held: dict[tuple[str, str], int] = {}
    contradicted = set[str]()
    for (one, other), found in sorted(evidence.items(), key=lambda each: (-abs(each[1]), each[0])):
        mine, theirs, way = groups[one], groups[other], 1 if found > 0 else -1
        if mine is theirs:
            if mine[one] * mine[other] != way and _SURELY * abs(found) > held[one, other]:
                contradicted.add(one)
            continue
        across = [*product(mine, theirs), *product(theirs, mine)]
        held |= dict.fromkeys(across, abs(found))
        turn = way * mine[one] * theirs[other]
        mine |= {name: turn * side for name, side in theirs.items()}
        groups |= dict.fromkeys(theirs, mine)
    wrong, open_ = set[str](), []
    for group in sorted({tuple(sorted(each.items())) for each in groups.values()}):
        sides = sorted(([name for name, side in group if side == way] for way in (1, -1)), key=_size)
        names = {name for name, _ in group}
        if names & contradicted:
            apart = {pair: found for pair, found in evidence.items() if names.issuperset(pair)}
            open_.append([[name] for name in min(apart, key=lambda pair: (apart[pair], pair))])
        elif len(sides[0]) == len(sides[1]):
            open_.append(sides)
        else:
            wrong.update(sides[0])
    return wrong, open_


def _size(names: Sequence[str]) -> tuple[int, Sequence[str]]:
    return len(names), names
