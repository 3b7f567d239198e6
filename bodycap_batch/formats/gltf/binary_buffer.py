"""Collect the arrays of a GLB file."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from bodycap_batch.formats.gltf.axes import COMPONENT_DTYPES, FLOAT


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
