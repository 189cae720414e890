"""Errors of estimated dimensions and directions of matched boxes (paper, section 4.6).

Most cars are of nearly one size, so always answering the median car does well in every one of these
measures: a table of size errors means something only next to that constant's, `constant_sizes`.
"""

import dataclasses
from typing import Any

import numpy as np

from jaxbox.evaluation.iou import dimension_iou

DIMENSIONS = ("length", "width", "height")

MEDIAN_CAR_SIZE_M = (3.88, 1.63, 1.50)
"""Length, width, height: medians of the cars, easy to hard, of KITTI's 7,481 labelled training frames."""

_SWAP_RAD = np.pi / 4


@dataclasses.dataclass(frozen=True)
class DimensionErrors:
    """Errors of one dimension, or of all three pooled, over matched boxes. None where there are none."""

    num: int
    """Pairs of an estimated and a true dimension."""
    mae: float | None
    """m: mean absolute error."""
    rmse: float | None
    """m: root mean squared error."""
    bias: float | None
    """m: mean residual, estimated minus true; negative where the estimate is too small."""
    percent: float | None
    """Mean absolute error relative to the true dimension, in percent."""
    pearson: float | None
    """Correlation of estimated and true, in [-1, 1]; None also where either does not vary."""
    mean_iou: float | None
    """Mean of the shorter over the longer, in [0, 1]."""
    min_iou: float | None
    """Least of these."""
    max_iou: float | None
    """Largest of these."""

    def to_dict(self) -> dict[str, Any]:
        """Numbers and None only, for JSON."""
        return dataclasses.asdict(self)


def dimension_errors(estimated: np.ndarray, true: np.ndarray) -> DimensionErrors:
    """Errors of estimated dimensions, all pooled.

    Args:
      estimated: any shape, m.
      true: the same shape, m, above 0.

    Returns:
      The errors; None in each field where there is nothing to average.

    Raises:
      ValueError: for different shapes, or a true dimension that is not above 0.

    >>> errors = dimension_errors(np.array([3.0, 5.0]), np.array([4.0, 4.0]))
    >>> errors.mae, errors.bias, errors.percent
    (1.0, 0.0, 25.0)
    """
    estimated, true = np.asarray(estimated, float).ravel(), np.asarray(true, float).ravel()
    if estimated.shape != true.shape:
        raise ValueError(f"{estimated.size} estimated dimensions for {true.size} true ones.")
    if not np.all(true > 0):
        raise ValueError(f"a true dimension is {true.min()} m; it must be above 0. Fix the label.")
    if not len(true):
        return DimensionErrors(0, *[None] * (len(dataclasses.fields(DimensionErrors)) - 1))
    residual, iou = estimated - true, dimension_iou(estimated, true)
    return DimensionErrors(
        num=len(true),
        mae=float(np.mean(np.abs(residual))),
        rmse=float(np.sqrt(np.mean(residual**2))),
        bias=float(np.mean(residual)),
        percent=100 * float(np.mean(np.abs(residual) / true)),
        pearson=_pearson(estimated, true),
        mean_iou=float(iou.mean()),
        min_iou=float(iou.min()),
        max_iou=float(iou.max()),
    )


def _pearson(estimated: np.ndarray, true: np.ndarray) -> float | None:
    if np.ptp(estimated) == 0 or np.ptp(true) == 0:
        return None
    return float(np.corrcoef(estimated, true)[0, 1])


def size_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, DimensionErrors]:
    """Errors of length, width and height, each and pooled.

    Args:
      estimated: (n, 3) m: length, width, height.
      true: (n, 3) m.

    Returns:
      The errors under "length", "width", "height" and "pooled".

    Raises:
      ValueError: as `dimension_errors`.
    """
    estimated, true = np.reshape(estimated, (-1, 3)), np.reshape(true, (-1, 3))
    errors = {name: dimension_errors(estimated[:, i], true[:, i]) for i, name in enumerate(DIMENSIONS)}
    return errors | {"pooled": dimension_errors(estimated, true)}


def constant_sizes(num: int) -> np.ndarray:
    """The answer that knows nothing: the median car, whatever was seen.

    Args:
      num: how many times.

    Returns:
      (num, 3) m: length, width, height.
    """
    return np.tile(MEDIAN_CAR_SIZE_M, (num, 1))


def axis_differences(yaw_a: np.ndarray, yaw_b: np.ndarray) -> np.ndarray:
    """Angles between axes, which have no front.

    Args:
      yaw_a: (...) rad.
      yaw_b: (...) rad.

    Returns:
      (...) rad, in [0, pi/2].

    >>> float(np.degrees(axis_differences(np.radians(89.0), np.radians(-89.0))).round(6))
    2.0
    """
    turn = np.mod(np.asarray(yaw_a, float) - yaw_b, np.pi)
    return np.minimum(turn, np.pi - turn)


@dataclasses.dataclass(frozen=True)
class YawErrors:
    """Errors of direction over matched boxes."""

    num: int
    """Matched boxes."""
    median_deg: float | None
    """Median of the angle between the length axes; None without boxes."""
    p90_deg: float | None
    """90th percentile of it; None without boxes."""
    num_axis_swaps: int
    """Boxes turned by more than 45 degrees: length and width have changed places."""

    def to_dict(self) -> dict[str, Any]:
        """Numbers and None only, for JSON."""
        return dataclasses.asdict(self)


def yaw_errors(estimated: np.ndarray, true: np.ndarray) -> YawErrors:
    """Errors of the direction of the length axis.

    Args:
      estimated: (n,) rad.
      true: (n,) rad.

    Returns:
      The errors.
    """
    error = axis_differences(estimated, true)
    if not len(error):
        return YawErrors(0, None, None, 0)
    median, p90 = np.degrees(np.percentile(error, [50, 90]))
    return YawErrors(len(error), float(median), float(p90), int(np.sum(error > _SWAP_RAD)))
