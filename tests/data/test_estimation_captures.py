"""The first three stages on a rendered capture with exact camera poses."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.config import KeyframeOptions, MapOptions, RegistrationOptions
from bodycap_batch.config.job import load_job
from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.keyframes import select_keyframes
from bodycap_batch.mapping import build_map
from bodycap_batch.model.geometry import align_points
from bodycap_batch.registration import register_frames

pytestmark = [pytest.mark.data, pytest.mark.slow]

# A pixel is 7 mm at the 3 m of this room; a map adjusted with squares leads to 0.38 cm. The project asks
# for 0.35.
# Below 0.1 cm the truth would have leaked into the estimate.
MAX_ATE_M, MIN_ATE_M = 0.0035, 0.001


def test_walk12_is_registered_whole_and_to_half_a_pixel(data_root: Path, tmp_path: Path) -> None:
    capture = open_capture(load_job(data_root / "walk12").capture)
    context = StageContext(work_dir=tmp_path, threads=2)
    with ThreadPoolExecutor(2) as pool:
        selections = list(
            pool.map(lambda camera: select_keyframes(camera, KeyframeOptions(), context), capture.cameras)
        )
        scene = build_map(capture, selections, MapOptions(), context)
        registrations = list(
            pool.map(
                lambda three: register_frames(*three, RegistrationOptions(), context),
                [
                    (camera, scene.maps, chosen)
                    for camera, chosen in zip(capture.cameras, selections, strict=True)
                ],
            )
        )
    mine, theirs, spreads, frames = [], [], [], 0
    for item in registrations:
        truth = read_tum(data_root / "walk12" / "gt" / f"{item.trajectory.camera}.tum")
        known = item.trajectory.localised
        frames += len(known)
        # The truth has one pose per frame, in order.
        assert np.abs(truth.times_ns - item.trajectory.times_ns).max() < 2_000_000
        mine.append(item.trajectory.gauge_from_cam[known][:, :3, 3])
        theirs.append(truth.world_from_cam[known][:, :3, 3])
        turn = item.trajectory.gauge_from_cam[known][:, :3, :3]
        spread = item.trajectory.covariance[known][:, 3:, 3:]
        spreads.append(turn @ spread @ np.swapaxes(turn, 1, 2))
    estimate, exact = np.concatenate(mine), np.concatenate(theirs)
    assert len(estimate) >= 0.99 * frames
    similarity = align_points(estimate, exact)
    error = np.linalg.norm(similarity.apply(estimate) - exact, axis=1)
    assert MIN_ATE_M < np.sqrt((error**2).mean()) < MAX_ATE_M
    # Errors in the gauge, against the covariance there. χ²(3) has its median at 2.37. Frames share the map's
    # errors, so that only some fifty keyframes are independent, and the map's part is a rule of thumb.
    off = similarity.inverse().apply(exact) - estimate
    normalised = np.einsum("ni,nij,nj->n", off, np.linalg.inv(np.concatenate(spreads)), off)
    assert 0.33 < np.median(normalised) / 2.37 < 3.0
