"""Checked, read-only arrays for the frozen data types."""

from __future__ import annotations

from typing import Any, TypeGuard

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


def frozen_array(
    value: npt.ArrayLike,
    *,
    name: str,
    shape: tuple[int | None, ...],
    dtype: npt.DTypeLike = np.float64,
    finite: bool = True,
) -> npt.NDArray[Any]:
    """Copy `value` into a read-only array of the given dtype and shape.

    One that is such already is taken as it is.

    Args:
        value: Anything numpy accepts.
        name: The field's name, for the message.
        shape: Expected shape; None matches any length.
        dtype: Target dtype.
        finite: Refuse NaN and infinity.

    Raises:
        ValueError: The shape differs or a value is not finite.
    """
    array = value if _is_frozen(value, dtype) else np.array(value, dtype=dtype, copy=True)
    matches = array.ndim == len(shape) and all(
        want is None or want == got for want, got in zip(shape, array.shape, strict=True)
    )
    if not matches:
        raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: holds NaN or infinity")
    array.flags.writeable = False
    return array


def _is_frozen(value: npt.ArrayLike, dtype: npt.DTypeLike) -> TypeGuard[npt.NDArray[Any]]:
    """True for an array that nobody writes to: copies of long recordings take hundreds of megabytes."""
    if not isinstance(value, np.ndarray) or value.dtype != dtype:
        return False
    return bool(value.flags.owndata and not value.flags.writeable and value.flags.c_contiguous)


def set_array(
    owner: object,
    name: str,
    shape: tuple[int | None, ...],
    dtype: npt.DTypeLike = np.float64,
    *,
    finite: bool = True,
) -> None:
    """Check and freeze the array field `name` of a frozen dataclass in its ``__post_init__``."""
    value = frozen_array(getattr(owner, name), name=name, shape=shape, dtype=dtype, finite=finite)
    object.__setattr__(owner, name, value)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Maximal runs [start, stop) of true values in a mask (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def evenly_spaced(count: int, wanted: int) -> IntArray:
    """Up to `wanted` different indices of `count` items, evenly spaced, the first and the last among them."""
    if count <= 0:
        return np.zeros(0, dtype=np.int64)
    return np.unique(np.linspace(0, count - 1, min(count, wanted)).round().astype(np.int64))
