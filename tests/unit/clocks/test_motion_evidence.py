"""Clocks from the sound, completed and checked by the motion."""

from __future__ import annotations

import numpy as np
import pytest

from bodycap_batch.clocks.container_times import ContainerTime
from bodycap_batch.clocks.estimate import ClockEstimate, ClockEstimates
from bodycap_batch.clocks.motion_evidence import add_motion
from bodycap_batch.clocks.motion_offsets import MotionClocks, MotionCurve
from bodycap_batch.clocks.motion_score import MotionScore
from bodycap_batch.clocks.motion_signals import CameraPath, motion_signals
from bodycap_batch.clocks.pair_offsets import PairOffset
from bodycap_batch.clocks.sound_evidence import Recording, SoundEvidence
from bodycap_batch.model.camera_clock import ClockRelation

REFERENCE = ClockEstimate(camera="torso", source="common")
NONE = ClockEstimate(camera="palm", reasons=("no sound",))
EMPTY = SoundEvidence()


def sound(offset_s: float, sigma_s: float = 0.002) -> ClockEstimate:
    return ClockEstimate(camera="palm", offset_s=offset_s, sigma_s=sigma_s, source="sound")


def moved(
    offset_s: float | None, sigma_s: float = 0.02, curves: tuple[MotionCurve, ...] = ()
) -> MotionClocks:
    clocks = {}
    if offset_s is not None:
        clocks["palm"] = ClockRelation(
            offset_s=offset_s, sigma_s=sigma_s, drift_sigma_ppm=40.0, source="motion"
        )
    reasons = {} if clocks else {"palm": "it repeats"}
    return MotionClocks(reference="torso", clocks=clocks, curves=curves, reasons=reasons)


def added(estimate: ClockEstimate, motion: MotionClocks, evidence: SoundEvidence = EMPTY, **stated_s: float):
    estimates = ClockEstimates(reference="torso", cameras=(REFERENCE, estimate))
    return add_motion(estimates, motion, evidence, stated_s).camera("palm")


def recordings(*frames: int) -> SoundEvidence:
    start = ContainerTime(first_frame_s=0.0, created_s=None, timecode_s=None, frame_s=0.03)
    return SoundEvidence(
        recordings=tuple(
            Recording(
                camera=name,
                sound_start_s=None,
                problem="",
                notes=(),
                recorder=None,
                start=start,
                end_s=count / 30,
                frames=count,
            )
            for name, count in zip(("torso", "palm"), frames, strict=True)
        )
    )


def test_the_motion_gives_a_clock_that_the_sound_does_not() -> None:
    found = added(NONE, moved(0.7))
    assert (found.source, found.offset_s, found.sigma_s) == ("motion", 0.7, 0.02)
    unknown = added(NONE, moved(None))
    assert unknown.source == "none"
    assert unknown.reasons == ("no sound", "motion: it repeats")


def test_the_sound_of_equal_cameras_is_kept() -> None:
    found = added(sound(0.7), moved(0.72))
    assert (found.source, found.offset_s, found.sigma_s) == ("sound", 0.7, 0.002)
    assert not found.is_contradicted


def test_the_sound_of_unlike_cameras_and_the_motion_give_their_mean() -> None:
    found = added(sound(0.7, 0.015), moved(0.72, 0.015))
    assert found.offset_s == pytest.approx(0.71)
    assert found.sigma_s == pytest.approx(0.015 / np.sqrt(2.0))


def test_sound_and_motion_that_disagree_are_reported() -> None:
    found = added(sound(0.7), moved(1.0))
    assert found.is_contradicted
    assert found.offset_s == 0.7
    assert "the motion gives an offset of 1.000" in found.notes[0]


@pytest.mark.parametrize(
    ("frames", "offset_s", "expected"),
    [((300, 300), 0.03, 0.0), ((300, 300), 0.08, 0.08), ((300, 290), 0.03, 0.03)],
)
def test_videos_with_equal_frame_counts_may_start_together(
    frames: tuple[int, int], offset_s: float, expected: float
) -> None:
    found = added(NONE, moved(offset_s), recordings(*frames))
    assert found.offset_s == pytest.approx(expected)
    if expected != offset_s:
        assert 0.0 < found.sigma_s < 0.02


def test_the_sound_of_two_limbs_completes_what_the_motion_gives_for_one() -> None:
    head = ClockEstimate(camera="head")
    pair = PairOffset(first="palm", second="head", accepted=True, pivot_s=4.0, offset_s=-1.5, sigma_s=0.001)
    estimates = ClockEstimates(reference="torso", cameras=(REFERENCE, NONE, head), pairs=(pair,))
    found = add_motion(estimates, moved(0.7), EMPTY).camera("head")
    # An event at 4.0 s of the head's clock is at 2.5 s of the palm's clock, which is 3.2 s of the torso's.
    assert found.offset_s == pytest.approx(3.2 - 4.0)
    assert found.source == "motion"
    assert found.sigma_s == pytest.approx(0.02, rel=0.02)


@pytest.mark.parametrize(("height", "first"), [(20.0, "torso"), (20.0, "palm"), (13.0, "torso")])
def test_a_stated_offset_is_compared_with_the_best_one(height: float, first: str) -> None:
    lags_s = np.arange(-2.0, 2.0, 0.04)
    sign = 1.0 if first == "torso" else -1.0
    # The score is 10 everywhere and higher at the right offset of 0.8 s.
    score = 10.0 + (height - 10.0) * np.exp(-0.5 * ((lags_s - sign * 0.8) / 0.1) ** 2)
    second = "palm" if first == "torso" else "torso"
    still = np.tile(np.eye(4), (30, 1, 1))
    path = CameraPath(camera=first, role="", times_ns=np.arange(30) * 33_000_000, map_from_cam=still)
    signals = motion_signals(path)
    assert signals is not None
    curve = MotionCurve(
        first=first, second=second, signals=(signals, signals), weights_hz=(), limb_lag_s=0.0,
        scores=MotionScore(lags_s, 0.0 * lags_s, score),
    )  # fmt: skip
    motion = moved(None, curves=(curve,))
    assert added(NONE, motion, palm=0.8).against_stated == ""
    wrong = added(NONE, motion, palm=-0.8).against_stated
    assert ("an offset of about 0.8 s fits much better" in wrong) is (height == 20.0)
