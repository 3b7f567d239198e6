"""Retrieval of similar keyframes, and the number of pairs that are matched."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import Cancelled
from bodycap_batch.mapping.matching.database import DATABASE_NAME, ImageRef
from bodycap_batch.mapping.matching.pair_selection import PairGenerator
from bodycap_batch.mapping.matching.retrieval import (
    MIN_RETRIEVAL_MATCHES,
    _count_matches,
    count_preemptive_matches,
    largest_descriptors,
)


def _keypoints(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(1.0, 40.0, (count, 4)).astype(np.float32)


def _root_sift(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return descriptors like those of the feature extraction: bytes of length 512."""
    raw = rng.exponential(size=(count, 128))
    rooted = 512.0 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))
    return np.asarray(np.round(rooted).clip(0, 255), np.uint8)


def test_two_views_of_one_place_match_and_others_do_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = []
    for _ in range(40):  # more than one block
        descriptors, keypoints = _root_sift(rng, 60), _keypoints(rng, 60)
        noisy = np.clip(descriptors + rng.normal(0, 4, descriptors.shape), 0, 255).astype(np.uint8)
        images += [largest_descriptors(descriptors, keypoints), largest_descriptors(noisy, keypoints)]
    rows = list(range(0, 80, 7))
    every = np.array(images)
    alike = count_preemptive_matches(every, rows, ["a"] * 80, StageContext(work_dir=tmp_path))
    assert (
        count_preemptive_matches(every, rows, ["a"] * 80, StageContext(work_dir=tmp_path, threads=3)) == alike
    ).all()
    partner = np.array(rows) ^ 1
    assert (alike[np.arange(len(rows)), partner] >= 50).all()
    alike[np.arange(len(rows)), partner] = 0
    assert (alike < MIN_RETRIEVAL_MATCHES).mean() > 0.99
    empty = np.array([largest_descriptors(_root_sift(rng, 0), _keypoints(rng, 0))] * 2)
    assert not count_preemptive_matches(empty, [0], ["a", "a"], StageContext(work_dir=tmp_path)).any()


def test_similar_images_are_found_without_comparing_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(2)
    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._SHORTLIST_SIZE", 12)
    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._SHORTLIST_SIZE_PER_CAMERA", 2)
    compared: list[int] = []

    def counted(alike: np.ndarray) -> np.ndarray:
        compared.append(alike.shape[1])
        return _count_matches(alike)

    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._count_matches", counted)
    images, cameras = [], []
    for number in range(120):
        descriptors, keypoints = _root_sift(rng, 80), _keypoints(rng, 80)
        # Another camera shows half of the image from another position.
        other = np.vstack([descriptors[:40], _root_sift(rng, 40)])
        noisy = np.clip(other + rng.normal(0, 4, other.shape), 0, 255).astype(np.uint8)
        images += [largest_descriptors(descriptors, keypoints), largest_descriptors(noisy, keypoints)]
        cameras += ["a", "b" if number else "c"]
    rows = list(range(240))
    reported = list[tuple[int, int]]()
    context = StageContext(work_dir=tmp_path, progress=lambda done, total, _: reported.append((done, total)))
    alike = count_preemptive_matches(np.array(images), rows, cameras, context)
    assert reported == [(number, 240) for number in rows]
    partner = np.array(rows) ^ 1
    assert (alike[rows, partner] >= 20).mean() > 0.99
    assert (alike == alike.T).all()
    # The shortlist holds 12 of all images and 2 of each of three cameras.
    assert sum(compared) <= 18 * len(rows)
    # The size of a block does not change the result.
    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._BLOCK_SIZE", 7)
    assert (count_preemptive_matches(np.array(images), rows, cameras, context) == alike).all()


def test_retrieval_stops_on_request(tmp_path: Path) -> None:
    context = StageContext(work_dir=tmp_path, cancelled=lambda: True)
    with pytest.raises(Cancelled):
        count_preemptive_matches(np.zeros((3, 128, 128), np.float32), [0, 1, 2], ["a"] * 3, context)


def _database(folder: Path, keyframes: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(1)
    with pycolmap.Database.open(str(folder / DATABASE_NAME)) as database:
        for camera in ("a", "b"):
            model = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24])
            camera_id = database.write_camera(model)
            for frame in range(keyframes):
                image = pycolmap.Image(name=ImageRef(camera, frame).name, camera_id=camera_id)
                image_id = database.write_image(image)
                kind = pycolmap.FeatureExtractorType.SIFT
                database.write_keypoints(image_id, _keypoints(rng, 30))
                database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, _root_sift(rng, 30)))
    times = np.arange(keyframes, dtype=np.int64) * 300_000_000
    return {"a": times, "b": times}


@pytest.mark.parametrize("keyframes", [62, 80])
def test_pairs_per_keyframe_are_bounded(tmp_path: Path, keyframes: int) -> None:
    times = _database(tmp_path, keyframes)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(keyframes)]
    pairs = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    ).initial_pairs()
    # Per keyframe: 14 neighbours (each pair counts twice), 2 at the same instant, up to 64 retrieved.
    assert len(pairs) <= (7 + 2 + 64) * len(refs)
    assert len(set(pairs)) == len(pairs)
    assert (ImageRef("a", 7), ImageRef("b", 7)) in pairs
    assert (ImageRef("a", 7), ImageRef("a", 8)) in pairs
    every = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="exhaustive"), StageContext(work_dir=tmp_path)
    ).initial_pairs()
    assert len(every) == len(refs) * (len(refs) - 1) // 2


def test_few_keyframes_are_matched_exhaustively(tmp_path: Path) -> None:
    times = _database(tmp_path, 20)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(20)]
    assert (
        len(
            PairGenerator(
                tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
            ).initial_pairs()
        )
        == 40 * 39 // 2
    )


def test_an_extension_matches_new_keyframes_only(tmp_path: Path) -> None:
    times = _database(tmp_path, 70)
    new = [ImageRef("a", 5), ImageRef("b", 30)]
    generator = PairGenerator(
        tmp_path, new, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    )
    pairs = generator.initial_pairs()
    assert all(a in new or b in new for a, b in pairs)
    assert len(pairs) <= (14 + 2 + 64) * len(new)
    more = generator.expansion_pairs(dict.fromkeys(pairs, 50), set(pairs))
    assert all(a in new or b in new for a, b in more)


def test_a_keyframe_to_resect_is_matched_with_neighbours_and_similar_keyframes(tmp_path: Path) -> None:
    times = _database(tmp_path, 80)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(80)]
    generator = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    )
    registered = [ref for ref in refs if ref.frame % 5 == 0]
    pairs = generator.resection_pairs(registered, [ImageRef("a", 42), ImageRef("a", 43)])
    assert all(ImageRef("a", frame) in sum(pairs, ()) for frame in (41, 44))
    assert {(ImageRef("a", at), ImageRef("a", 42)) for at in (35, 40)} <= set(pairs)
    assert (ImageRef("a", 43), ImageRef("b", 45)) in pairs
    wanted = {ImageRef("a", 42), ImageRef("a", 43)}
    assert all(not wanted.isdisjoint(pair) for pair in pairs)
    # Four neighbours in time, one simultaneous, eight similar, one on either side.
    assert len(pairs) <= 2 * (4 + 1 + 8 + 2) - 1


def test_keyframes_with_few_links_are_matched_with_neighbours_of_verified_pairs(tmp_path: Path) -> None:
    times = _database(tmp_path, 80)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(80)]
    generator = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    )
    a, b = ImageRef("a", 40), ImageRef("b", 10)
    verified = {(a, b): 50}
    expected = {
        (ImageRef("a", 39), b),
        (ImageRef("a", 41), b),
        (a, ImageRef("b", 9)),
        (a, ImageRef("b", 11)),
    }
    assert set(generator.expansion_pairs(verified, {(a, b)})) == expected
    assert generator.expansion_pairs({(a, b): 15}, {(a, b)}) == []  # too few matches for a link
    linked = {(x, y): 50 for x in refs for y in refs if x.camera < y.camera}
    assert generator.expansion_pairs(linked, set()) == []
    assert generator.unlinked_camera_pairs(verified, {(a, b)}) == []
    assert len(generator.unlinked_camera_pairs({(a, ImageRef("a", 41)): 50}, set())) == 80 * 80


def test_a_long_camera_without_links_is_not_matched_with_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bodycap_batch.mapping.matching.pair_selection._MAX_RETRY_PAIRS", 500)
    times = _database(tmp_path, 80)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(80)]
    generator = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    )
    pairs = generator.unlinked_camera_pairs({(refs[0], refs[1]): 50}, set())
    assert 200 < len(pairs) <= 500
    # The pairs cover both cameras from the first to the last keyframe.
    assert {a.frame // 20 for a, _ in pairs} == {b.frame // 20 for _, b in pairs} == {0, 1, 2, 3}
    assert generator.unlinked_camera_pairs({(refs[0], refs[1]): 50}, set(pairs)) == []
