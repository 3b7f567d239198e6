"""Estimate the uncertainty of a solved calibration graph.

Also compute the derivatives of the graph's residuals with respect to camera poses and scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body_calibration.mount_calibration_graph import CalibrationGraph
from bodycap_batch.merging.body_calibration.mount_covariance import TRANSIENT_SHARE, LinearisedCalibration
from bodycap_batch.merging.body_calibration.skeleton_error_modes import (
    bone_length_modes,
    joint_placement_modes,
)
from bodycap_batch.merging.graph.error_modes import (
    POSTURE_BIAS_SHARE,
    ErrorModes,
    map_error_modes,
    mount_perturbation,
    posture_bias_modes,
    scale_modes,
    stack_modes,
)
from bodycap_batch.merging.graph.factors import MountPoints, mount_keys
from bodycap_batch.merging.graph.linearisation import LinearisedGraph
from bodycap_batch.model.skeleton import Mount


class PoseSigma(NamedTuple):
    """One-sigma uncertainty of a pose, per axis.

    Attributes:
        rotation_rad: Sigma of the rotation, radians.
        position_m: Sigma of the position, metres.
    """

    rotation_rad: float
    position_m: float


def error_modes(
    graph: CalibrationGraph,
    sigma_log: float,
    mount_slope: Mapping[str, FloatArray],
    alignment: Mapping[str, PoseSigma],
    stature_m: float | None = None,
) -> tuple[ErrorModes, ErrorModes]:
    """Return the error modes of the last solution of a calibration graph.

    Args:
        graph: The solved calibration graph.
        sigma_log: Sigma of the logarithm of the scale.
        mount_slope: By camera, change of joint_from_cam (4,4) per unit of log scale.
        alignment: By camera, uncertainty of the pose of this camera's map. It contains only cameras whose map
            was aligned to the main map through the body.
        stature_m: Stature from which the bones were scaled, metres; None if the bones were measured. The
            modes of joint placement are transient. They do not increase the uncertainty of the mounts,
            because the mounts refer to the same placement of the joints.

    Returns:
        The modes that are constant over the capture: noise of the calibration, bias of the posture, scale,
        bone lengths. Then the modes that each act on one interval of the motion only: bends of the map,
        varying posture, placement of the joints.
    """
    samples, cameras = graph.samples, graph.samples.cameras
    linearised = graph.linearised()
    reduced = linearised.reduced()
    body_modes = [posture_bias_modes(linearised.body.bones, cameras, POSTURE_BIAS_SHARE)]
    body_modes += [] if stature_m is None else [bone_length_modes(graph.bones, cameras)]
    follow = {name: mount_perturbation(graph.mounts[name], mount_slope[name]) for name in cameras}
    # The sigmas of the samples contain the map's error, multiplied by the number of samples that share it.
    map_error = (1.0 - samples.white_noise_share) / samples.correlated_samples
    bends = np.sqrt(map_error) * np.stack([samples.sigma_rad, graph.scale * samples.sigma_map], axis=1)
    bends = np.hypot(bends, [alignment.get(name, (0.0, 0.0)) for name in cameras])
    constant = stack_modes(
        [
            linearised.error_modes(reduced, stack_modes(body_modes)),
            scale_modes(graph.bones, sigma_log, follow),
        ]
    )
    transient = [
        posture_bias_modes(graph.bones, cameras, TRANSIENT_SHARE),
        map_error_modes(graph.bones, dict(zip(cameras, bends, strict=True))),
    ]
    if stature_m is not None:
        placement = joint_placement_modes(graph.bones, cameras, stature_m)
        transient.append(linearised.propagated(reduced, placement))
    return constant, stack_modes(transient)


def mounts_with_sigmas(graph: CalibrationGraph, modes: ErrorModes) -> tuple[Mount, ...]:
    """Return the mounts of the last solution with their sigmas.

    Args:
        graph: The solved calibration graph.
        modes: Error modes that are constant over the capture.

    Returns:
        One mount per camera, in the order of the graph's cameras.
    """
    out = []
    for name in graph.samples.cameras:
        variance = (modes.mounts[name] ** 2).sum(axis=1)
        out.append(
            Mount(
                camera=name,
                role=graph.priors[name].role,
                joint_from_cam=graph.mounts[name],
                sigma_rad=float(np.sqrt(variance[:3].mean())),
                sigma_m=float(np.sqrt(variance[3:].mean())),
            )
        )
    return tuple(out)


def measurement_jacobian(
    graph: CalibrationGraph, linear: LinearisedGraph, directions: FloatArray
) -> FloatArray:
    """Return the derivative of the residuals with respect to movements of the measured camera poses.

    Args:
        graph: The solved calibration graph.
        linear: The Jacobian at the last solution.
        directions: (C,K,P,6) movement of C cameras at K ticks along P directions: rotation (rad), then
            translation (m), in the axes of the map.

    Returns:
        (R,P) change of the whitened residuals per unit of movement along each direction.
    """
    samples = graph.samples
    poses, all_points = graph.poses(), samples.mount_points(graph.scale)
    out = np.zeros((linear.matrix.shape[0], directions.shape[2]))
    for camera in range(len(samples.cameras)):
        ticks = np.flatnonzero(samples.valid[camera])
        rotation = samples.map_from_cam[camera, ticks, :3, :3]
        all_factors = graph.measurement_factors(camera)
        for point, key in enumerate(mount_keys(camera)):
            factors = all_factors[:, point]
            arm = rotation @ all_points[camera].x_in_cam()[point]
            shift = directions[camera, ticks, :, 3:] + np.cross(
                directions[camera, ticks, :, :3], arm[:, None]
            )
            in_bone = np.einsum("kji,kpj->kip", poses[ticks, samples.bones[camera], :3, :3], shift)
            derivative = linear.pose_jacobians(factors, 3, [key] * len(ticks))[..., :3]
            rows = linear.first_row[factors][:, None] + np.arange(3)
            out[rows] = derivative @ in_bone
    return out


def scale_jacobian(graph: CalibrationGraph, linearised: LinearisedCalibration) -> FloatArray:
    """Return the part of the residuals' derivative with respect to log scale that the sigmas cause.

    The sigmas of camera centres and joint gaps are constant in map units. In metres these sigmas grow with
    the scale, so the whitened residuals shrink. The sigmas of rotations do not depend on the scale.

    Args:
        graph: The solved calibration graph.
        linearised: The graph, linearised at its solution.

    Returns:
        (R,) change of the whitened residuals per unit of log scale.
    """
    linear = linearised.linear
    out = np.zeros(len(linear.rhs))
    first, ticks = linearised.first_joint_factor, len(linearised.world_from_bone)
    start, end = linear.first_row[[first, first + linearised.body.factors_per_tick * ticks]]
    out[start:end] = -linear.rhs[start:end]
    out[linearised.rotation_rows(np.arange(ticks))] = 0.0
    for camera in range(len(graph.samples.cameras)):
        centre = linear.first_row[graph.measurement_factors(camera)[:, 0]][:, None] + np.arange(3)
        for point, share in enumerate((1.0, *[MountPoints.AXIS_WHITENING_RATIO] * 3)):
            out[centre + 3 * point] = -share * linear.rhs[centre]
    return out
