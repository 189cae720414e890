"""Sweeps of any length as arrays of a few fixed sizes, in NumPy."""

import math
from typing import Any

import numpy as np

CAPACITY_BUCKETS: tuple[int, ...] = tuple(2**k for k in range(14, 21))
"""Point capacities that a sweep is padded to: 16,384 to 1,048,576. One compile a bucket."""

MAX_COLUMNS = 16
"""An array of more columns has a row for x, one for y and one for z instead: no source has as many fields."""

ALIGNMENT_BYTES = 64
"""XLA takes a host array without a copy where its memory starts at a multiple of this."""

BLOCK_ROWS = 8192
"""Points copied at a time: few enough to be in the cache still when their last numbers are."""


def fitting_capacity(num_points: int) -> int:
    """The smallest of `CAPACITY_BUCKETS` that holds that many points, or the largest bucket.

    Args:
      num_points: of a sweep.

    Returns:
      A capacity, which may be less than the number of points.

    >>> fitting_capacity(120_000)
    131072
    """
    return next((bucket for bucket in CAPACITY_BUCKETS if bucket >= num_points), CAPACITY_BUCKETS[-1])


def aligned_empty(shape: tuple[int, ...]) -> np.ndarray:
    """Room for an array that JAX can use without a copy.

    Args:
      shape: any.

    Returns:
      float32, anything, in memory that starts at a multiple of what XLA wants of its buffers.
    """
    num_bytes = math.prod(shape) * np.dtype(np.float32).itemsize
    memory = np.empty(num_bytes + ALIGNMENT_BYTES, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT_BYTES
    return memory[start : start + num_bytes].view(np.float32).reshape(shape)


def fill_rows(xyz: np.ndarray, intensity: np.ndarray, rows: np.ndarray, padded: np.ndarray) -> None:
    """Writes the points of a sweep into padded arrays, over whatever was there.

    Args:
      xyz: (n, 3) float32, m; where n is larger than N the N nearest points are taken, in their order.
      intensity: (n,) float32.
      rows: (N, 4) float32, written: x, y, z and 1.
      padded: (N,) float32, written: the intensity.
    """
    if len(xyz) > len(rows):
        keep = _nearest(xyz, len(rows))
        xyz, intensity = xyz[keep], intensity[keep]
    source = _rows_of_four(xyz)
    for first in range(0, len(xyz), BLOCK_ROWS):
        block = slice(first, min(first + BLOCK_ROWS, len(xyz)))
        if source is not None:
            rows[block] = source[block]
        else:
            # Column by column: NumPy copies rows of three numbers one row at a time.
            for axis in range(3):
                rows[block, axis] = xyz[block, axis]
        rows[block, 3] = 1
        padded[block] = intensity[block]
    rows[len(xyz) :] = 0
    padded[len(xyz) :] = 0


def _rows_of_four(xyz: np.ndarray) -> np.ndarray | None:
    """The rows that points are the first three numbers of, as in most files; None where they are not."""
    memory, row_bytes = xyz.base, 4 * xyz.itemsize
    if not isinstance(memory, np.ndarray) or xyz.strides != (row_bytes, xyz.itemsize):
        return None
    # Of the last three columns of four, the last row's fourth number would lie past the end.
    end = memory.ctypes.data + memory.nbytes
    if not memory.flags.c_contiguous or xyz.ctypes.data + row_bytes * len(xyz) > end:
        return None
    return np.lib.stride_tricks.as_strided(xyz, (len(xyz), 4), writeable=False)


def checked_points(xyz: np.ndarray, intensity: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Points as float32, and intensities, zeros where there are none.

    Args:
      xyz: (n, 3) real numbers; masked ones are NaN.
      intensity: (n,) real numbers, or None; masked ones are 0.

    Returns:
      (n, 3) and (n,) float32; the arrays themselves where they are float32 already.

    Raises:
      ValueError: for another shape or a non-numeric type.
    """
    xyz, intensity = unmasked(xyz, np.nan), unmasked(intensity, 0)
    xyz = np.asarray(xyz)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(
            f"xyz has shape {xyz.shape}; it must be (n, 3). Pass points[:, :3] of a wider array."
        )
    if intensity is None:
        intensity = np.zeros(len(xyz), np.float32)
    intensity = np.asarray(intensity)
    if intensity.shape != (len(xyz),):
        raise ValueError(f"intensity has shape {intensity.shape}; it must be ({len(xyz)},), one a point.")
    for name, array in (("xyz", xyz), ("intensity", intensity)):
        if array.dtype.kind not in "fiu":
            raise ValueError(f"{name} has dtype {array.dtype}; it must be real numbers.")
    # A float64 beyond float32's range becomes infinite here, and is counted as non-finite later.
    with np.errstate(over="ignore"):
        return xyz.astype(np.float32, copy=False), intensity.astype(np.float32, copy=False)


def unmasked(values: Any, filler: float) -> Any:
    """The values of an array that may have a mask, as `numpy.ma` makes them.

    Args:
      values: an array, or anything else, which stays as it is.
      filler: number in the place of those that are masked.

    Returns:
      The values without a mask.
    """
    if not isinstance(values, np.ma.MaskedArray):
        return values
    is_real = values.dtype.kind in "fiu"
    return np.where(np.ma.getmaskarray(values), filler, values.data) if is_real else values.data


def _nearest(xyz: np.ndarray, count: int) -> np.ndarray:
    """Indices, ascending, of the `count` points nearest to the sensor; non-finite ones go first."""
    with np.errstate(over="ignore", invalid="ignore"):
        distance = np.linalg.norm(xyz.astype(np.float64), axis=1)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    return np.sort(np.argsort(distance, kind="stable")[:count])
