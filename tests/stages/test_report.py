"""The content of the report: figures, verdict, recommendations, causes of losses, and stopped jobs."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bodycap_batch.capture import Capture, CaptureCamera, open_capture
from bodycap_batch.config.models import CaptureConfig, Job
from bodycap_batch.core.errors import CaptureError
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.geometry import interpolate_pose
from bodycap_batch.model.merge_report import MergeReport
from bodycap_batch.model.optical_flow import BLUR_SHARPNESS_RATIO
from bodycap_batch.model.scene import FrameStatus, KeyframeSelection, Trajectory
from bodycap_batch.model.skeleton import MountSlip
from bodycap_batch.pipeline.job_facts import JobFacts
from bodycap_batch.pipeline.stage_results import StageResults, report_task
from bodycap_batch.report import ReportInputs
from bodycap_batch.report.advice import count_shared_points, recommend_changes
from bodycap_batch.report.drawn_scene import common_times_s, make_drawn_scene
from bodycap_batch.report.figures.before_after import find_unoptimised_bones
from bodycap_batch.report.figures.camera_timeline import draw_camera_timeline
from bodycap_batch.report.figures.time_axis import x_from_time
from bodycap_batch.report.frame_losses import (
    find_losses,
    likely_cause,
)
from bodycap_batch.report.frame_pictures import FrameAppearance, FramePicture
from bodycap_batch.report.grades import Advice, Criterion, Grade
from bodycap_batch.report.loss_causes import (
    CAUSES,
    DARK_BRIGHTNESS,
    FAST_DEG,
    PLAIN_RATIO,
    LossCause,
    LostSpan,
)
from bodycap_batch.report.metric_paths import metric_at
from bodycap_batch.report.metric_tables import headline_figures, make_tables
from bodycap_batch.report.packing import MISSING_CODE, PageBudget, pack_scaled
from bodycap_batch.report.verdict import judge
from bodycap_batch.report.viewer_data import make_viewer_data
from bodycap_batch.store.digests import FileDigests
from bodycap_batch.tasks.report import load_inputs
from tests.reports import report_inputs, written
from tests.videos import textured_frame, write_video


class PageParser(HTMLParser):
    """Collects the figures that name their path in metrics.json, and the links to other documents."""

    def __init__(self) -> None:
        super().__init__()
        self.figures: list[tuple[str, str]] = []
        self.external_links: list[str] = []
        self.tags: Counter[str] = Counter()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags[tag] += 1
        if "data-metric" in values:
            self.figures.append((values["data-metric"] or "", values["data-value"] or ""))
        for name in ("src", "href"):
            link = values.get(name) or ""
            if link and not link.startswith(("data:", "#")):
                self.external_links.append(link)


def parse(text: str) -> PageParser:
    page = PageParser()
    page.feed(text)
    return page


def advice(inputs: ReportInputs, lost: tuple[LostSpan, ...] = ()) -> list[Advice]:
    return recommend_changes(inputs, judge(inputs.metrics, inputs.failure, lost))


def lost_frames(camera: str, cause: LossCause, frames: int) -> LostSpan:
    return LostSpan(camera=camera, from_s=12.0, to_s=12.0 + frames / 10, frames=frames, cause=cause)


def with_merge(inputs: ReportInputs, **changed: Any) -> ReportInputs:
    """Return the inputs with other values of ``merge`` in the metrics."""
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["merge"] |= changed
    return replace(inputs, metrics=metrics)


def test_every_figure_is_that_of_the_metrics_and_nothing_is_loaded(
    inputs: ReportInputs, tmp_path: Path
) -> None:
    page = parse(written(inputs, tmp_path))
    assert len(page.figures) > 40
    assert inputs.metrics is not None
    for path, value in page.figures:
        assert float(value) == metric_at(inputs.metrics, path), path
    assert {"total.frames_registered", "merge.scale.relative_sigma"} <= {path for path, _ in page.figures}
    assert page.external_links == []


def test_the_same_results_give_the_same_bytes(inputs: ReportInputs, tmp_path: Path) -> None:
    assert written(inputs, tmp_path) == written(inputs, tmp_path)


def test_a_name_cannot_break_the_page(inputs: ReportInputs, tmp_path: Path) -> None:
    text = written(replace(inputs, name="</script><script>alert(1)</script>"), tmp_path)
    assert "<script>alert" not in text
    assert "a walk &lt;in&gt; the lab" in written(inputs, tmp_path)


@pytest.mark.parametrize(
    ("stage", "keeps"),
    [
        ("merge", {"maps", "registrations", "clocks", "selections", "metrics"}),
        ("map", {"selections"}),
        ("check", set()),
    ],
)
def test_a_stopped_job_has_a_page(inputs: ReportInputs, tmp_path: Path, stage: str, keeps: set[str]) -> None:
    failure = {"stage": stage, "type": "EstimationError", "message": "too little <parallax>", "hint": "walk"}
    kept = {name: getattr(inputs, name) for name in keeps}
    if "metrics" in kept:
        kept["metrics"] = {k: v for k, v in inputs.metrics.items() if k != "merge"}  # type: ignore[union-attr]
    text = written(ReportInputs(name="x", cameras=inputs.cameras, failure=failure, **kept), tmp_path)
    assert "too little &lt;parallax&gt;" in text
    assert 'class="badge none"' in text
    assert ('id="viewer-title"' in text) == (stage == "merge")
    assert 'class="badge good"' not in text or stage == "merge"


def test_the_verdict_takes_the_worst_of_its_criteria(inputs: ReportInputs) -> None:
    assert inputs.metrics is not None
    metrics = json.loads(json.dumps(inputs.metrics))
    verdict = judge(metrics, None)
    # 5 of 60 frames of a camera are lost, which is coverage, and the scale is known to 4.5 %.
    assert (verdict.cameras, verdict.body) == (Grade.GOOD, Grade.FAIR)
    assert verdict.coverage is not None
    assert verdict.coverage.share == metrics["total"]["coverage"] < 1.0
    metrics["total"]["mean_reprojection_error_px"] = 2.5
    assert judge(metrics, None).cameras is Grade.POOR
    metrics["merge"]["scale"]["relative_sigma"] = 0.2
    assert judge(metrics, None).body is Grade.POOR
    assert judge(None, {"message": "x"}).grade is Grade.NONE


def test_a_mirrored_camera_gets_the_advice_to_flip_its_video(inputs: ReportInputs, tmp_path: Path) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["mapping"]["mirrored_cameras"] = ["left_palm"]
    lost = (lost_frames("left_palm", LossCause.NO_MAP, 60),)
    assert any("see the same places" in each.action for each in advice(inputs, lost))
    first, *others = advice(replace(inputs, metrics=metrics), lost)
    assert first.action.startswith("Flip the video of left_palm back")
    assert not any("see the same places" in each.action for each in others)
    assert "Flip the video of left_palm back" in written(replace(inputs, metrics=metrics), tmp_path)


def test_cameras_that_see_mirror_images_get_the_advice_to_check_them(inputs: ReportInputs) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["mapping"]["mirror_images"] = [[["left_palm"], ["torso"]]]
    first, *_ = advice(replace(inputs, metrics=metrics))
    assert first.action.startswith("Check whether text reads backwards in the video of left_palm or torso")


def test_the_verdict_names_cameras_placed_by_the_body_alone_and_a_job_without_poses(
    inputs: ReportInputs,
) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["merge"]["joined_cameras"] = {"left_palm": {"sigma_deg": 2.0, "sigma_m": 0.01}}
    one_room = next(each for each in judge(metrics, None).criteria if each.name == "One room")
    assert one_room.grade is Grade.FAIR
    assert "left_palm" in one_room.finding
    for camera in metrics["cameras"].values():
        camera["frames_registered"] = 0
    verdict = judge(metrics, None)
    assert verdict.cameras is Grade.NONE
    assert verdict.headline.startswith("The cameras have no path")


def test_a_share_below_one_is_never_shown_as_100_percent(inputs: ReportInputs, tmp_path: Path) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    for entry in (metrics["total"], *metrics["cameras"].values()):
        entry["coverage"] = 0.9997
    metrics["mapping"]["reach"]["within_reach"] = 0.99999
    text = written(replace(inputs, metrics=metrics), tmp_path)
    assert "99.9 %" in text
    coverage = re.findall(r'data-metric="[^"]*coverage"[^>]*>([^<]*)<', text)
    assert len(coverage) == 5  # the first figures, and the table of three cameras and their sum
    assert not any("100.0" in each for each in coverage)


@pytest.mark.parametrize(
    ("factor", "grade", "says"), [(0.81, Grade.POOR, "19 % shorter"), (1.08, Grade.FAIR, "8 % longer")]
)
def test_a_lens_that_the_map_contradicts_is_not_graded_good(
    inputs: ReportInputs, tmp_path: Path, factor: float, grade: Grade, says: str
) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    assert not any("Lenses" in each.name for each in judge(metrics, None).criteria)
    metrics["mapping"]["misfitting_lenses"] = {"left_palm": factor, "torso": 1.0 + 0.9 * (factor - 1.0)}
    (lenses,) = (each for each in judge(metrics, None).criteria if "Lenses" in each.name)
    assert (lenses.grade, lenses.value) == (grade, pytest.approx(abs(factor - 1.0)))
    assert f"left_palm: the pictures fit a focal length {says}" in lenses.finding
    contradicted = replace(inputs, metrics=metrics)
    metrics["mapping"]["freed_lenses"] = ["left_palm", "torso"]
    (freed,) = (each for each in judge(metrics, None).criteria if "Lenses" in each.name)
    assert freed.grade is Grade.FAIR
    assert "the lens was estimated together with the map" in freed.finding
    # With a larger error the estimated lens does not fit either, as a pinhole for a wide lens does not.
    strained = json.loads(json.dumps(metrics))
    strained["total"]["mean_reprojection_error_px"] = 1.1
    (misfit,) = (each for each in judge(strained, None).criteria if "Lenses" in each.name)
    assert misfit.grade is grade
    assert "calibration: auto" in advice(contradicted)[0].how
    assert says in written(contradicted, tmp_path)


@pytest.mark.parametrize(
    ("doubt", "name", "action"),
    [
        (
            {"exchanged_sides": {"cameras": {"left_palm": 1.0}, "says": "0.5 s behind"}},
            "Left and right",
            "Exchange",
        ),
    ],
)
def test_contradictions_of_the_body_are_recommended_first(
    inputs: ReportInputs, tmp_path: Path, doubt: dict[str, Any], name: str, action: str
) -> None:
    assert inputs.merge is not None
    metrics = json.loads(json.dumps(inputs.metrics))
    assert not any(each.name == name for each in judge(metrics, None).criteria)
    metrics["merge"] |= doubt
    (found,) = (each for each in judge(metrics, None).criteria if each.name == name)
    assert (found.grade, found.finding) == (Grade.POOR, "0.5 s behind")
    contradicted = replace(inputs, metrics=metrics)
    assert action in advice(contradicted)[0].action
    assert "0.5 s behind" in written(contradicted, tmp_path)


def test_a_slip_is_in_the_timeline_of_its_camera(inputs: ReportInputs, tmp_path: Path) -> None:
    assert inputs.merge is not None
    assert "the mount slips" not in written(inputs, tmp_path)
    path = inputs.merge.trajectories[1]
    middle = int(path.times_ns[len(path.times_ns) // 2])
    slip = MountSlip(time_ns=middle, before_from_after=np.eye(4), sigma_rad=0.01, sigma_m=0.01)
    mounts = tuple(
        replace(mount, slip=slip if mount.camera == path.camera else None) for mount in inputs.merge.mounts
    )
    slipped = replace(inputs, merge=replace(inputs.merge, mounts=mounts))
    span = (1e-9 * float(path.times_ns[0]), 1e-9 * float(path.times_ns[-1]))
    drawn = draw_camera_timeline(slipped, path.camera, span, [], 0.0)
    x = float(x_from_time(1e-9 * middle, span))
    assert f'class="slip" d="M{x:.1f}'.removesuffix(".0") in drawn
    page = written(slipped, tmp_path)
    assert page.count('class="slip"') == 1
    assert '<span class="swatch slip"></span> the mount slips' in page


def test_an_unknown_clock_is_in_the_first_line_and_costs_coverage(
    inputs: ReportInputs, tmp_path: Path
) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    note = "the clock is unknown: the video has no sound"
    metrics["clocks"]["left_palm"] |= {"source": "none", "offset_s": None, "sigma_s": None}
    metrics["clock_notes"] = {"left_palm": [note]}
    verdict = judge(metrics, None)
    assert verdict.headline.startswith("The clock of left_palm is unknown, so the body is solved without it")
    failed = judge(metrics, {"stage": "merge", "message": "no two cameras determine the size"}).headline
    assert failed.startswith("The clock of left_palm is unknown: clap once")
    assert failed.endswith("the body could not be solved.")
    assert verdict.coverage is not None
    assert verdict.coverage.cameras["left_palm"].reason == note
    clocks = {**inputs.clocks, "left_palm": replace(inputs.clocks["left_palm"], source="none", notes=(note,))}
    unknown = replace(inputs, metrics=metrics, clocks=clocks, reference_camera="torso")
    assert "the video of the reference camera minus" in advice(unknown)[0].how
    page = written(unknown, tmp_path)
    assert "Clocks of the cameras" in page
    assert note in page


def test_readout_times_are_listed_with_their_sources(inputs: ReportInputs, tmp_path: Path) -> None:
    caption = "Rolling shutters of the cameras"
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["mapping"]["readouts_from_matches"] = {}
    metrics["mapping"]["rolling_shutter"] = [
        {"torso": {"seconds": 0.0, "sigma_s": 0.0, "source": "stated", "best_s": 0.0}}
    ]
    assert caption not in written(replace(inputs, metrics=metrics), tmp_path)
    reason = "not determined: the camera turns too evenly, or too little"
    metrics["mapping"]["readouts_from_matches"] = {
        "torso": {"seconds": 0.0, "sigma_s": 0.001, "source": "none found", "best_s": 0.0},
        "left_palm": {"seconds": 0.0, "sigma_s": None, "source": reason, "best_s": 0.0123},
    }
    metrics["mapping"]["rolling_shutter"] = [
        {"torso": {"seconds": 0.01202, "sigma_s": 0.00003, "source": "estimated", "best_s": 0.01202}}
    ]
    page = written(replace(inputs, metrics=metrics), tmp_path)
    assert caption in page
    assert "<code>rolling_shutter_s</code>" in page
    assert 'data-metric="mapping.rolling_shutter.0.torso.seconds" data-value="0.01202">12.02 ms' in page
    assert "0.03 ms" in page
    assert "estimated from the video" in page
    assert reason in page
    assert "12.30 ms" not in page, "a readout time that is not determined is not shown"


def test_sensors_are_listed_and_a_stabilised_video_is_named(inputs: ReportInputs, tmp_path: Path) -> None:
    assert "Inertial sensors" not in written(inputs, tmp_path)
    metrics = json.loads(json.dumps(inputs.metrics))
    reason = "the camera stabilised the video: the pictures show 8 % of the shaking"
    metrics["telemetry"] = {
        "torso": {
            "verdict": "stabilised",
            "reason": reason,
            "frames_filled": 0,
            "stabilisation": {"reason": "the pictures are used as they are"},
        },
        "left_palm": {
            "verdict": "agrees",
            "reason": "",
            "delay_s": 0.0081,
            "delay_sigma_s": 0.0002,
            "turned_deg": 2.06,
            "rate_ppm": 12.0,
            "frames_filled": 14,
        },
    }
    page = written(replace(inputs, metrics=metrics), tmp_path)
    assert "Inertial sensors" in page
    assert reason in page
    assert "torso: the pictures are used as they are." in page
    for text in ("+8.1 ms", "2.1°", "not used: the camera stabilised the video"):
        assert text in page


@pytest.mark.parametrize(("sigma_s", "grade"), [(0.002, Grade.GOOD), (0.025, Grade.FAIR), (0.06, Grade.POOR)])
def test_the_sigma_of_an_estimated_clock_is_graded(
    inputs: ReportInputs, sigma_s: float, grade: Grade
) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["clocks"]["left_palm"] |= {"source": "motion", "sigma_s": sigma_s}
    (clock,) = (each for each in judge(metrics, None).criteria if each.name == "One clock")
    assert (clock.grade, clock.value) == (grade, sigma_s)
    assert "from the motion" in clock.finding


def test_a_contradicted_clock_is_poor(inputs: ReportInputs) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["clock_notes"] = {"torso": ["the dates are wrong"], "left_palm": ["the sound gives 0.8 s"]}
    metrics["contradicted_clocks"] = ["left_palm"]
    (clock,) = (each for each in judge(metrics, None).criteria if each.name == "One clock")
    assert (clock.grade, clock.finding) == (Grade.POOR, "left_palm: the sound gives 0.8 s")


def test_cameras_that_start_late_or_end_early_get_the_advice_to_cut(inputs: ReportInputs) -> None:
    assert inputs.merge is not None
    assert not any("start_s" in each.how for each in advice(inputs))

    def without_poses(path: Trajectory, lost: slice) -> Trajectory:
        kept = path.localised.copy()
        kept[lost] = False
        return replace(
            path,
            gauge_from_cam=np.where(kept[:, None, None], path.gauge_from_cam, np.nan),
            covariance=np.where(kept[:, None, None], path.covariance, np.nan),
            status=tuple(
                status if good else FrameStatus.BLUR for status, good in zip(path.status, kept, strict=True)
            ),
        )

    torso, left, right = inputs.merge.trajectories
    paths = (torso, without_poses(left, slice(0, 30)), without_poses(right, slice(40, None)))
    (ends,) = (
        each
        for each in advice(replace(inputs, merge=replace(inputs.merge, trajectories=paths)))
        if "start_s" in each.how
    )
    start = inputs.merge.start_ns * 1e-9
    assert f"start_s: {start + 1.0:.2f} and end_s: {start + 39 / 30:.2f}" in ends.how
    assert f"{left.camera} has no measurement before" in ends.reason

    paths = (torso, without_poses(left, slice(0, 40)), without_poses(right, slice(20, None)))
    without_cut = advice(replace(inputs, merge=replace(inputs.merge, trajectories=paths)))
    (ends,) = (each for each in without_cut if "Start all cameras" in each.action)
    assert ends.how == ""  # no time remains between 1.33 and 0.63 s
    assert f"{right.camera} has no measurement after" in ends.reason


def test_a_camera_without_poses_uses_the_clock_of_the_capture(inputs: ReportInputs, tmp_path: Path) -> None:
    write_video(tmp_path / "torso.mp4", [textured_frame(index) for index in range(12)])
    lens = {"model": "PINHOLE", "params": [60.0, 60.0, 32.0, 24.0], "width": 64, "height": 48}
    camera = {"name": "torso", "video": [str(tmp_path / "torso.mp4")], "calibration": lens}
    opened = open_capture(CaptureConfig.model_validate({"cameras": [camera]}))
    capture = Capture(cameras=(replace(opened.cameras[0], clock=ClockRelation(offset_s=2.5)),))
    stopped = ReportInputs(name="x", cameras=("torso",), capture=capture, failure={"stage": "map"})
    times = common_times_s(stopped, "torso", capture.camera("torso").times_ns)
    np.testing.assert_allclose(times, capture.camera("torso").common_times_ns() * 1e-9)
    assert times[0] == pytest.approx(2.5)


@pytest.mark.parametrize("is_masked", [True, False])
def test_the_legend_explains_shaded_pictures_only_if_there_are_some(
    inputs: ReportInputs, tmp_path: Path, *, is_masked: bool
) -> None:
    write_video(tmp_path / "torso.mp4", [textured_frame(index % 12) for index in range(60)])
    lens = {"model": "PINHOLE", "params": [60.0, 60.0, 32.0, 24.0], "width": 64, "height": 48}
    camera = {"name": "torso", "video": [str(tmp_path / "torso.mp4")], "calibration": lens}
    (opened,) = open_capture(CaptureConfig.model_validate({"cameras": [camera]})).cameras
    mask = np.arange(64)[None, :] < np.full((48, 1), 32) if is_masked else None
    kept = {name: getattr(inputs, name) for name in ("maps", "registrations", "clocks")}
    capture = Capture(cameras=tuple(replace(opened, name=name, mask=mask) for name in inputs.cameras))
    text = written(ReportInputs(name="x", cameras=inputs.cameras, capture=capture, **kept), tmp_path)
    assert ("moving by itself" in text) is is_masked


def test_a_doubt_has_advice_and_is_not_called_good(inputs: ReportInputs, tmp_path: Path) -> None:
    camera = {"coverage": 1.0, "frames": 300, "frames_registered": 300, "frame": "map-0", "keyframes": 90}
    metrics = {
        "frame": "map-0",
        "total": {**camera, "mean_reprojection_error_px": 0.4},
        "cameras": {name: dict(camera) for name in inputs.cameras},
        "mapping": {"misplaced_keyframes": {"torso": list(range(30, 45))}},
        "models": [],
    }
    text = written(ReportInputs(name="x", cameras=inputs.cameras, metrics=metrics), tmp_path)
    assert "15 keyframes" in text
    assert "posters" in text
    assert "every measured criterion is good" not in text


def test_every_link_of_the_page_has_a_target(inputs: ReportInputs, tmp_path: Path) -> None:
    kept = {name: getattr(inputs, name) for name in ("cameras", "maps", "registrations", "clocks")}
    failure = {"stage": "merge", "type": "EstimationError", "message": "stopped", "hint": ""}
    for each in (inputs, ReportInputs(name="x", failure=failure, **kept), ReportInputs(name="x")):
        text = written(each, tmp_path)
        links, sections = (
            set(re.findall(r'href="#([\w-]+)"', text)),
            set(re.findall(r'<h2 id="([\w-]+)"', text)),
        )
        assert links <= sections | {"main"}
        assert sections - links <= {"verdict", "about"}


PAIR = {"cameras": ["torso", "torso_back"], "instants": 130, "rigid": False, "explained_deg": 1.0}


def criteria_on_one_bone(inputs: ReportInputs, *pairs: dict[str, Any], **merge: Any) -> list[Criterion]:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["relative_poses"] = pairs
    metrics["merge"] |= merge
    return [each for each in judge(metrics, None).criteria if each.name == "Cameras on one bone"]


@pytest.mark.parametrize(("spread_deg", "grade"), [(0.3, Grade.GOOD), (4.8, Grade.FAIR), (15.0, Grade.POOR)])
def test_relative_rotation_of_cameras_on_one_bone_is_graded(
    inputs: ReportInputs, spread_deg: float, grade: Grade
) -> None:
    without_instants = {
        **PAIR,
        "cameras": ["torso", "torso_2"],
        "instants": 0,
        "spread_deg": None,
        "explained_deg": None,
    }
    (found,) = criteria_on_one_bone(inputs, without_instants, {**PAIR, "spread_deg": spread_deg})
    assert found.grade is grade
    assert "torso and torso_back" in found.finding
    assert not criteria_on_one_bone(inputs, without_instants)


def test_weak_evidence_about_cameras_on_one_bone_is_ignored(inputs: ReportInputs) -> None:
    loose = {**PAIR, "spread_deg": 15.0}
    assert not criteria_on_one_bone(inputs, {**loose, "instants": 29})
    assert not criteria_on_one_bone(inputs, loose, unused_cameras={"torso_back": "no link"})
    noisy = {**PAIR, "spread_deg": 8.1, "explained_deg": 8.0}
    assert [each.grade for each in criteria_on_one_bone(inputs, noisy)] == [Grade.GOOD]
    in_step = {**PAIR, "spread_deg": 10.0, "explained_deg": 8.0, "rigid": True}
    assert [each.grade for each in criteria_on_one_bone(inputs, in_step)] == [Grade.GOOD]
    # The two ends of a forearm turn relative to each other; a loose camera on another bone is worse.
    arm = {**loose, "cameras": ["left_palm", "left_wrist"], "spread_deg": 30.0}
    mounts = {**inputs.metrics["merge"]["mounts"]}
    mounts["left_palm"] = {**mounts["left_palm"], "role": "LeftForeArm"}
    assert [each.grade for each in criteria_on_one_bone(inputs, arm, mounts=mounts)] == [Grade.FAIR]
    (worst,) = criteria_on_one_bone(inputs, arm, loose, mounts=mounts)
    assert worst.grade is Grade.POOR
    assert "torso_back" in worst.finding


def test_a_lens_with_a_wrong_principal_point_is_never_graded_good(inputs: ReportInputs) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["mapping"]["misfitting_lenses"] = {"torso": 1.0}
    (found,) = [each for each in judge(metrics, None).criteria if each.name.startswith("Lenses")]
    assert found.grade is Grade.FAIR
    assert "another lens" in found.finding
    reasons = [each.reason for each in advice(replace(inputs, metrics=metrics)) if "calibration" in each.how]
    assert reasons == ["torso: the pictures fit another lens than the calibration says"]


def test_distances_beyond_the_reach_at_any_scale_are_graded_poor(inputs: ReportInputs) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["mapping"]["reach"] = {
        "judged": False,
        "distances": 120,
        "within_reach": 0.62,
        "keyframes_out_of_reach": 0,
        "reason": "for no scale, 80 % of the distances between cameras are possible on one body",
    }
    (found,) = [each for each in judge(metrics, None).criteria if each.name == "Distances between cameras"]
    assert found.grade is Grade.POOR
    assert found.finding.startswith("62")
    assert "are wrong" in found.finding
    # If a camera is not part of the body, the finding names it as the reason.
    metrics["merge"]["unused_cameras"] = {"left_palm": "it lies on a table"}
    (found,) = [each for each in judge(metrics, None).criteria if each.name == "Distances between cameras"]
    assert found.grade is Grade.FAIR
    assert "left_palm" in found.finding
    assert "are wrong" not in found.finding


@pytest.mark.parametrize("reach", [None, {"judged": False, "reason": "3 distances are too few"}])
def test_a_map_without_distance_check_has_no_criterion_about_reach(
    inputs: ReportInputs, reach: dict[str, Any] | None
) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["mapping"]["reach"] = reach
    assert not [each for each in judge(metrics, None).criteria if each.name == "Distances between cameras"]


def test_a_camera_that_ended_early_costs_coverage_of_the_body(inputs: ReportInputs) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    before = judge(metrics, None)
    assert before.coverage is not None
    assert before.coverage.body is not None
    metrics["motion"]["joints"]["LeftHand"]["observed_share"] = 0.6
    verdict = judge(metrics, None)
    assert verdict.coverage is not None
    assert verdict.coverage.body is not None
    assert verdict.coverage.body.joints["LeftHand"] == 0.6
    assert verdict.coverage.body.share < before.coverage.body.share
    assert verdict.body is before.body


def test_figures_of_cameras_and_joints_with_a_dot_in_their_name(inputs: ReportInputs) -> None:
    metrics = json.loads(
        json.dumps(inputs.metrics).replace('"left_palm"', '"left.palm"').replace('"LeftHand"', '"Left.Hand"')
    )
    metrics["motion"]["joints"]["Left.Hand"]["observed_share"] = 0.6
    metrics["cameras"]["left.palm"]["coverage"] = 0.3
    metrics["merge"]["mounts"]["left.palm"]["sigma_deg"] = 40.0
    metrics["merge"]["cameras"]["left.palm"]["longest_gap_s"] = 99.0
    metrics["mapping"]["misfitting_lenses"] = {"left.palm": 1.2}
    found = {each.metric: each.value for each in judge(metrics, None).criteria if each.metric}
    assert {
        r"merge.mounts.left\.palm.sigma_deg": 40.0,
    }.items() <= found.items()
    tables = make_tables(replace(inputs, metrics=metrics)).values()
    cells = [cell for table in tables for row in table.rows for cell in row if cell.metric]
    assert sum(r"left\.palm" in cell.metric for cell in cells) > 10
    found |= {cell.metric: cell.value for cell in (*cells, *(cell for _, cell in headline_figures(metrics)))}
    assert {path: metric_at(metrics, path) for path in found} == found


def test_the_page_shows_scale_hinges_soft_limits_and_joined_maps(
    inputs: ReportInputs, tmp_path: Path
) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    metrics["merge"]["joined_cameras"] = {"left_palm": {"sigma_deg": 2.0, "sigma_m": 0.013}}
    text = written(replace(inputs, metrics=metrics), tmp_path)
    shown = {name for name, _ in parse(text).figures}
    assert {
        "merge.scale.sources.0.off",
        "merge.hinge_off_plane_m.LeftForeArm.p95",
        "merge.activity.rules_pressed_m.Left palm below the shoulder.p95",
        "merge.joined_cameras.left_palm.sigma_m",
        "merge.mounts.left_palm.roll_deg",
    } <= shown
    for says in (
        "Left palm must stay below the shoulder",
        "7.10 mm",
        "4.3 cm",
        "± 1.3 cm",
        "-1.2 %",
        "90°",
    ):
        assert says in text


@pytest.mark.parametrize(("max_gap_s", "bridged"), [(0.21, True), (0.19, False)])
def test_a_gap_is_bridged_up_to_the_limit_of_the_job(
    inputs: ReportInputs, tmp_path: Path, max_gap_s: float, bridged: bool
) -> None:
    # Five frames at 30 fps are lost: 0.2 s from the measurement before to the one after.
    text = written(replace(inputs, max_gap_s=max_gap_s), tmp_path)
    assert ("5 frames lost: BLUR, bridged" in text) == bridged
    assert ("<title>5 frames lost: BLUR</title>" in text) != bridged


def test_the_report_gets_the_limit_of_the_job(tmp_path: Path) -> None:
    camera = {"name": "torso", "video": ["torso.mp4"]}
    job = Job.model_validate({"capture": {"cameras": [camera]}, "merge": {"max_gap_s": 0.4}})
    results = StageResults(facts=JobFacts.of(job))
    task = report_task(results, FileDigests(tmp_path), CaptureError("no video"))
    assert load_inputs(task).max_gap_s == 0.4


def test_a_camera_timeline_of_any_length_stays_small(inputs: ReportInputs) -> None:
    # Every second frame is lost. Drawn one by one, the lost intervals alone would take 2 MB.
    count = 20_000
    statuses = (FrameStatus.KEYFRAME, FrameStatus.BLUR) * (count // 2)
    found = inputs.registrations[0]
    kept = np.tile([True, False], count // 2)
    path = replace(
        found.trajectory,
        times_ns=np.arange(count) * 33_333_333,
        frame_numbers=np.arange(count),
        gauge_from_cam=np.where(kept[:, None, None], np.eye(4), np.nan),
        covariance=np.where(kept[:, None, None], np.eye(6), np.nan),
        status=statuses,
        inliers=np.full(count, 50),
        error_px=np.where(kept, 0.5, np.nan),
    )
    long = replace(inputs, registrations=(replace(found, trajectory=path),), merge=None, selections=())
    losses = find_losses(long)
    assert len(losses) == count // 2
    drawn = draw_camera_timeline(long, path.camera, (0.0, count / 30.0), losses, 0.0)
    assert len(drawn) < 150_000
    assert f"{count // 2} frames lost: BLUR" in drawn


def test_the_sharpness_of_a_camera_without_a_trajectory_is_drawn_at_its_own_times(
    inputs: ReportInputs,
) -> None:
    path = inputs.registrations[0].trajectory
    camera = CaptureCamera(
        name=path.camera,
        chapters=(),
        camera=inputs.maps[0].cameras[path.camera],
        calibrated=True,
        frame_numbers=path.frame_numbers,
        times_ns=path.times_ns,
        nominal_fps=30.0,
        clock=ClockRelation(offset_s=0.5),
        rolling_shutter_s=0.0,
    )
    times = camera.common_times_ns() * 1e-9
    count = len(times)
    selection = KeyframeSelection(
        camera=path.camera,
        frames=np.zeros(1, np.int64),
        frame_count=count,
        sharpness=np.ones(count),
        noise_px=0.1,
    )
    lost = ReportInputs(
        name="lost", cameras=(path.camera,), selections=(selection,), capture=Capture(cameras=(camera,))
    )
    # The camera ran in the first quarter of the time axis only.
    span = (float(times[0]), float(times[0] + 4.0 * (times[-1] - times[0])))
    drawn = draw_camera_timeline(lost, camera.name, span, [], 0.0)
    x = [float(value) for value in re.findall(r"[ML]([\d.]+)", drawn)]
    assert x
    assert max(x) < x_from_time(span[0] + 0.3 * (span[1] - span[0]), span)


def test_the_causes_of_losses_are_explained_with_the_limits_that_are_used() -> None:
    assert f"{FAST_DEG:.0f}°" in CAUSES[LossCause.FAST][0]
    assert f"below {DARK_BRIGHTNESS:.0f} of 255" in CAUSES[LossCause.DARK][0]
    assert f"{PLAIN_RATIO:.0%}".replace("%", " %") in CAUSES[LossCause.PLAIN][0]
    assert f"{BLUR_SHARPNESS_RATIO:.0%}".replace("%", " %") in CAUSES[LossCause.BLUR][0]


def test_unoptimised_bones_of_a_camera_half_a_frame_late_are_the_same(inputs: ReportInputs) -> None:
    assert inputs.merge is not None

    def half_a_frame_later(path: Trajectory) -> Trajectory:
        poses = path.gauge_from_cam
        kept = path.localised[:-1] & path.localised[1:]
        between = np.full_like(poses[:-1], np.nan)
        between[kept] = interpolate_pose(poses[:-1][kept], poses[1:][kept], 0.5)
        return replace(
            path,
            gauge_from_cam=np.concatenate([between, poses[-1:]]),
            times_ns=path.times_ns + np.append(np.full(len(between), 16_666_667), 0),
            covariance=np.where(np.append(kept, True)[:, None, None], np.eye(6) * 1e-4, np.nan),
            status=tuple(
                status if good else FrameStatus.BLUR
                for status, good in zip(path.status, [*kept, True], strict=True)
            ),
        )

    merge = replace(
        inputs.merge, trajectories=tuple(half_a_frame_later(path) for path in inputs.merge.trajectories)
    )
    poses = merge.motion.world_from_joint()
    for usual, shifted in zip(
        find_unoptimised_bones(inputs), find_unoptimised_bones(replace(inputs, merge=merge)), strict=True
    ):
        # There are 5 mm of noise and slack; half a frame of walking at 1.1 m/s would add 18 mm.
        medians = [np.median(bone.distance_m(poses)) for bone in (shifted, usual)]
        assert abs(medians[0] - medians[1]) < 0.004


def test_a_camera_with_poses_outside_the_motion_does_not_break_the_page(
    inputs: ReportInputs, tmp_path: Path
) -> None:
    clocks = {name: replace(clock, offset_s=1000.0) for name, clock in inputs.clocks.items()}
    text = written(replace(inputs, clocks=clocks), tmp_path)
    assert "Before and after" not in text


def test_losses_are_found_with_measurements_next_to_them(inputs: ReportInputs) -> None:
    losses = find_losses(inputs)
    assert len(losses) == 3
    for loss in losses:
        assert (loss.first, loss.last, loss.frames) == (20, 24, 5)
        assert loss.reason is FrameStatus.BLUR
        # The sharpness is 3 to 4 in lost frames and 10 to 11 in the others.
        assert 0.27 < loss.sharpness < 0.4


def test_likely_causes_follow_the_measurements(inputs: ReportInputs) -> None:
    loss = find_losses(inputs)[0]

    def appearance(grey: float, corners: int) -> FrameAppearance:
        return FrameAppearance(
            picture=FramePicture(index=22, jpeg="", width=1, height=1), brightness=grey, corners=corners
        )

    calm = replace(loss, turn_deg=1.0)
    tracks = replace(calm, reason=FrameStatus.FEW_TRACKS, sharpness=1.0)
    assert likely_cause(calm, appearance(10.0, 100), 100.0) is LossCause.DARK
    assert likely_cause(replace(loss, turn_deg=20.0), appearance(90.0, 100), 100.0) is LossCause.FAST
    assert likely_cause(calm, appearance(90.0, 100), 100.0) is LossCause.BLUR
    assert likely_cause(tracks, appearance(90.0, 10), 100.0) is LossCause.PLAIN
    assert likely_cause(tracks, appearance(90.0, 90), 100.0) is LossCause.UNKNOWN_PLACE
    assert likely_cause(replace(tracks, sharpness=0.4), None, None) is LossCause.BLUR
    repeated = replace(loss, turn_deg=20.0, reason=FrameStatus.FROZEN)
    assert likely_cause(repeated, appearance(10.0, 10), 100.0) is LossCause.FROZEN


def test_recommendations_follow_from_measurements(inputs: ReportInputs) -> None:
    recommendations = advice(inputs, (lost_frames("torso", LossCause.PLAIN, 30),))
    assert "posters" in recommendations[0].action
    assert "bare ceilings" in recommendations[0].action
    assert "30 of torso, at 0:12 to 0:15" in recommendations[0].reason
    few = advice(inputs, (lost_frames("torso", LossCause.PLAIN, 1),))
    assert not any("posters" in each.action for each in few)
    assert any("skeleton" in each.how for each in recommendations)


@pytest.mark.parametrize(
    ("source", "is_recommended"),
    [("height", True), ("skeleton", False)],
)
def test_a_given_skeleton_is_not_recommended_again(
    inputs: ReportInputs, source: str, is_recommended: bool
) -> None:
    assert inputs.merge is not None
    scale = {
        "source": f"{source} and floor",
        "relative_sigma": 0.03,
        "sources": [{"name": source, "used": True}, {"name": "floor", "used": True}],
    }
    changed = with_merge(inputs, scale=scale)
    (found,) = [each for each in advice(changed) if "sizes" in each.reason]
    assert ("--skeleton" in found.how) is is_recommended
    assert found.reason == "sizes are known to about ± 5 cm of body height (3.0 %)"
    assert "board of printed squares" in found.action


def test_at_most_three_changes_are_recommended(inputs: ReportInputs, tmp_path: Path) -> None:
    causes = (LossCause.DARK, LossCause.FAST, LossCause.BLUR, LossCause.PLAIN, LossCause.SHALLOW)
    found = advice(inputs, tuple(lost_frames("torso", cause, 30) for cause in causes))
    assert len(found) == 3
    assert "`" not in "".join(each.action + each.reason for each in found)


def test_an_elbow_that_violates_its_hinge_model_gets_a_recommendation(inputs: ReportInputs) -> None:
    assert inputs.merge is not None
    loose = {
        "LeftForeArm": {
            "sigma_m": 0.021,
            "known_to": "the left elbow moves 2.1 cm out of its bending plane; to reduce this, strap it",
        }
    }
    changed = replace(
        inputs, merge=replace(inputs.merge, report=MergeReport.from_dict({"loose_hinges": loose}))
    )
    (found,) = (each for each in advice(changed) if "left elbow" in each.reason)
    assert (found.action, found.reason) == (
        "Strap it.",
        "the left elbow moves 2.1 cm out of its bending plane",
    )


def test_a_t_pose_that_improves_several_constants_is_recommended_once(inputs: ReportInputs) -> None:
    text = "uncertainty 11°; to reduce this, swing the elbow, or stand in a T-pose for two seconds first"
    mounts = {"left_palm": {"role": "LeftHand", "known_to": text, "sigma_deg": 11.0, "sigma_m": 0.02}}

    def recommended_actions(sigma: float) -> list[str]:
        scale = {"relative_sigma": sigma, "sources": [{"name": "mean stature", "used": True}]}
        found = advice(with_merge(inputs, mounts=mounts, scale=scale, t_pose=None))
        return [each.action for each in found if "T-pose" in each.action or "elbow" in each.action]

    (single,) = recommended_actions(0.01)
    assert "elbow, or stand in a T-pose" in single
    first, *others = recommended_actions(0.05)
    assert first.startswith("Stand still for two seconds")
    assert others == ["At the start of the take, swing the elbow."]


def test_shared_points_count_what_both_cameras_see(inputs: ReportInputs) -> None:
    counts = count_shared_points(inputs.maps, inputs.cameras)
    scene = inputs.maps[0]
    for index, name in enumerate(inputs.cameras):
        of_camera = np.isin(scene.obs_keyframe, scene.keyframes_of(name))
        assert counts[index, index] == len(np.unique(scene.obs_point[of_camera]))
    assert (counts == counts.T).all()


def test_packed_numbers_are_restored_within_a_step() -> None:
    values = np.array([[0.0, -3.0], [20.0, np.nan], [7.3, 5.0]])
    packed = pack_scaled(values)
    codes = np.frombuffer(base64.b64decode(packed["u16"]), "<u2").reshape(3, 2)
    back = np.where(codes == MISSING_CODE, np.nan, packed["low"] + codes * np.array(packed["step"]))
    np.testing.assert_allclose(back, values, atol=0.51 * max(packed["step"]))


def test_known_joint_uncertainty_is_shown(inputs: ReportInputs, tmp_path: Path) -> None:
    assert inputs.merge is not None
    data = make_viewer_data(inputs, make_drawn_scene(inputs), PageBudget())["body"]
    codes = np.frombuffer(base64.b64decode(data["sigma"]["u16"]), "<u2").reshape(data["sigma"]["shape"])
    assert ((codes != MISSING_CODE) == inputs.merge.solved).all()
    # The root of the mean of the variances 1, 2 and 3 cm2.
    assert data["sigma"]["low"][int(np.argmax(inputs.merge.solved))] == pytest.approx(np.sqrt(2e-4))
    assert "1.4 cm" in written(inputs, tmp_path)
    unknown = replace(inputs, merge=replace(inputs.merge, joint_covariance_m2=None))
    assert make_viewer_data(unknown, make_drawn_scene(unknown), PageBudget())["body"]["sigma"] is None


def test_the_page_says_how_well_the_elbows_are_known(inputs: ReportInputs, tmp_path: Path) -> None:
    metrics = json.loads(json.dumps(inputs.metrics))
    known = {"observed": {"p50": 22.6, "p95": 27.0}, "filled": {"p50": 31.2, "p95": 40.0}}
    metrics["merge"]["flexion_sigma_deg"] = {"LeftForeArm": known}
    text = written(replace(inputs, metrics=metrics), tmp_path)
    assert "bending angle of elbows" in text
    table = text[text.index("bending angle of elbows") :]
    assert "left elbow" in table
    assert "± 23°" in table
    assert "± 31°" in table


def test_the_page_leads_with_the_verdict_and_links_the_files(inputs: ReportInputs, tmp_path: Path) -> None:
    text = written(replace(inputs, files=("motion.bvh", "metrics.json")), tmp_path)
    places = [
        text.index(f'id="{name}"')
        for name in ("verdict", "missing", "person", "viewer-title", "motion", "files")
    ]
    assert places == sorted(places)
    assert "No camera measured: head, pelvis, left leg, right leg." in text
    assert "without a camera on the hips, the trunk is one block" in text
    assert '<a href="motion.bvh">' in text
    assert 'class="strip motion"' in text
    without = written(ReportInputs(name="x"), tmp_path)
    assert 'id="missing"' not in without
    assert 'id="person"' not in without
    assert 'id="files"' not in without


def test_the_verdict_shows_when_frames_are_lost_and_why(inputs: ReportInputs, tmp_path: Path) -> None:
    """Frames 20 to 24 of each camera are blurred; the clock begins at 5 s, with 30 frames a second."""
    text = written(inputs, tmp_path)
    block = text[text.index('id="missing"') : text.index("What is not good")]
    assert block.count('<span class="share">91.7 %</span>') == len(inputs.cameras)
    assert block.count("0:05.7 to 0:05.8</span> <strong>motion blur</strong>") == len(inputs.cameras)
    assert block.count(", 5 frames</span>") == len(inputs.cameras)
    assert "not listed" not in block
    for bar in re.findall(r"<svg.*?</svg>", block):
        (place,) = re.findall(r'<rect class="(?:lost|bridged)" x="([\d.]+)"', bar)
        (width,) = re.findall(r'data-width="([\d.]+)"', bar)
        # The bars are shifted by the left margin of the timelines below, 92 units.
        assert (float(place) - 92.0) / float(width) == pytest.approx(20 / 59, abs=1e-3)


def test_only_some_lost_intervals_are_listed_below_the_verdict(tmp_path: Path) -> None:
    text = written(report_inputs(lost=slice(9, None, 10)), tmp_path)  # six intervals of each of three cameras
    block = text[text.index('id="missing"') : text.index("What is not good")]
    assert block.count('class="time"') == 6
    assert "12 other intervals are not listed." in block


def test_a_capture_without_losses_has_no_list_of_them(tmp_path: Path) -> None:
    assert 'id="missing"' not in written(report_inputs(lost=slice(0, 0)), tmp_path)
