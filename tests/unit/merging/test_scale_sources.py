"""Sources of the main map's scale before further maps are aligned, and their effect on the alignment."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bodycap_batch.config.options import MergeOptions
from bodycap_batch.core.errors import EstimationError
from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.calibrate_body import reference_camera_roll
from bodycap_batch.merging.body_calibration.scale import ScaleSource
from bodycap_batch.merging.body_calibration.stated_constraints import StatedConstraints, stated_constraints
from bodycap_batch.merging.cameras.track import CameraTrack, make_track
from bodycap_batch.merging.main_map import candidate_main_maps
from bodycap_batch.merging.map_alignment import align
from bodycap_batch.merging.map_alignment.align import align_cameras
from bodycap_batch.merging.map_alignment.similarity_refinement import MapAlignmentProblem
from bodycap_batch.merging.map_alignment.walked_floor import (
    scale_from_walked_floor,
)
from bodycap_batch.merging.world.vertical import Vertical, VerticalHypothesis
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.synthetic import SynthOptions
from tests.bench.joining import SPLITS, _off
from tests.bench.posed import posed
from tests.bench.simulation import PALMS

UP = np.array([0.0, 0.0, 1.0])
SPLIT = SPLITS["a palm each"]


def _drawn(seconds):
    return posed(SynthOptions(seconds=seconds, cameras=PALMS, seed=3, poses_only=True), SPLIT)


@pytest.fixture(scope="module")
def short():
    return _drawn(6.0)


def _direction(up, source="map"):
    return Vertical(up=up, source=source, sigma_deg=0.0, body_off_deg=None, share=0.0)


def _asked(capture, options, points=None, off=1.1, up="map"):
    """Return the sources of the main map's scale, for a body with a scale that is wrong by a factor."""
    inputs = capture.inputs
    bones = kinematic_chain(inputs.skeleton, {mount.role for mount in inputs.mounts})
    trunk = next(each for each in inputs.trajectories if each.camera == "torso")
    index = [bone.role for bone in bones].index(inputs.mount_of("torso").role)
    gauge = capture.gauges[trunk.gauge]
    body = ScaleSource(name="body", scale=off / gauge.scale, sigma_log=0.1)
    seen = make_track(inputs, trunk, index), _direction(gauge.rotation @ UP, up) if up else None
    points = np.zeros((0, 3)) if points is None else gauge.apply(points)
    stated = stated_constraints(
        inputs, options, {trunk.gauge: Similarity(1.0, np.eye(3), np.zeros(3))}, skip_unusable=True
    ).scales
    floor = scale_from_walked_floor(inputs, *seen, body, points)
    return [
        (each.name, each.scale * gauge.scale, each.sigma_log)
        for each in (*stated, *(() if floor is None else (floor,)))
    ]


def _floor(capture, height_m):
    """Points (P,3) about the walk, in the world."""
    rng = np.random.default_rng(0)
    torso = next(each for each in capture.inputs.trajectories if each.camera == "torso")
    centres = torso.gauge_from_cam[torso.localised, :3, 3]
    path = capture.gauges[torso.gauge].inverse().apply(centres)[:: max(1, len(centres) // 80)]
    beside = path + rng.uniform(-0.5, 0.5, path.shape)
    beside[:, 2] = height_m + rng.normal(scale=0.005, size=len(path))
    return beside


def test_the_height_over_the_walked_floor_tells_the_scale(short):
    options = MergeOptions()
    ((name, scale, sigma),) = _asked(short, options, _floor(short, 0.0))
    assert name == "floor"
    # Standing legs over the walker's bent ones, and a mount 3 cm off in its height.
    assert scale == pytest.approx(1.0, abs=0.06)
    assert 0.02 < sigma < 0.1
    # Neither without the vertical, nor by a table, nor from what is no floor of this body's.
    assert _asked(short, options, _floor(short, 0.0), up=None) == []
    assert _asked(short, options, _floor(short, 0.0), up="walk") == []
    assert _asked(short, options, _floor(short, 0.7)) == []
    assert _asked(short, options, _floor(short, 0.0), off=1.5) == []
    assert _asked(short, options) == []


def _distance(capture, camera):
    """A distance the job could state: between the first and the last localised frame of a camera."""
    path = next(each for each in capture.inputs.trajectories if each.camera == camera)
    ends = np.flatnonzero(path.localised)[[0, -1]]
    way = path.gauge_from_cam[ends, :3, 3] / capture.gauges[path.gauge].scale
    metres = float(np.linalg.norm(way[1] - way[0]))
    return MergeOptions(known_distance=(f"{camera}:{ends[0]}", f"{camera}:{ends[1]}", metres))


def _sitter(inputs, walks):
    """Return the track of a torso that walks for a ratio of its 600 frames, then sits 35 cm lower."""
    count = np.arange(600)
    walking = count < walks * 600
    sway = 1.5 * np.sin(count / 40.0)
    path = np.stack([sway, 0.4 * np.cos(count / 30.0), np.full(600, 1.30)], axis=1)
    first = path[int(walking.sum()) - 1] if walks else path[0]
    path[~walking] = first - [0.0, 0.0, 0.35]
    heading = np.where(np.diff(sway, append=sway[-1]) > 0.0, 0.0, np.pi)
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = so3_exp(heading[:, None] * UP) @ level
    return CameraTrack(
        camera="torso",
        bone=0,
        frames=count,
        times_ns=count * 33_333_333,
        map_from_cam=make_transform(turned, path),
        sigma_rad=np.full(600, 0.005),
        sigma_map=np.full(600, 0.005),
    )


def test_sitting_does_not_change_the_scale_from_the_floor(short):
    inputs, rng = short.inputs, np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-2.0, 2.0, (300, 2)), rng.normal(scale=0.005, size=300)])
    body = ScaleSource(name="body", scale=1.0, sigma_log=0.15)
    seen = [(_sitter(inputs, walks), _direction(UP)) for walks in (1.0, 0.4, 0.0)]
    always, seldom, never = (scale_from_walked_floor(inputs, *each, body, floor) for each in seen)
    assert seldom.scale == pytest.approx(always.scale, abs=0.02)
    assert never is None


def test_a_stated_distance_in_the_main_map_is_a_source_besides_the_floor(short):
    (name, scale, sigma), _ = _asked(short, _distance(short, "torso"), _floor(short, 0.0))
    assert name == "known distance"
    assert scale == pytest.approx(1.0, abs=1e-6)
    assert sigma < 0.01


def test_a_distance_in_another_map_is_not_used_before_its_alignment(short):
    found = _asked(short, _distance(short, "left_palm"), _floor(short, 0.0))
    assert [name for name, _, _ in found] == ["floor"]


def test_the_alignment_gets_the_stated_vertical_and_the_roll_of_the_trunks_camera(short, monkeypatch):
    lying, received = VerticalHypothesis(source="marker board", up=UP, sigma_deg=1.5), []

    def way_up(*arguments):
        received.append(arguments[-1])
        return 180.0, None

    def calibration(skeleton, bones, samples, mounts, *_):
        received.append(mounts["torso"])
        raise EstimationError("enough")

    monkeypatch.setattr(align, "stated_constraints", lambda *_, **__: StatedConstraints(verticals=(lying,)))
    monkeypatch.setattr(align, "reference_camera_roll", way_up)
    monkeypatch.setattr(align, "CalibrationGraph", calibration)
    main, further = candidate_main_maps(short.inputs, ())[0]
    assert "enough" in align_cameras(short.inputs, main, further[:1], lambda: None).unused[further[0].camera]
    assert received[0] == (lying,)
    usual = short.inputs.mount_of("torso").joint_from_cam
    assert np.allclose(received[1].joint_from_cam[:3, :2], -usual[:3, :2])


def test_an_early_vertical_names_its_source(short):
    inputs = short.inputs
    bones = kinematic_chain(inputs.skeleton, {mount.role for mount in inputs.mounts})
    trunk = next(each for each in inputs.trajectories if each.camera == "torso")
    tracks = [make_track(inputs, trunk, [bone.role for bone in bones].index("Spine1"))]
    unit = short.gauges[trunk.gauge]
    lying = VerticalHypothesis(source="marker board", up=unit.rotation @ UP, sigma_deg=1.5)
    roll, up = reference_camera_roll(inputs, bones, tracks, 1.0 / unit.scale, (lying,))
    assert (roll, up.source) == (0.0, "marker board")


class _Strained(MapAlignmentProblem):
    """A problem with a solved scale nine sigmas from that of the limbs' reach."""

    def solve(self):
        self._covariance = 1e-4 * np.eye(1 + 7 * len(self.corrections))

    def scale_residual(self):
        return 9.0


def test_a_stated_scale_permits_an_alignment_with_inconsistent_scales(short, monkeypatch):
    monkeypatch.setattr(align, "MapAlignmentProblem", _Strained)
    main, further = candidate_main_maps(short.inputs, ())[0]
    refused, placed = (
        align_cameras(short.inputs, main, further[:1], lambda: None, options).unused
        for options in (MergeOptions(), _distance(short, "torso"))
    )
    assert "the scale from the movement of the cameras differ" in refused[further[0].camera]
    assert not placed


def test_the_stated_scale_is_a_residual_of_the_problem():
    problem = MapAlignmentProblem(
        SimpleNamespace(samples=SimpleNamespace(cameras=())),
        [],
        1.0,
        reach_sigma=0.05,
        stated=(ScaleSource(name="known distance", scale=1.2, sigma_log=0.01),),
    )
    assert problem._source_residuals() == pytest.approx([0.0, -np.log(1.2) / 0.01])
    assert problem.scale_residual() == 0.0


@pytest.mark.slow
def test_a_known_scale_improves_the_alignment_of_palms():
    capture = _drawn(1000 / 30)
    main, further = candidate_main_maps(capture.inputs, ())[0]
    off = []
    for options in (MergeOptions(), _distance(capture, "torso")):
        together = align_cameras(capture.inputs, main, further, lambda: None, options)
        assert not together.unused
        off.append(_off(capture, together.main_from_gauge, main[0].gauge))
        # Three dimensions of the stated sigma, twice.
        assert all(value < 2.0 * np.sqrt(3.0) * together.sigmas[name][1] for name, value in off[-1].items())
    # With the body's own scale, 11 % too small, they were 9 and 13 cm wrong.
    assert max(off[1].values()) < 0.6 * max(off[0].values())
    assert max(off[1].values()) < 0.07
