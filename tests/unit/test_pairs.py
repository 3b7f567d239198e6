"""Retrieval from the capture's own features, and the number of pairs it asks for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.database import DATABASE_NAME, ImageRef
from bodycap_batch.mapping.pairs import PairChooser
from bodycap_batch.mapping.retrieval import similarity


def _views(rng: np.random.Generator, places: int, per_view: int = 40) -> list[np.ndarray]:
    """Two noisy views of each place: descriptors drawn about the place's own."""
    out = []
    for _ in range(places):
        base = rng.integers(0, 90, (per_view, 128))
        out += [np.clip(base + rng.integers(-6, 7, base.shape), 0, 255).astype(np.uint8) for _ in range(2)]
    return out


def test_the_other_view_of_a_place_is_the_most_alike() -> None:
    alike = similarity(_views(np.random.default_rng(0), 20), seed=0)
    np.fill_diagonal(alike, -2.0)
    assert (np.argmax(alike, axis=1) == np.arange(40) ^ 1).mean() > 0.95
    assert similarity(_views(np.random.default_rng(0), 20), seed=0).max() <= 1.0 + 1e-5


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
                data = rng.integers(0, 90, (30, 128)).astype(np.uint8)
                database.write_descriptors(image_id, pycolmap.FeatureDescriptors(kind, data))
    times = np.arange(keyframes, dtype=np.int64) * 300_000_000
    return {"a": times, "b": times}


@pytest.mark.parametrize("keyframes", [40, 80])
def test_pairs_per_keyframe_are_bounded(tmp_path: Path, keyframes: int) -> None:
    times = _database(tmp_path, keyframes)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(keyframes)]
    pairs = PairChooser(tmp_path, refs, times, MapOptions(pairs="retrieval")).first()
    # Quota per keyframe: 14 neighbours, 8 of its own at another time, 10 of the other camera.
    assert len(pairs) <= 32 * len(refs)
    assert len(set(pairs)) == len(pairs)
    assert (ImageRef("a", 7), ImageRef("b", 7)) in pairs
    assert (ImageRef("a", 7), ImageRef("a", 8)) in pairs
    every = PairChooser(tmp_path, refs, times, MapOptions(pairs="exhaustive")).first()
    assert len(every) == len(refs) * (len(refs) - 1) // 2


def test_growing_matches_new_keyframes_only(tmp_path: Path) -> None:
    times = _database(tmp_path, 60)
    new = [ImageRef("a", 5), ImageRef("b", 30)]
    pairs = PairChooser(tmp_path, new, times, MapOptions(pairs="retrieval")).first()
    assert all(a in new or b in new for a, b in pairs)
    assert len(pairs) <= 32 * len(new)


def test_what_hangs_by_few_links_gets_more(tmp_path: Path) -> None:
    times = _database(tmp_path, 80)
    refs = [ImageRef(camera, frame) for camera in times for frame in range(80)]
    chooser = PairChooser(tmp_path, refs, times, MapOptions(pairs="retrieval"))
    first = chooser.first()
    weak = ImageRef("a", 40)
    held = {pair: 50 for pair in first if weak not in pair}
    degree = {ref: sum(ref in pair and pair[0].camera != pair[1].camera for pair in held) for ref in refs}
    more = chooser.wider(held)
    assert sum(weak in pair for pair in more) >= 100  # 64 of either camera, less what is near in time
    well = [ref for ref in refs if degree[ref] >= 12]
    assert all(a not in well or b not in well for a, b in more)
    assert chooser.wider({(a, b): 50 for a in refs for b in refs if a < b}) == []
    assert chooser.unlinked(held) == []
    alone = chooser.unlinked({pair: 50 for pair in first if pair[0].camera == pair[1].camera})
    assert len(alone) == 80 * 80
