"""Checked, read-only arrays for the fields of frozen dataclasses."""

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

    If `value` is a read-only array that owns its data, it is returned without a copy. Otherwise the data are
    copied.

    Args:
        value: Any value that numpy can convert to an array.
        name: Name of the field, for the error message.
        shape: Expected length of each axis. If the expected length is None, any length is accepted.
        dtype: Type of the elements of the returned array.
        finite: True to refuse NaN and infinity.

    Raises:
        ValueError: The array does not have the expected shape, or a value is not finite.
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
    """Return True if `value` can be used without a copy.

    For this, `value` must be a read-only, contiguous array of type `dtype` that owns its data. Copies are
    avoided because the arrays of a long recording take hundreds of megabytes.
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

    Call this function in ``__post_init__``. See `frozen_array` for the other arguments and for the errors.
    """
    value = frozen_array(getattr(owner, name), name=name, shape=shape, dtype=dtype, finite=finite)
    object.__setattr__(owner, name, value)


def runs(mask: BoolArray) -> list[tuple[int, int]]:
    """Return the ranges [start, stop) of successive True values in a mask (N,), in increasing order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2], strict=True)]


def interpolated(at: FloatArray, knots: FloatArray, values: FloatArray) -> FloatArray:
    """Return values (T,K) at places (T,): linear interpolation of values (N,K) at increasing knots (N,)."""
    return np.stack([np.interp(at, knots, column) for column in values.T], axis=1)


def evenly_spaced(count: int, limit: int) -> IntArray:
    """Return at most `limit` evenly spaced indices of `count` items, without repetitions.

    The indices include the first and the last item. If the limit is one, they include only the first item.
    """
    if count <= 0:
        return np.zeros(0, dtype=np.int64)
    return np.unique(np.linspace(0, count - 1, min(count, limit)).round().astype(np.int64))


def true_spans(mask: BoolArray) -> list[list[int]]:
    """Return the first and the last index of each series of True in a mask (T,)."""
    return [[start, stop - 1] for start, stop in runs(mask)]


def json_numbers(values: FloatArray, decimals: int) -> list[float | None]:
    """Return rounded values (T,) as JSON values; None for NaN."""
    return [value if np.isfinite(value) else None for value in np.round(values, decimals).tolist()]
