"""The focal length after the map's adjustments, for lenses that start from a named profile.

``python -m tests.bench lenses``: 20 profiles of different models. The true lens is the profile with a focal
length that is larger or smaller by 1 %. Points of a room are seen with this lens along the path of a hand,
with noise and wrong observations. The map's adjustments start from the profile, and from poses and points
with errors. Nothing is rendered and nothing is matched: the figures hold for the adjustments alone. Target:
0.5 %.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from bodycap_batch.config import MapOptions
from bodycap_batch.config.lens_profiles import LensProfile, lens_profiles
from bodycap_batch.mapping.reconstruction.bundle_adjustment import adjust_and_filter, adjust_robustly
from bodycap_batch.mapping.reconstruction.conversion import camera_from_pycolmap
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options
from bodycap_batch.model.camera import CV2_PIXEL_OFFSET_PX, Camera
from bodycap_batch.model.geometry import invert, make_transform, so3_exp
from bodycap_batch.model.optical_flow import pixel_scale

LENSES, VIEWS, POINTS, SEEN, LONG_PX = 20, 60, 8000, 300, 960
"""A view has up to `SEEN` observations, as a keyframe of a map has."""
LEAST_ANGLE_RAD = np.radians(30.0)
"""Least angle between the axis and a corner: tele lenses are not for cameras on a body."""
NOISE_PX, WRONG_RATIO = 0.3, 0.05
TRUE_CHANGE, TARGET = 0.01, 0.005


def chosen_profiles(count: int) -> list[LensProfile]:
    """Return profiles of different models, spread over the table."""
    models: dict[str, LensProfile] = {}
    for profile in lens_profiles():
        lens = true_lens(profile, (profile.width, profile.height), 1.0)
        wide = largest_angle(lens) > LEAST_ANGLE_RAD
        if wide and not profile.anamorphic and not profile.stabilised:
            models.setdefault(profile.camera_name, profile)
    found = list(models.values())
    return [found[index] for index in np.linspace(0, len(found) - 1, count).astype(int)]


def true_lens(profile: LensProfile, size: tuple[int, int], factor: float) -> Camera:
    """Return the whole lens of a profile, with other focal lengths."""
    fx, fy, cx, cy, *radial = profile.params
    focal = 0.5 * (fx + fy) * factor * size[0] / profile.width
    centre = [
        (value + CV2_PIXEL_OFFSET_PX) * own / stated
        for value, own, stated in zip((cx, cy), size, (profile.width, profile.height), strict=True)
    ]
    params = np.array([focal, focal, *centre, *radial])
    return Camera(model="OPENCV_FISHEYE", width_px=size[0], height_px=size[1], params=params)


def largest_angle(lens: Camera) -> float:
    """Return the angle (radians) from the axis up to which the curve of a lens rises, or of its corner."""
    theta = np.linspace(0.0, 1.5, 600)
    curve = theta * (1.0 + theta**2 * np.polynomial.polynomial.polyval(theta**2, lens.params[4:]))
    corner = 0.5 * float(np.hypot(lens.width_px, lens.height_px)) / lens.focal_px
    return float(theta[np.argmax((np.diff(curve, append=-1.0) <= 0) | (curve > corner))])


def drawn_model(start: Camera, truth: Camera, rng: np.random.Generator) -> Any:
    """Return a model with the start lens whose observations were made with the true lens."""
    import pycolmap

    half_m = np.array([2.0, 2.5, 1.3])
    points = rng.uniform(-half_m, half_m, (POINTS, 3))
    wall = rng.integers(0, 3, POINTS)
    points[np.arange(POINTS), wall] = np.sign(points[np.arange(POINTS), wall]) * half_m[wall]
    when = np.linspace(0.0, 6.0, VIEWS)
    turn = np.stack([0.5 * np.sin(1.7 * when), when, 0.4 * np.cos(2.3 * when)], axis=1)
    place = np.stack([np.sin(0.9 * when), 1.2 * np.cos(0.7 * when), 0.3 * np.sin(2.0 * when)], axis=1)
    poses = make_transform(so3_exp(turn), place)
    model = pycolmap.Reconstruction()
    camera = start.to_pycolmap()
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    tracks: list[list[tuple[int, int]]] = [[] for _ in range(POINTS)]
    limit_px = (truth.width_px, truth.height_px)
    for number, pose in enumerate(poses):
        in_cam = (points - pose[:3, 3]) @ pose[:3, :3]
        px = truth.project(in_cam)
        angle = np.arctan2(np.linalg.norm(in_cam[:, :2], axis=1), in_cam[:, 2])
        inside = np.isfinite(px).all(axis=1) & ((px > 0) & (px < limit_px)).all(axis=1)
        rows = np.flatnonzero(inside & (angle < largest_angle(truth)))[:SEEN]
        seen = px[rows] + rng.normal(0.0, NOISE_PX * pixel_scale(*limit_px), (len(rows), 2))
        wrong = rng.random(len(rows)) < WRONG_RATIO
        seen[wrong] += rng.normal(0.0, 3.0, (wrong.sum(), 2))
        off = make_transform(so3_exp(rng.normal(0.0, 0.01, 3)), rng.normal(0.0, 0.03, 3))
        image = pycolmap.Image(name=f"cam/{number:06d}", keypoints=seen, camera_id=1, image_id=number + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(invert(pose @ off)[:3]))
        for feature, row in enumerate(rows.tolist()):
            tracks[row].append((number + 1, feature))
    for point, track in zip(points, tracks, strict=True):
        if len(track) > 2:
            elements = [pycolmap.TrackElement(*each) for each in track]
            model.add_point3D(point + rng.normal(0.0, 0.03, 3), pycolmap.Track(elements))
    return model


def focal_error(profile: LensProfile, number: int) -> float:
    """Return the relative error of the focal length after the adjustments.

    The map has two radial terms and the profile has four, so their focal lengths at the centre differ
    although the curves agree. Compared are the distances from the principal point, over all angles in the
    image.
    """
    scale = LONG_PX / max(profile.width, profile.height)
    size = (round(profile.width * scale), round(profile.height * scale))
    start = profile.first_guess(size)
    factor = 1.0 + (TRUE_CHANGE if number % 2 else -TRUE_CHANGE)
    truth = true_lens(profile, size, factor)
    model = drawn_model(start, truth, np.random.default_rng(number))
    settings = make_mapper_options(MapOptions(), [], pixel_scale(*size))
    for _ in range(2):
        adjust_and_filter(model, settings, [])
    adjust_robustly(model, settings, [])
    found = camera_from_pycolmap(next(iter(model.cameras.values())))
    theta = np.linspace(0.02, largest_angle(truth), 100)
    rays = np.column_stack([np.sin(theta), np.zeros(100), np.cos(theta)])
    mapped, true = (lens.project(rays)[:, 0] - lens.principal_point_px[0] for lens in (found, truth))
    return float(mapped @ true / (true @ true)) - 1.0


def main(arguments: Sequence[str]) -> int:
    """Print the error of each lens."""
    parser = argparse.ArgumentParser(prog="make bench ARGS=lenses", description=__doc__)
    parser.add_argument("--lenses", type=int, default=LENSES, help="number of lenses")
    options = parser.parse_args(arguments)
    errors = []
    for number, profile in enumerate(chosen_profiles(options.lenses)):
        errors.append(focal_error(profile, number))
        print(f"{100 * errors[-1]:+7.3f} %  {profile.name}", flush=True)
    inside = sum(abs(error) <= TARGET for error in errors)
    worst = 100.0 * max(map(abs, errors))
    print(f"{inside} of {len(errors)} within {100 * TARGET:.1f} %; largest error {worst:.3f} %")
    return 0 if inside == len(errors) else 1
