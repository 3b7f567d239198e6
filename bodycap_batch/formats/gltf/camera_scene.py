"""Write animated cameras and the points of a room as GLB files, and read them back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.gltf.binary_buffer import ARRAY_BUFFER, BinaryBuffer, read_accessor
from bodycap_batch.formats.palette import linear_colours
from bodycap_batch.formats.y_up import Y_UP_FROM_WORLD, camera_poses_with_y_up, poses_from_y_up
from bodycap_batch.model.animated_camera import NEAR_PLANE, AnimatedCamera, CameraScene
from bodycap_batch.model.geometry import (
    continuous_quat_xyzw,
    quat_xyzw_from_rotation,
    rotation_from_quat_xyzw,
)

_POINTS = 0
"""Number of the mode of a primitive that consists of points. Source: glTF 2.0 specification, 5.24.4."""


def write_camera_glb(path: Path, scene: CameraScene) -> Path:
    """Write cameras with a key at every frame, and the room as a mesh of points.

    The time of frame k is k / fps seconds. The extras of the file hold the take, the exact rate and the start
    timecode. The extras of each camera's node hold its lens, and for each frame the validity and the standard
    deviation. A frame that is not valid keeps the last pose.

    Args:
        path: Path of the file, which is replaced atomically.
        scene: The cameras and the points.

    Returns:
        The path of the file.

    Raises:
        StoreError: The file cannot be written.
    """
    import pygltflib as gl

    buffer, cameras = BinaryBuffer(), scene.cameras
    count = len(cameras)
    meshes = []
    if len(scene.points):
        attributes = gl.Attributes(
            POSITION=buffer.add(scene.points @ Y_UP_FROM_WORLD.T, "VEC3", target=ARRAY_BUFFER),
            COLOR_0=buffer.add(linear_colours(scene.colors), "VEC3", target=ARRAY_BUFFER),
        )
        meshes = [gl.Mesh(name="Room", primitives=[gl.Primitive(attributes=attributes, mode=_POINTS)])]
    top = list(range(count + len(meshes)))
    animation = _camera_animation(scene, buffer)
    buffer.save(
        path,
        scenes=[gl.Scene(nodes=top)],
        nodes=[
            *(_camera_node(camera, index) for index, camera in enumerate(cameras)),
            *(gl.Node(name="Room", mesh=0) for _ in meshes),
        ],
        cameras=[
            gl.Camera(
                name=camera.name,
                type="perspective",
                perspective=gl.Perspective(
                    yfov=camera.vertical_fov_rad,
                    aspectRatio=camera.pinhole.width_px / camera.pinhole.height_px,
                    znear=NEAR_PLANE,
                ),
            )
            for camera in cameras
        ],
        meshes=meshes,
        animations=[animation],
        extras=scene.figures(),
    )
    return path


def _camera_node(camera: AnimatedCamera, index: int) -> Any:
    """Return the node of a camera, with its pose at the first frame."""
    import pygltflib as gl

    first = camera_poses_with_y_up(camera)[0]
    return gl.Node(
        name=camera.name,
        camera=index,
        translation=first[:3, 3].tolist(),
        rotation=quat_xyzw_from_rotation(first[:3, :3]).tolist(),
        extras=camera.figures(),
    )


def _camera_animation(scene: CameraScene, buffer: BinaryBuffer) -> Any:
    """Return the animation of all cameras."""
    curves = []
    for node, camera in enumerate(scene.cameras):
        poses = camera_poses_with_y_up(camera)
        curves.append((node, "rotation", continuous_quat_xyzw(poses[:, :3, :3])))
        curves.append((node, "translation", poses[:, :3, 3]))
    return buffer.animation(scene.take.name or "Cameras", scene.take.fps, curves)


def read_camera_glb(path: Path) -> dict[str, tuple[float, FloatArray]]:
    """Read the cameras of a file that `write_camera_glb` has written.

    Returns:
        By name of the camera: its vertical field of view, radians, and the poses (T,4,4) of the camera's axes
        of computer graphics in the axes of the scene.
    """
    import pygltflib as gl

    document = gl.GLTF2.load_binary(str(path))
    assert document is not None
    (animation,) = document.animations
    found: dict[int, dict[str, FloatArray]] = {}
    for channel in animation.channels:
        values = read_accessor(document, animation.samplers[channel.sampler].output)
        found.setdefault(channel.target.node, {})[channel.target.path] = values
    out = {}
    for number, curves in found.items():
        node = document.nodes[number]
        poses = poses_from_y_up(rotation_from_quat_xyzw(curves["rotation"]), curves["translation"])
        out[node.name] = (float(document.cameras[node.camera].perspective.yfov), poses)
    return out
