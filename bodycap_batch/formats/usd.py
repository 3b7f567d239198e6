"""USD files: a skeleton, its animation and a skinned mannequin, in metres and in world axes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.core.unique_names import unique_name
from bodycap_batch.formats.atomic_files import atomic_replacement
from bodycap_batch.formats.mannequin import COLOUR_RGB, Mannequin, make_mannequin
from bodycap_batch.model.geometry import continuous_quat_xyzw, invert, rotation_from_quat_xyzw
from bodycap_batch.model.measured_parts import joint_sources
from bodycap_batch.model.skeleton import Motion, SkeletonModel, rest_pose
from bodycap_batch.model.take import Take

_BODY_PATH, _SKELETON_PATH, _MESH_PATH = "/Body", "/Body/Skeleton", "/Body/Mannequin"
_MOTION_PATH = "/Body/Skeleton/Motion"

_EXTENT_MARGIN_M = 0.3
"""Margin, metres, between the joint centres and the bounding box of the mannequin. Derivation: head, hands
and feet extend beyond their joints by less than this margin."""


def write_usd(
    path: Path,
    motion: Motion,
    earth: Mapping[str, Any] | None = None,
    *,
    take: Take | None = None,
    sigma_m: FloatArray | None = None,
) -> Path:
    """Write a motion as a skinned, animated mannequin.

    The time codes are frame numbers, counted from 0. The mesh is bound to the joints in the T-pose. The joint
    tokens are paths of names that USD allows (``mixamorig_Hips``). The original names are stored in
    ``jointNames``. The custom data ``unobservedJoints`` of the skeleton lists the joints that no camera
    measured, and the primvar ``motionSource`` has ``measured`` or ``filled`` for each joint. Translations,
    rotations and scales are written for every frame. So are the primvars ``measured`` and ``sigmaMetres`` of
    the skeleton, with a value for each joint.

    Args:
        path: Path of the file (``.usd``, ``.usda``, ``.usdc``), which is replaced atomically.
        motion: The motion, in world axes and metres.
        earth: Place of the world on the Earth as plain JSON values, for the custom data ``earth`` of the
            layer; None if it is unknown. The transform is a list of 16 numbers, row by row.
        take: Name, exact rate and timecode, for the custom data of the layer; None if they are unknown.
        sigma_m: (T,J) standard deviation per axis of each joint's centre, metres; NaN if it is unknown. None
            leaves it out.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    from pxr import Gf, UsdSkel, Vt

    stage = new_stage(motion.fps, len(motion.root_in_world_m))
    body = UsdSkel.Root.Define(stage, _BODY_PATH)
    stage.SetDefaultPrim(body.GetPrim())
    centres = motion.world_from_joint()[..., :3, 3].reshape(-1, 3)
    corners = [centres.min(axis=0) - _EXTENT_MARGIN_M, centres.max(axis=0) + _EXTENT_MARGIN_M]
    body.CreateExtentAttr(Vt.Vec3fArray([Gf.Vec3f(*corner.tolist()) for corner in corners]))
    tokens = _joint_tokens(motion.skeleton)
    skeleton = _define_skeleton(stage, motion.skeleton, tokens)
    unobserved = [
        name
        for name, seen in zip(motion.skeleton.joints, np.any(motion.observed, axis=0).tolist(), strict=True)
        if not seen
    ]
    skeleton.GetPrim().SetCustomDataByKey("unobservedJoints", Vt.StringArray(unobserved))
    animation = _define_animation(stage, motion, tokens)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    _define_mesh(stage, make_mannequin(motion.skeleton), skeleton)
    _add_validity(skeleton, motion, sigma_m)
    facts = {} if take is None else layer_data(take.figures())
    if earth is not None:
        facts["earth"] = layer_data(earth)
    if facts:
        stage.GetRootLayer().customLayerData = facts
    return export_stage(stage, path)


def new_stage(fps: float, frames: int) -> Any:
    """Return an empty stage in metres, Z up, with a number of frames that are counted from 0."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0.0)
    stage.SetEndTimeCode(float(frames - 1))
    return stage


def export_stage(stage: Any, path: Path) -> Path:
    """Write a stage to a file, which is replaced atomically, and return the path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    with atomic_replacement(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise StoreError(
                "the USD library could not write the file", path=path, hint="check that the disk is not full"
            )
    return path


def _joint_tokens(skeleton: SkeletonModel) -> list[str]:
    """Return a unique joint path for each joint. The names in the path are names that USD allows."""
    from pxr import Tf

    out: list[str] = []
    for name, parent in zip(skeleton.joints, skeleton.parents.tolist(), strict=True):
        above = f"{out[parent]}/" if parent >= 0 else ""
        out.append(unique_name(f"{above}{Tf.MakeValidIdentifier(name)}", out))
    return out


def _usd_matrices(poses: FloatArray) -> Any:
    """Convert poses (J,4,4) to USD matrices. USD multiplies row vectors, so the matrices are transposed."""
    from pxr import Gf, Vt

    return Vt.Matrix4dArray([Gf.Matrix4d(*pose.T.reshape(-1).tolist()) for pose in poses])


def _define_skeleton(stage: Any, model: SkeletonModel, tokens: list[str]) -> Any:
    """Add the skeleton to the stage and return the added skeleton. Rest pose and bind pose are the T-pose."""
    from pxr import UsdSkel

    rest = rest_pose(model)
    local = [rest[j] if p < 0 else invert(rest[p]) @ rest[j] for j, p in enumerate(model.parents.tolist())]
    skeleton = UsdSkel.Skeleton.Define(stage, _SKELETON_PATH)
    skeleton.CreateJointsAttr(tokens)
    skeleton.CreateJointNamesAttr(list(model.joints))
    skeleton.CreateBindTransformsAttr(_usd_matrices(rest))
    skeleton.CreateRestTransformsAttr(_usd_matrices(np.array(local)))
    return skeleton


def _define_animation(stage: Any, motion: Motion, tokens: list[str]) -> Any:
    """Add the animation of all joints to the stage and return it."""
    from pxr import Gf, UsdSkel, Vt

    animation = UsdSkel.Animation.Define(stage, _MOTION_PATH)
    animation.CreateJointsAttr(tokens)
    attributes = (
        animation.CreateTranslationsAttr(),
        animation.CreateRotationsAttr(),
        animation.CreateScalesAttr(),
    )
    position = motion.local_position_m().astype(np.float32)
    quats = continuous_quat_xyzw(motion.local_rotation).tolist()
    ones = Vt.Vec3hArray([Gf.Vec3h(1.0, 1.0, 1.0)] * len(tokens))
    for frame in range(len(position)):
        turns = Vt.QuatfArray([Gf.Quatf(w, x, y, z) for x, y, z, w in quats[frame]])
        for attribute, value in zip(
            attributes, (Vt.Vec3fArray.FromNumpy(position[frame]), turns, ones), strict=True
        ):
            attribute.Set(value, float(frame))
    return animation


def _add_validity(skeleton: Any, motion: Motion, sigma_m: FloatArray | None) -> None:
    """Add primvars to the skeleton that state for each frame which joints were measured, and how well."""
    from pxr import Sdf, UsdGeom, Vt

    variables = UsdGeom.PrimvarsAPI(skeleton)
    source = variables.CreatePrimvar("motionSource", Sdf.ValueTypeNames.TokenArray)
    source.Set(Vt.TokenArray([each.value for each in joint_sources(motion)]))
    measured = variables.CreatePrimvar("measured", Sdf.ValueTypeNames.BoolArray)
    for frame, row in enumerate(motion.observed.tolist()):
        measured.Set(Vt.BoolArray(row), float(frame))
    if sigma_m is not None:
        sigma = variables.CreatePrimvar("sigmaMetres", Sdf.ValueTypeNames.FloatArray)
        for frame, values in enumerate(sigma_m.astype(np.float32)):
            sigma.Set(Vt.FloatArray.FromNumpy(values), float(frame))


def _define_mesh(stage: Any, body_mesh: Mannequin, skeleton: Any) -> None:
    """Add the mesh of the mannequin to the stage. Each vertex is bound to two joints."""
    from pxr import Gf, UsdGeom, UsdSkel, Vt

    mesh = UsdGeom.Mesh.Define(stage, _MESH_PATH)
    vertices = body_mesh.vertices_m.astype(np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(body_mesh.faces), 3, dtype=np.int32)))
    mesh.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(body_mesh.faces.reshape(-1), dtype=np.int32))
    )
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(body_mesh.normals.astype(np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*COLOUR_RGB)])
    low, high = vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()
    mesh.CreateExtentAttr([Gf.Vec3f(*low), Gf.Vec3f(*high)])
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    joints = np.ascontiguousarray(body_mesh.joints.reshape(-1), dtype=np.int32)
    binding.CreateJointIndicesPrimvar(False, 2).Set(Vt.IntArray.FromNumpy(joints))
    weights = np.ascontiguousarray(body_mesh.weights.reshape(-1), dtype=np.float32)
    binding.CreateJointWeightsPrimvar(False, 2).Set(Vt.FloatArray.FromNumpy(weights))


def read_usd(path: Path) -> Motion:
    """Read the animated skeleton of a file that `write_usd` has written.

    The rest pose of the file becomes the T-pose of the skeleton. In the zero pose, all rotations are the
    identity.

    Raises:
        JobError: The file is not a USD stage with a skeleton and its animation.
    """
    from pxr import Tf, Usd, UsdSkel

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise JobError(
            "the file cannot be read as USD", path=path, hint="give the motion.usd of a results folder"
        ) from error
    skeleton, animation = (
        UsdSkel.Skeleton.Get(stage, _SKELETON_PATH),
        UsdSkel.Animation.Get(stage, _MOTION_PATH),
    )
    if not skeleton or not animation:
        raise JobError(
            "the file contains no skeleton with a motion",
            path=path,
            hint="give the motion.usd of a results folder",
        )
    frames = [float(frame) for frame in range(round(stage.GetEndTimeCode()) + 1)]
    tokens = list(animation.GetJointsAttr().Get())
    parents = [tokens.index(t.rpartition("/")[0]) if "/" in t else -1 for t in tokens]
    translations = np.array(
        [animation.GetTranslationsAttr().Get(frame) for frame in frames], dtype=np.float64
    )
    quats = np.array(
        [
            [[*quat.GetImaginary(), quat.GetReal()] for quat in animation.GetRotationsAttr().Get(frame)]
            for frame in frames
        ]
    )
    rest = np.array([np.array(matrix).T for matrix in skeleton.GetRestTransformsAttr().Get()])
    count = len(tokens)
    model = SkeletonModel(
        name=path.stem,
        joints=tuple(skeleton.GetJointNamesAttr().Get()),
        parents=np.array(parents),
        offsets_m=rest[:, :3, 3],
        end_offsets_m=np.full((count, 3), np.nan),
        roles=("",) * count,
        bvh_channels=((),) * count,
        tpose_rotation=rest[:, :3, :3],
    )
    hips_move = count > 1 and bool(np.ptp(translations[:, 1], axis=0).max() > 0.0)
    return Motion(
        skeleton=model,
        fps=float(stage.GetTimeCodesPerSecond()),
        start_ns=0,
        root_in_world_m=translations[:, 0],
        local_rotation=rotation_from_quat_xyzw(quats),
        observed=np.ones((len(frames), count), dtype=bool),
        hips_in_root_m=translations[:, 1] if hips_move else None,
    )


def layer_data(earth: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain JSON values as values of a layer: lists of numbers as arrays."""
    from pxr import Vt

    return {
        name: Vt.DoubleArray(np.ravel(value).tolist()) if isinstance(value, list) else value
        for name, value in earth.items()
    }
