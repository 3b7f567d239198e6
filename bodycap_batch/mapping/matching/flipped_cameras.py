"""Find and exclude cameras with mirrored images (left and right exchanged).

Mirrored images show the mirror image of the room, so they contradict a map of the room.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bodycap_batch.config import MapOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.core.mechanisms import Mechanism, is_on, record_act
from bodycap_batch.mapping.matching.database import (
    DATABASE_NAME,
    ImageRef,
    read_image_ids,
    rewrite_without_cameras,
)
from bodycap_batch.mapping.matching.descriptors import ByteDescriptors
from bodycap_batch.mapping.matching.retrieval import count_ratio_test_matches, largest_descriptors
from bodycap_batch.model.map_diagnostics import CameraGroups, MapDiagnostics
from bodycap_batch.model.scene import KeyframeSelection

CameraDescriptors = npt.NDArray[np.float32]
"""(K,128,128) descriptors of K keyframes of one camera, each as `largest_descriptors` returns them."""

_KEYFRAMES_PER_CAMERA = 12
"""Maximum number of keyframes of each camera that are compared. They are evenly spaced. Evidence: none."""
_MIN_MATCHES = 14
"""Minimum number of matches of an image pair. Image pairs with fewer matches are ignored.
Evidence: docs/decisions/mapping.md."""
_MIN_RATIO = 3.0
"""Minimum ratio of the stronger to the weaker of two numbers, used for two decisions. First: two cameras give
evidence only if the numbers of matches in the two orientations differ by this ratio. Second: if two pieces of
evidence contradict each other and their strengths differ by this ratio, the weaker one is ignored.
Evidence: docs/decisions/mapping.md."""
_MIN_TOTAL_MATCHES = 60
"""Minimum number of matches of two cameras, summed over all their image pairs, in the orientation with more
matches. Two cameras with fewer matches give no evidence. Evidence: none."""
_HINT = (
    "flip the video back (ffmpeg -i in -vf hflip out.mp4); a setting of a front camera, or an app, may "
    "have mirrored the picture"
)

_UNDECIDED_HINT = (
    "the result is right if one of these cameras films a wall mirror, or if the two halves of the room "
    "are mirror images of each other; otherwise the result is wrong, and you must flip the video in which "
    "text reads backwards"
)


def mirror_descriptors(descriptors: ByteDescriptors) -> ByteDescriptors:
    """Return the SIFT descriptors (N,128) that the same features would have in the mirrored image.

    The order of the cells is reversed along one axis, and the gradient directions are mirrored.
    """
    cells = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return np.ascontiguousarray(cells[..., (8 - np.arange(8)) % 8].reshape(-1, 128))


def exclude_flipped_cameras(
    workspace: Path, selections: Sequence[KeyframeSelection], options: MapOptions
) -> tuple[list[KeyframeSelection], MapOptions, MapDiagnostics]:
    """Remove cameras with mirrored images from the database.

    Cameras whose images match are divided into two groups with opposite orientation. The smaller group is
    excluded. If both groups have the same size, or if the evidence contradicts itself, all cameras are kept.
    In these cases the images may be correct: one group may film a wall mirror, or the other half of a
    symmetric room.

    Args:
        workspace: Folder of the database with extracted features. The database is rewritten if cameras are
            excluded.
        selections: Keyframes of each camera.
        options: The stage's options.

    Returns:
        The keyframes of each remaining camera; the stage's options, in which the initial pair is removed if
        it names an excluded camera; the diagnostics on mirrored cameras.
    """
    if len(selections) < 2 or not is_on(Mechanism.FLIPPED_CAMERAS):
        return list(selections), options, MapDiagnostics()
    cameras = [item.camera for item in selections]
    flipped, undecided = label_cameras(cameras, _pair_evidence(workspace, selections))
    if not flipped:
        return list(selections), options, MapDiagnostics(undecided_groups=undecided)
    record_act(Mechanism.FLIPPED_CAMERAS, len(flipped))
    rewrite_without_cameras(workspace, flipped)
    lost = flipped & {name.rpartition(":")[0] for name in options.init_frames or ()}
    if lost:
        options = options.model_copy(update={"init_frames": None})
    diagnostics = MapDiagnostics(
        undecided_groups=undecided,
        flipped_cameras=tuple(sorted(flipped)),
        excluded_from_pair=tuple(sorted(lost)),
    )
    return [item for item in selections if item.camera not in flipped], options, diagnostics


def flip_notes(diagnostics: MapDiagnostics) -> list[str]:
    """Return the notes for the user on cameras with mirrored images."""
    return [
        *map(excluded_camera_note, diagnostics.flipped_cameras),
        *(
            f"map.init_frames is not used, because one of its frames belongs to camera {name}, which is "
            "left out"
            for name in diagnostics.excluded_from_pair
        ),
        *(
            f"{_undecided_sentence(groups)}: {_UNDECIDED_HINT}; {_HINT}"
            for groups in diagnostics.undecided_groups
        ),
    ]


def excluded_camera_note(camera: str) -> str:
    """Return the note for the user on an excluded camera."""
    return f"camera {camera} shows the room mirrored (left and right exchanged) and is left out: {_HINT}"


def add_flip_hint(error: EstimationError | None, diagnostics: MapDiagnostics) -> EstimationError | None:
    """Add a sentence on undecided groups of cameras to the start of an error's hint.

    Without undecided groups, the error is returned unchanged.

    Returns:
        The error with the longer hint; None if `error` is None.
    """
    if error is not None and diagnostics.undecided_groups:
        groups = map(_undecided_sentence, diagnostics.undecided_groups)
        error.hint = "; ".join([*groups, _UNDECIDED_HINT, _HINT, *filter(None, [error.hint])])
    return error


def _undecided_sentence(groups: CameraGroups) -> str:
    """Return the sentence for the user that names two groups of cameras with opposite orientation."""
    one, other = (", ".join(names) for names in groups)
    return f"cameras {one} and {other} see mirror images of each other"


def _pair_evidence(workspace: Path, selections: Sequence[KeyframeSelection]) -> dict[tuple[str, str], int]:
    """Return the evidence on the relative orientation of two cameras, by pair of camera names.

    The images of the first camera are matched twice: with the unchanged images of the second camera and with
    its mirrored images. The evidence is the first number of matches minus the second number. A negative
    number means that the two cameras see mirror images of each other. The result holds only pairs of cameras
    with clear evidence.
    """
    straight, mirrored = _sample_descriptors(workspace, selections)
    out = {}
    for one, other in combinations(sorted(straight), 2):
        same, opposite = (
            _count_similar_features(straight[one], orientation[other]) for orientation in (straight, mirrored)
        )
        if max(same, opposite) >= max(_MIN_TOTAL_MATCHES, _MIN_RATIO * min(same, opposite)):
            out[one, other] = same - opposite
    return out


def _count_similar_features(one: CameraDescriptors, other: CameraDescriptors) -> int:
    """Return the number of matches of two cameras.

    Only image pairs with at least `_MIN_MATCHES` matches are counted.
    """
    counts = [count_ratio_test_matches(image, other) for image in one]
    return int(sum(count[count >= _MIN_MATCHES].sum() for count in counts))


def _stack(images: Sequence[CameraDescriptors]) -> CameraDescriptors:
    """Return the descriptors of K images as one array (K,128,128); K may be 0."""
    return np.array(images, dtype=np.float32).reshape(-1, 128, 128)


def _sample_descriptors(
    workspace: Path, selections: Sequence[KeyframeSelection]
) -> tuple[dict[str, CameraDescriptors], dict[str, CameraDescriptors]]:
    """Return descriptors of some keyframes of each camera: unchanged and mirrored.

    Returns:
        The `largest_descriptors` of the keyframes, by camera name; the `largest_descriptors` of the mirrored
        keyframes, by camera name.
    """
    import pycolmap

    straight, mirrored = {}, {}
    with pycolmap.Database.open(str(workspace / DATABASE_NAME)) as database:
        ids = read_image_ids(database)
        for item in selections:
            count = len(item.frames)
            spaced = np.linspace(0, count - 1, min(count, _KEYFRAMES_PER_CAMERA)).astype(int)
            images = [ids[ImageRef(item.camera, int(frame))] for frame in item.frames[np.unique(spaced)]]
            keypoints = [np.asarray(database.read_keypoints(image)) for image in images]
            descriptors = [np.asarray(database.read_descriptors(image).data) for image in images]
            features = list(zip(descriptors, keypoints, strict=True))
            straight[item.camera] = _stack([largest_descriptors(found, at) for found, at in features])
            mirrored[item.camera] = _stack(
                [largest_descriptors(mirror_descriptors(found), at) for found, at in features]
            )
    return straight, mirrored


def label_cameras(
    cameras: Sequence[str], evidence: Mapping[tuple[str, str], int]
) -> tuple[set[str], tuple[CameraGroups, ...]]:
    """Divide cameras into two groups with opposite orientation, given signed evidence on pairs of cameras.

    At first, each camera is a separate component. Pairs of cameras are processed in the order of their
    evidence, the strongest first. A pair joins the components of its two cameras into one component.

    The two cameras of a pair may already be in one component, and the pair's evidence may contradict their
    groups. This contradiction is ignored if the evidence that joined the two cameras is at least `_MIN_RATIO`
    times as strong as the evidence of the pair. Otherwise the component is undecided. A component with two
    groups of the same size is undecided too.

    Args:
        cameras: Camera names.
        evidence: Signed evidence by pair of camera names: positive for equal orientation, negative for
            opposite orientation.

    Returns:
        The cameras in the smaller groups of all decided components; two groups with opposite orientation for
        each undecided component. If an undecided component has a contradiction, each of its two groups is one
        camera: the pair with the strongest evidence for opposite orientation.
    """
    components = {name: {name: 1} for name in cameras}
    strength: dict[tuple[str, str], int] = {}
    contradicted = set[str]()
    for (one, other), found in sorted(evidence.items(), key=lambda item: (-abs(item[1]), item[0])):
        first, second, sign = components[one], components[other], 1 if found > 0 else -1
        if first is second:
            if first[one] * first[other] != sign and _MIN_RATIO * abs(found) > strength[one, other]:
                contradicted.add(one)
            continue
        across = [*product(first, second), *product(second, first)]
        strength |= dict.fromkeys(across, abs(found))
        change = sign * first[one] * second[other]
        first |= {name: change * label for name, label in second.items()}
        components |= dict.fromkeys(second, first)
    flipped, undecided = set[str](), list[CameraGroups]()
    for component in sorted({tuple(sorted(labels.items())) for labels in components.values()}):
        groups = sorted(
            ([name for name, label in component if label == sign] for sign in (1, -1)), key=_size_and_names
        )
        names = {name for name, _ in component}
        if names & contradicted:
            inside = {pair: found for pair, found in evidence.items() if names.issuperset(pair)}
            one, other = min(inside, key=lambda pair: (inside[pair], pair))
            undecided.append(((one,), (other,)))
        elif len(groups[0]) == len(groups[1]):
            undecided.append((tuple(groups[0]), tuple(groups[1])))
        else:
            flipped.update(groups[0])
    return flipped, tuple(undecided)


def _size_and_names(names: Sequence[str]) -> tuple[int, Sequence[str]]:
    """Return the sort key for groups of cameras: the size of the group, then its camera names."""
    return len(names), names
