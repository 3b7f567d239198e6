"""Selection of the reference camera, the main map and the timeline, and isolation of bad maps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging import merge_trajectories
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.calibrate_body import preliminary_vertical
from bodycap_batch.merging.body_calibration.calibration_covariance import PoseSigma
from bodycap_batch.merging.body_calibration.samples import MAP_ERROR_RAD, take_samples
from bodycap_batch.merging.cameras.excluded_cameras import excluded_cameras, rarely_localised
from bodycap_batch.merging.cameras.track import MIN_SIGMA_RAD, make_track
from bodycap_batch.merging.main_map import align_usable_cameras, candidate_main_maps
from bodycap_batch.merging.map_alignment import align, similarity_refinement
from bodycap_batch.merging.map_alignment.align import AlignedMap, align_cameras
from bodycap_batch.merging.rig_priors import correlate_mount_priors
from bodycap_batch.merging.stage import timeline
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.model.scene import FrameStatus
from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import posed
from tests.stages.walker import NOISE_M, NOISE_RAD, ROLES, make_inputs, make_walk, record

CAMERAS = ("torso", "head", "left_palm", "right_palm", "left_upper_arm")


def _candidates(inputs):
    return candidate_main_maps(inputs, excluded_cameras(inputs))


def _aligned(inputs):
    return align_usable_cameras(inputs, lambda: None, MergeOptions(), excluded_cameras(inputs))


def _correlated(inputs):
    return correlate_mount_priors(inputs, excluded_cameras(inputs))


@pytest.fixture(scope="module")
def capture():
    return posed(SynthOptions(seconds=6.0, cameras=CAMERAS, seed=2, poses_only=True))


@pytest.fixture
def walked():
    rng = np.random.default_rng(0)
    walk = make_walk(rng)
    return make_inputs(walk, [record(walk, name, rng) for name in ROLES])


def _lose(inputs, camera, kept):
    """Return the inputs with all but the first `kept` localised frames of a camera lost."""
    changed = []
    for each in inputs.trajectories:
        if each.camera == camera:
            poses, covariance = np.array(each.gauge_from_cam), np.array(each.covariance)
            last = int(np.flatnonzero(each.localised)[kept])
            poses[last:], covariance[last:] = np.nan, np.nan
            status = (*each.status[:last], *[FrameStatus.FEW_TRACKS] * (len(poses) - last))
            each = replace(each, gauge_from_cam=poses, covariance=covariance, status=status)  # noqa: PLW2901
        changed.append(each)
    return replace(inputs, trajectories=tuple(changed))


def _in_maps(inputs, maps):
    return replace(
        inputs,
        trajectories=tuple(
            replace(each, gauge=maps.get(each.camera, each.gauge)) for each in inputs.trajectories
        ),
    )


def _names(trajectories):
    return [each.camera for each in trajectories]


def test_the_reference_camera_is_on_the_trunk_or_else_on_the_head(capture):
    assert _names(_candidates(capture.inputs)[0][0])[:2] == ["torso", "head"]
    lost = _lose(capture.inputs, "torso", 6)
    assert _names(_candidates(lost)[0][0])[0] == "head"
    assert rarely_localised(lost.trajectories) == {
        "torso": f"only 6 of {6 * 30} frames were localised, but 15 are needed"
    }


def _noise(rng, count, sigma_rad=NOISE_RAD, sigma_m=NOISE_M):
    """Return random errors (N,4,4) of poses with these sigmas per axis."""
    return make_transform(
        so3_exp(rng.normal(scale=sigma_rad, size=(count, 3))), rng.normal(scale=sigma_m, size=(count, 3))
    )


def _with_palm(inputs, moved):
    """Return the inputs with a path (N,4,4) of the left palm made from its own; NaN: not localised."""
    changed = []
    for each in inputs.trajectories:
        if each.camera == "left_palm":
            path = moved(np.array(each.gauge_from_cam))
            lost = ~np.isfinite(path).all(axis=(1, 2))
            covariance = np.where(
                lost[:, None, None], np.nan, np.diag(np.repeat([NOISE_RAD, NOISE_M], 3) ** 2)
            )
            status = tuple(FrameStatus.FEW_TRACKS if no else FrameStatus.REGISTERED for no in lost)
            each = replace(each, gauge_from_cam=path, covariance=covariance, status=status)  # noqa: PLW2901
        changed.append(each)
    return replace(inputs, trajectories=tuple(changed))


def _lying(poses):
    """Return the first pose for every frame, with the noise of registration."""
    first = poses[np.isfinite(poses).all(axis=(1, 2))][0]
    return np.asarray(first @ _noise(np.random.default_rng(7), len(poses)))


def test_a_stationary_camera_is_excluded(capture):
    lying = _with_palm(capture.inputs, _lying)
    assert list(excluded_cameras(lying)) == ["left_palm"]
    together = _aligned(lying)
    assert "left_palm" not in _names(together.trajectories)
    assert "stands still" in together.unused["left_palm"]


def test_a_camera_with_an_unknown_clock_is_excluded_with_the_reason(capture):
    why = "the clock is unknown: the video has no sound"
    clocks = dict(capture.inputs.clocks)
    clocks["left_palm"] = replace(clocks["left_palm"], source="none", notes=(why,))
    assert excluded_cameras(replace(capture.inputs, clocks=clocks)) == {"left_palm": why}


@pytest.mark.parametrize(
    "sway", ["metres", "slowly turned", "waved"], ids=["sways", "turns slowly", "waves on the spot"]
)
def test_a_camera_on_the_body_is_kept_even_if_it_moves_little(capture, sway):
    def moved(poses):
        out, phase = _lying(poses), np.arange(len(poses)) / 30.0
        if sway == "metres":
            out[:, :3, 3] += 0.05 * np.sin(phase)[:, None]
            return out
        # A wave at 2 Hz is over in each window: only single frames show it.
        deg, turns_s = (1.5, 0.2) if sway == "slowly turned" else (4.0, 2.0)
        angle = np.radians(deg) * np.sin(2.0 * np.pi * turns_s * phase)
        return out @ make_transform(so3_exp(np.outer(angle, [0.0, 1.0, 0.0])), np.zeros((len(out), 3)))

    assert excluded_cameras(_with_palm(capture.inputs, moved)) == excluded_cameras(capture.inputs) == {}


def test_a_camera_localised_only_while_the_person_stood_is_kept(capture):
    def seen_first(poses):
        out, phase = np.repeat(poses[:1], len(poses), axis=0), np.arange(len(poses)) / 30.0
        out[:, :3, 3] += 0.005 * np.sin(2.0 * phase)[:, None] * np.array([1.0, 0.0, 0.0])
        out[30:] = np.nan
        return out

    assert excluded_cameras(_with_palm(capture.inputs, seen_first)) == {}


def test_a_camera_lost_when_the_person_started_to_walk_is_kept(capture):
    ready, rng = 110, np.random.default_rng(9)

    def standing_first(each):
        path = np.array(each.gauge_from_cam)
        seen = np.flatnonzero(each.localised)
        early = seen[seen < ready]
        path[early] = path[seen[0]] @ _noise(rng, len(early))
        return replace(each, gauge_from_cam=path)

    def lost_then(poses):
        poses[ready:] = np.nan
        return poses

    whole = _with_palm(capture.inputs, lambda poses: poses)
    stood = replace(whole, trajectories=tuple(standing_first(each) for each in whole.trajectories))
    assert excluded_cameras(_with_palm(stood, lost_then)) == {}


def test_cameras_that_all_stand_still_are_kept(capture):
    """Stationary cameras are excluded only if another camera moves. Here there is noise alone."""
    count, rng = 90, np.random.default_rng(8)
    still = []
    for each in capture.inputs.trajectories:
        first = each.gauge_from_cam[np.flatnonzero(each.localised)[0]]
        path, frames = first @ _noise(rng, count), slice(0, count)
        still.append(
            replace(
                each,
                frame_numbers=each.frame_numbers[frames],
                times_ns=each.times_ns[frames],
                gauge_from_cam=path,
                covariance=np.tile(np.diag(np.repeat([NOISE_RAD, NOISE_M], 3) ** 2), (count, 1, 1)),
                status=(FrameStatus.REGISTERED,) * count,
                inliers=np.full(count, 60),
                error_px=np.full(count, 0.5),
            )
        )
    assert excluded_cameras(replace(capture.inputs, trajectories=tuple(still))) == {}


def test_stationary_cameras_are_searched_once(walked, monkeypatch, tmp_path):
    asked = []
    searched = "bodycap_batch.merging.cameras.excluded_cameras.stationary_cameras"
    monkeypatch.setattr(searched, lambda *args: asked.append(args) or [])
    merge_trajectories(walked, MergeOptions(), StageContext(work_dir=tmp_path))
    assert len(asked) == 1


def test_a_rarely_localised_camera_on_the_trunk_is_not_the_reference(capture):
    (main, further), *others = _candidates(_lose(capture.inputs, "torso", 30))
    assert _names(main)[0] == "head"
    assert _names(main)[-1] == "torso"
    assert not further
    assert not others


def test_a_camera_on_the_trunk_alone_in_a_small_map_is_in_a_further_map(capture):
    short = _in_maps(_lose(capture.inputs, "torso", 30), {"torso": "small"})
    first, second = _candidates(short)
    assert "torso" not in _names(first[0])
    assert _names(first[1]) == ["torso"]
    assert _names(second[0]) == ["torso"]


def test_the_next_main_map_is_tried_if_one_does_not_determine_the_scale(capture, monkeypatch):
    alone = _in_maps(capture.inputs, {"torso": "own"})
    monkeypatch.setattr(
        align, "align_maps", lambda *_: (_ for _ in ()).throw(EstimationError("nowhere to be placed"))
    )
    together = _aligned(alone)
    assert "torso" not in _names(together.trajectories)
    assert len(together.trajectories) == len(CAMERAS) - 1
    assert "nowhere to be placed" in together.unused["torso"]


def test_hands_alone_do_not_determine_the_scale_and_the_error_names_what_is_missing(capture):
    hands = replace(
        capture.inputs,
        trajectories=tuple(
            each
            for each in capture.inputs.trajectories
            if each.camera in ("torso", "left_palm", "right_palm")
        ),
    )
    with pytest.raises(
        EstimationError,
        match=r"no two cameras .*are 'left_palm', 'right_palm'; the unusable cameras are 'torso'",
    ):
        _aligned(_lose(hands, "torso", 6))
    nobody = replace(hands, trajectories=hands.trajectories[:1])
    with pytest.raises(EstimationError, match="usable cameras are none"):
        _aligned(_lose(nobody, "torso", 6))


def test_cameras_that_only_lack_a_clock_are_advised_to_clap(capture):
    unknown = {
        name: clock if name == "torso" else replace(clock, source="none")
        for name, clock in capture.inputs.clocks.items()
    }
    with pytest.raises(EstimationError) as caught:
        _aligned(replace(capture.inputs, clocks=unknown))
    assert "clap once" in str(caught.value.hint)
    lost = _lose(replace(capture.inputs, clocks=unknown), "torso", 6)
    with pytest.raises(EstimationError) as caught:
        _aligned(lost)
    assert "film the same places" in str(caught.value.hint)


def test_a_camera_on_a_limb_gives_no_vertical(capture):
    inputs = capture.inputs
    bones = kinematic_chain(inputs.skeleton, {mount.role for mount in inputs.mounts})
    arm = next(mount for mount in inputs.mounts if mount.camera == "left_upper_arm")
    place = [bone.role for bone in bones].index(arm.role)
    trajectory = next(each for each in inputs.trajectories if each.camera == arm.camera)
    assert (
        preliminary_vertical(
            inputs.skeleton, bones, make_track(inputs, trajectory, place), arm, np.zeros((0, 3))
        )
        is None
    )


def test_the_timeline_is_that_of_the_used_cameras(capture):
    used = capture.inputs.trajectories[:3]
    far = replace(capture.inputs.trajectories[3], times_ns=capture.inputs.trajectories[3].times_ns + 10**13)
    inputs = replace(capture.inputs, trajectories=(*used, far))
    ticks = timeline(inputs.clocks, used, 30.0)
    assert len(ticks) == 180
    assert ticks[0] == min(int(each.times_ns[0]) for each in used)


def test_one_bad_map_does_not_exclude_the_others(capture, monkeypatch):
    inputs = _in_maps(capture.inputs, {"left_palm": "good", "right_palm": "bad"})
    asked = []

    def place(_inputs, _options, _bones, tracks, _step):
        asked.append(tuple(tracks))
        if "bad" in tracks:
            raise EstimationError("fits no person")
        here = Similarity(1.0, np.eye(3), np.zeros(3))
        return (
            AlignedMap(
                gauge="good",
                main_from_gauge=here,
                sigma=PoseSigma(0.01, 0.01),
                reason=None,
            ),
        )

    monkeypatch.setattr(align, "align_maps", place)
    main, further = _candidates(inputs)[0]
    together = align_cameras(inputs, main, further, lambda: None)
    assert asked == [("map-0", "good", "bad"), ("map-0", "good"), ("map-0", "bad")]
    assert "left_palm" in _names(together.trajectories)
    assert "fits no person" in together.unused["right_palm"]
    assert list(together.unused) == ["right_palm"]


def test_equations_without_an_answer_are_an_estimation_error():
    with pytest.raises(EstimationError, match="does not determine"):
        similarity_refinement._solve_normal_equations(np.zeros((2, 2)), np.ones(2))


def _with_twin(inputs, **changes):
    """Return the inputs with a second camera at the torso's position, on the same path."""
    twin = replace(next(each for each in inputs.trajectories if each.camera == "torso"), camera="torso_2")
    mount = replace(inputs.mount_of("torso"), camera="torso_2", **changes)
    return replace(
        inputs,
        trajectories=(*inputs.trajectories, twin),
        mounts=(*inputs.mounts, mount),
        clocks={**inputs.clocks, "torso_2": inputs.clocks["torso"]},
    )


def test_cameras_at_one_position_are_together_as_uncertain_as_one(capture):
    inputs = capture.inputs
    alone = inputs.mount_of("torso")
    shared = _correlated(_with_twin(inputs))
    for camera in ("torso", "torso_2"):
        mount = shared.mount_of(camera)
        assert mount.sigma_m == pytest.approx(np.sqrt(2.0) * alone.sigma_m)
        assert mount.sigma_rad == pytest.approx(np.sqrt(2.0) * alone.sigma_rad)
    assert shared.mount_of("left_palm") == inputs.mount_of("left_palm")
    # A camera elsewhere on the bone, with a stated mount, or never localised changes nothing.
    behind = alone.joint_from_cam.copy()
    behind[1, 3] += 0.2
    for other in ({"joint_from_cam": behind}, {"sigma_rad": 0.02, "sigma_m": 0.01, "by_name": False}):
        assert _correlated(_with_twin(inputs, **other)).mount_of("torso") == alone
    assert _correlated(_lose(_with_twin(inputs), "torso_2", 6)).mount_of("torso") == alone
    assert _correlated(inputs).mounts == inputs.mounts


def test_the_error_of_a_map_counts_once_for_two_cameras_on_a_bone(capture):
    bones = kinematic_chain(capture.inputs.skeleton, {mount.role for mount in capture.inputs.mounts})
    index = {bone.role: place for place, bone in enumerate(bones)}
    for inputs, alike in ((capture.inputs, 1), (_with_twin(capture.inputs), 2)):
        tracks = [
            make_track(inputs, each, index[inputs.mount_of(each.camera).role]) for each in inputs.trajectories
        ]
        samples = take_samples(tracks, 1.0, 40)
        for track, sigma in zip(tracks, samples.sigma_rad, strict=True):
            count = alike if track.camera.startswith("torso") else 1
            # Their own noise is not alike.
            own = max(float(np.median(track.sigma_rad)), MIN_SIGMA_RAD)
            assert sigma**2 - own**2 == pytest.approx(count * samples.correlated_samples * MAP_ERROR_RAD**2)
