"""A simulated capture, ready for body calibration at its true scale."""

from __future__ import annotations

from bodycap_batch.merging.body.bones import kinematic_chain
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.samples import CalibrationSamples, take_samples
from bodycap_batch.merging.cameras.track import make_track
from bodycap_batch.synthetic import SynthOptions
from tests.bench.posed import GAUGE, posed


def calibration_of(options: SynthOptions) -> tuple[CalibrationSamples, CalibrationGraph, float]:
    """Return sixty samples of a walk in one map, their unsolved calibration, and metres per map unit."""
    capture = posed(options)
    inputs, roles = capture.inputs, {mount.camera: mount.role for mount in capture.mounts}
    bones = kinematic_chain(inputs.skeleton, set(roles.values()))
    index = {bone.role: number for number, bone in enumerate(bones)}
    tracks = [make_track(inputs, path, index[roles[path.camera]]) for path in inputs.trajectories]
    metric = 1.0 / capture.gauges[GAUGE].scale
    samples = take_samples(tracks, metric, 60)
    mounts = {mount.camera: mount for mount in inputs.mounts}
    return samples, CalibrationGraph(inputs.skeleton, bones, samples, mounts, metric, lambda: None), metric
