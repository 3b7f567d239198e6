"""Which keyframes look alike, and the number of pairs that are matched."""

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


def _rooted(rng: np.random.Generator, count: int) -> np.ndarray:
    """Descriptors like the detector's: bytes of length 512."""
    raw = rng.exponential(size=(count, 128))
    rooted = 512.0 * np.sqrt(raw / raw.sum(axis=1, keepdims=True))
    return np.asarray(np.round(rooted).clip(0, 255), np.uint8)


def test_two_views_of_a_place_are_alike_and_others_not(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = []
    for _ in range(40):  # more than are looked at together
        descriptors, keypoints = _rooted(rng, 60), _keypoints(rng, 60)
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
    empty = np.array([largest_descriptors(_rooted(rng, 0), _keypoints(rng, 0))] * 2)
    assert not count_preemptive_matches(empty, [0], ["a", "a"], StageContext(work_dir=tmp_path)).any()


def test_what_could_be_alike_is_found_without_looking_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(2)
    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._SHORTLIST_SIZE", 12)
    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._SHORTLIST_SIZE_PER_CAMERA", 2)
    looked: list[int] = []

    def counted(alike: np.ndarray) -> np.ndarray:
        looked.append(alike.shape[1])
        return _count_matches(alike)

    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._count_matches", counted)
    images, cameras = [], []
    for number in range(120):
        descriptors, keypoints = _rooted(rng, 80), _keypoints(rng, 80)
        # Half of what an image shows is seen from somewhere else too, by another camera.
        other = np.vstack([descriptors[:40], _rooted(rng, 40)])
        noisy = np.clip(other + rng.normal(0, 4, other.shape), 0, 255).astype(np.uint8)
        images += [largest_descriptors(descriptors, keypoints), largest_descriptors(noisy, keypoints)]
        cameras += ["a", "b" if number else "c"]
    rows = list(range(240))
    told = list[tuple[int, int]]()
    context = StageContext(work_dir=tmp_path, progress=lambda done, total, _: told.append((done, total)))
    alike = count_preemptive_matches(np.array(images), rows, cameras, context)
    assert told == [(number, 240) for number in rows]
    partner = np.array(rows) ^ 1
    assert (alike[rows, partner] >= 20).mean() > 0.99
    assert (alike == alike.T).all()
    # 12 of all and 2 of each of three cameras.
    assert sum(looked) <= 18 * len(rows)
    # How many rows are looked at together changes nothing.
    monkeypatch.setattr("bodycap_batch.mapping.matching.retrieval._BLOCK_SIZE", 7)
    assert (count_preemptive_matches(np.array(images), rows, cameras, context) == alike).all()


def test_looking_for_likenesses_stops_on_request(tmp_path: Path) -> None:
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
                database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, _rooted(rng, 30)))
    times = np.arange(keyframes, dtype=np.int64) * 300_000_000
    return {"a": times, "b": times}


@pytest.mark.parametrize("keyframes", [62, 80])
def test_pairs_per_keyframe_are_bounded(tmp_path: Path, keyframes: int) -> None:
    times = _database(tmp_path, keyframes)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(keyframes)]
    pairs = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    ).initial_pairs()
    # Per keyframe: 14 neighbours (each pair counts twice), 2 at the same instant, up to 64 that look alike.
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


def test_growing_matches_new_keyframes_only(tmp_path: Path) -> None:
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


def test_who_is_placed_is_matched_with_those_beside_it_and_some_of_the_map(tmp_path: Path) -> None:
    times = _database(tmp_path, 80)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(80)]
    generator = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    )
    carrying = [ref for ref in refs if ref.frame % 5 == 0]
    pairs = generator.resection_pairs(carrying, [ImageRef("a", 42), ImageRef("a", 43)])
    assert all(ImageRef("a", frame) in sum(pairs, ()) for frame in (41, 44))
    assert {(ImageRef("a", at), ImageRef("a", 42)) for at in (35, 40)} <= set(pairs)
    assert (ImageRef("a", 43), ImageRef("b", 45)) in pairs
    wanted = {ImageRef("a", 42), ImageRef("a", 43)}
    assert all(not wanted.isdisjoint(pair) for pair in pairs)
    # Four in time, one at the same time, eight alike, one on either side.
    assert len(pairs) <= 2 * (4 + 1 + 8 + 2) - 1


def test_what_hangs_by_few_links_is_matched_beside_what_held(tmp_path: Path) -> None:
    times = _database(tmp_path, 80)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(80)]
    generator = PairGenerator(
        tmp_path, refs, times, MapOptions(pairs="retrieval"), StageContext(work_dir=tmp_path)
    )
    a, b = ImageRef("a", 40), ImageRef("b", 10)
    held = {(a, b): 50}
    expected = {
        (ImageRef("a", 39), b),
        (ImageRef("a", 41), b),
        (a, ImageRef("b", 9)),
        (a, ImageRef("b", 11)),
    }
    assert set(generator.expansion_pairs(held, {(a, b)})) == expected
    assert generator.expansion_pairs({(a, b): 15}, {(a, b)}) == []  # too weak to lead further
    tied = {(x, y): 50 for x in refs for y in refs if x.camera < y.camera}
    assert generator.expansion_pairs(tied, set()) == []
    assert generator.unlinked_camera_pairs(held, {(a, b)}) == []
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
    # From one end to the other of both.
    assert {a.frame // 20 for a, _ in pairs} == {b.frame // 20 for _, b in pairs} == {0, 1, 2, 3}
    assert generator.unlinked_camera_pairs({(refs[0], refs[1]): 50}, set(pairs)) == []
