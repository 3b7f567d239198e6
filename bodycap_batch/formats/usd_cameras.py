"""USD files: animated cameras and the points of a room."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.unique_names import unique_name
from bodycap_batch.formats.palette import linear_colours
from bodycap_batch.formats.usd import export_stage, layer_data, new_stage
from bodycap_batch.model.animated_camera import (
    FAR_PLANE,
    NEAR_PLANE,
    SENSOR_WIDTH_MM,
    AnimatedCamera,
    CameraScene,
)

_SCENE_PATH, _ROOM_PATH = "/Cameras", "/Cameras/Room"
_TENTHS_PER_MM = 0.01
"""Tenths of a scene unit per millimetre of a lens. Derivation: the scene unit is a metre. Source:
UsdGeomCamera gives apertures and focal lengths in tenths of a scene unit."""
_POINT_WIDTH = 0.003
"""Diameter of the points of the room, relative to the size of the room. It only changes how they look."""


def write_camera_usd(path: Path, scene: CameraScene) -> Path:
    """Write cameras with a transform at every frame, and the room as points.

    The time codes are frame numbers, counted from 0. A camera is invisible at a frame that is not valid, and
    keeps the last pose. Its primvars hold for each frame whether it is valid, the frame of the video, and the
    standard deviations. The custom data of the layer hold the take, the exact rate and the start timecode.

    Args:
        path: Path of the file (``.usd``, ``.usda``, ``.usdc``), which is replaced atomically.
        scene: The cameras and the points. The unit of a scene without a metric scale is written as a metre.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    from pxr import Tf, UsdGeom

    stage = new_stage(scene.take.fps, scene.frame_count)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, _SCENE_PATH).GetPrim())
    stage.GetRootLayer().customLayerData = layer_data(scene.figures())
    names = ["Room"]
    for camera in scene.cameras:
        names.append(unique_name(Tf.MakeValidIdentifier(camera.name), names))
        _define_camera(stage, f"{_SCENE_PATH}/{names[-1]}", camera)
    if len(scene.points):
        _define_room(stage, scene)
    return export_stage(stage, path)


def _define_camera(stage: Any, path: str, camera: AnimatedCamera) -> None:
    """Add a camera to the stage."""
    from pxr import Gf, Sdf, UsdGeom

    prim = UsdGeom.Camera.Define(stage, path)
    prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
    prim.CreateFocalLengthAttr(camera.focal_mm * _TENTHS_PER_MM)
    prim.CreateHorizontalApertureAttr(SENSOR_WIDTH_MM * _TENTHS_PER_MM)
    prim.CreateVerticalApertureAttr(camera.sensor_height_mm * _TENTHS_PER_MM)
    prim.CreateClippingRangeAttr(Gf.Vec2f(NEAR_PLANE, FAR_PLANE))
    prim.GetPrim().SetDisplayName(camera.name)
    prim.GetPrim().SetCustomDataByKey(
        "pictureSize", Gf.Vec2i(camera.pinhole.width_px, camera.pinhole.height_px)
    )
    prim.GetPrim().SetCustomDataByKey("clockIsKnown", camera.clock_is_known)
    transform, visibility = prim.AddTransformOp(), prim.CreateVisibilityAttr()
    variables = UsdGeom.PrimvarsAPI(prim)
    columns = {
        "valid": (Sdf.ValueTypeNames.Bool, camera.valid.tolist()),
        "videoFrame": (Sdf.ValueTypeNames.Int, camera.video_frame.tolist()),
        "shiftSeconds": (Sdf.ValueTypeNames.Float, camera.shift_s.tolist()),
        "sigmaDegrees": (Sdf.ValueTypeNames.Float, np.degrees(camera.sigma_rad).tolist()),
        "sigmaPosition": (Sdf.ValueTypeNames.Float, camera.sigma_position.tolist()),
    }
    tracks = [(variables.CreatePrimvar(name, kind), values) for name, (kind, values) in columns.items()]
    shown = (UsdGeom.Tokens.invisible, UsdGeom.Tokens.inherited)
    for frame, pose in enumerate(camera.scene_from_gl()):
        # USD multiplies row vectors, so the matrix is transposed.
        transform.Set(Gf.Matrix4d(*pose.T.reshape(-1).tolist()), float(frame))
        visibility.Set(shown[int(camera.valid[frame])], float(frame))
        for variable, values in tracks:
            variable.Set(values[frame], float(frame))


def _define_room(stage: Any, scene: CameraScene) -> None:
    """Add the points of the room to the stage."""
    from pxr import UsdGeom, Vt

    room = UsdGeom.Points.Define(stage, _ROOM_PATH)
    points = scene.points.astype(np.float32)
    low, high = points.min(axis=0), points.max(axis=0)
    width = _POINT_WIDTH * float(np.linalg.norm(high - low))
    room.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    room.CreateWidthsAttr([width])
    room.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    room.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([low - width, high + width])))
    colours = room.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    colours.Set(Vt.Vec3fArray.FromNumpy(linear_colours(scene.colors).astype(np.float32)))


def read_camera_usd(path: Path) -> dict[str, tuple[float, FloatArray]]:
    """Read the cameras of a file that `write_camera_usd` has written.

    Returns:
        By name of the camera: its vertical field of view, radians, and the poses (T,4,4) of the camera's axes
        of computer graphics in the scene.
    """
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    frames = range(round(stage.GetEndTimeCode()) + 1)
    out = {}
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Camera):
            camera = UsdGeom.Camera(prim)
            half = 0.5 * camera.GetVerticalApertureAttr().Get() / camera.GetFocalLengthAttr().Get()
            poses = [np.array(camera.ComputeLocalToWorldTransform(float(frame))).T for frame in frames]
            out[prim.GetDisplayName()] = (2.0 * float(np.arctan(half)), np.array(poses))
    return out
