"""Collect the arrays of a GLB file, write the file, and read arrays back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.atomic_files import atomic_replacement

FLOAT, UINT16, UINT32 = 5126, 5123, 5125
"""Numbers of the component types of an accessor. Source: glTF 2.0 specification, 3.6.2."""

COMPONENT_DTYPES: dict[int, np.dtype[Any]] = {
    FLOAT: np.dtype("<f4"),
    UINT16: np.dtype("<u2"),
    UINT32: np.dtype("<u4"),
}
ELEMENT_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}
"""Number of components of each accessor type. Source: glTF 2.0 specification, 3.6.2."""

ELEMENT_ARRAY_BUFFER, ARRAY_BUFFER = 34963, 34962
"""Numbers that state what a buffer view contains: vertex indices, or vertex attributes. Source: glTF 2.0
specification, 5.11."""


class BinaryBuffer:
    """Collects the arrays of a GLB file for its binary part. Each array has a buffer view and an accessor."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[Any] = []
        self.accessors: list[Any] = []

    def add(
        self, array: npt.NDArray[Any], kind: str, *, target: int | None = None, component: int = FLOAT
    ) -> int:
        """Append an array to the buffer.

        Args:
            array: (N,...) array.
            kind: Accessor type, a key of `ELEMENT_WIDTHS`.
            target: Target of the buffer view; None for no target.
            component: Number of the component type.

        Returns:
            The index of the accessor of the array.
        """
        import pygltflib as gl

        values = np.ascontiguousarray(array, dtype=COMPONENT_DTYPES[component])
        self.data += bytes(-len(self.data) % 4)
        view = gl.BufferView(buffer=0, byteOffset=len(self.data), byteLength=values.nbytes, target=target)
        self.views.append(view)
        flat = values.reshape(len(values), -1)
        self.accessors.append(
            gl.Accessor(
                bufferView=len(self.views) - 1,
                byteOffset=0,
                componentType=component,
                count=len(values),
                type=kind,
                min=flat.min(axis=0).tolist(),
                max=flat.max(axis=0).tolist(),
            )
        )
        self.data += values.tobytes()
        return len(self.accessors) - 1

    def animation(self, name: str, fps: float, curves: Sequence[tuple[int, str, npt.NDArray[Any]]]) -> Any:
        """Append the curves of an animation to the buffer, and return the animation.

        Args:
            name: Name of the animation.
            fps: Frames per second. The time of frame k is k / fps seconds.
            curves: For each curve, the node, its property (``rotation`` or ``translation``), and the value
                (T,C) at each frame. The values between frames are interpolated linearly.
        """
        import pygltflib as gl

        times = self.add(np.arange(len(curves[0][2])) / fps, "SCALAR")
        samplers: list[Any] = []
        channels: list[Any] = []
        for node, path, values in curves:
            output = self.add(values, f"VEC{values.shape[1]}")
            target = gl.AnimationChannelTarget(node=node, path=path)
            channels.append(gl.AnimationChannel(sampler=len(samplers), target=target))
            samplers.append(gl.AnimationSampler(input=times, output=output, interpolation="LINEAR"))
        return gl.Animation(name=name, samplers=samplers, channels=channels)

    def save(self, path: Path, **parts: Any) -> None:
        """Write a file with one scene and all arrays of the buffer.

        Args:
            path: Path of the file, which is replaced atomically.
            parts: The other parts of the document: nodes, scenes, meshes and so on.

        Raises:
            StoreError: The file cannot be written.
        """
        import pygltflib as gl

        document = gl.GLTF2(
            asset=gl.Asset(version="2.0", generator="bodycap_batch"),
            scene=0,
            accessors=self.accessors,
            bufferViews=self.views,
            buffers=[gl.Buffer(byteLength=len(self.data))],
            **parts,
        )
        document.set_binary_blob(bytes(self.data))
        with atomic_replacement(path) as temporary:
            document.save_binary(str(temporary))


def read_accessor(document: Any, accessor: int) -> FloatArray:
    """Return the values (N, number of components) of the accessor with this index."""
    entry = document.accessors[accessor]
    view = document.bufferViews[entry.bufferView]
    values = np.frombuffer(
        document.binary_blob(),
        dtype=COMPONENT_DTYPES[entry.componentType],
        count=entry.count * ELEMENT_WIDTHS[entry.type],
        offset=view.byteOffset + entry.byteOffset,
    )
    return np.asarray(values.reshape(entry.count, ELEMENT_WIDTHS[entry.type]), dtype=np.float64)
