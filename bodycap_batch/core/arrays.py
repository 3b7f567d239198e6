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
    """Return `value` as a read-only array of the given dtype and shape.

    The data are copied, unless `value` is already a read-only array that owns its data.

    Args:
        value: Anything that numpy converts to an array.
        name: Name of the field, for the error message.
        shape: Expected shape; None accepts any length.
        dtype: Target dtype.
        finite: Whether NaN and infinity are refused.

    Raises:
        ValueError: The shape differs, or a value is not finite.
    """
    array = value if _is_frozen(value, dtype) else np.array(value, dtype=dtype, copy=True)
    matches = array.ndim == len(shape) and all(
        expected is None or expected == actual for expected, actual in zip(shape, array.shape, strict=True)
    )
    if not matches:
        raise ValueError(f"{name}: shape {array.shape}, expected {shape}")
    if finite and array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name}: holds NaN or infinity")
    array.flags.writeable = False
    return array


def _is_frozen(value: npt.ArrayLike, dtype: npt.DTypeLike) -> TypeGuard[npt.NDArray[Any]]:
    """Return whether `value` can be shared: read-only, contiguous and no view of another array.

    Sharing matters because the arrays of a long recording take hundreds of megabytes.
    """
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
    """Check the array field `name` of a frozen dataclass and make it read-only.

    Call this in ``__post_init__``. Arguments and errors are those of `frozen_array`.
    """
    value = frozen_array(getattr(owner, name), name=name, shape=shape, dtype=dtype, finite=finite)
    object.__setattr__(owner, name, value)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return the maximal runs [start, stop) of true values in a mask (N,), in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def evenly_spaced(count: int, limit: int) -> IntArray:
    """Return up to `limit` different, evenly spaced indices of `count` items.

    The first and the last item are included; with a limit of one, only the first.
    """
    if count <= 0:
        return np.zeros(0, dtype=np.int64)
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))
