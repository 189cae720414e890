"""Plots of the evaluation with matplotlib, the ``plots`` extra (paper, figures 12 and 13)."""

import os
import pathlib
from typing import TYPE_CHECKING

import numpy as np

from jaxbox._files import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIMENSIONS = ("length", "width", "height")
ROW_NAME = "matched vehicle"
_ESTIMATE_COLORS = ("tab:blue", "tab:orange", "tab:green")


def _new_figure(rows: int) -> "Figure":
    # A Figure of its own: no global state, no window, whatever backend the user has chosen.
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 (an extra: imported where it is used)
    except ImportError as error:
        raise ImportError("plots need matplotlib: pip install 'jaxbox[plots]'") from error
    return Figure(figsize=(10, 2.2 + 2.2 * rows), layout="constrained")


def _checked_sizes(estimated: np.ndarray, true: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    estimated, true = np.asarray(estimated, np.float64), np.asarray(true, np.float64)
    if estimated.shape != true.shape or estimated.ndim != 2 or estimated.shape[1] != 3:
        raise ValueError(
            f"estimated has shape {estimated.shape} and true {true.shape}; both must be (n, 3): "
            "length, width, height, one row a matched vehicle."
        )
    return estimated, true


def plot_dimensions(
    estimated: np.ndarray, true: np.ndarray, *, title: str = "", row_name: str = ROW_NAME
) -> "Figure":
    """Plots estimated and true length, width and height over the matched vehicles (figure 12).

    Args:
      estimated: (n, 3) m: length, width, height.
      true: (n, 3) m, row by row the same vehicles.
      title: title of the figure.
      row_name: what a row is.

    Returns:
      A matplotlib figure; write it with `save_figure`.

    Raises:
      ImportError: without matplotlib, with the command that installs it.
      ValueError: for other shapes.
    """
    estimated, true = _checked_sizes(estimated, true)
    figure = _new_figure(3)
    frames = np.arange(1, len(true) + 1)
    for axis, (name, color) in enumerate(zip(DIMENSIONS, _ESTIMATE_COLORS, strict=True)):
        axes = figure.add_subplot(3, 1, axis + 1)
        axes.plot(frames, true[:, axis], "k.-", linewidth=1, label="true")
        axes.plot(
            frames, estimated[:, axis], "o--", color=color, markersize=4, linewidth=1, label="estimated"
        )
        axes.set_ylabel(f"{name} (m)")
        axes.locator_params(axis="x", integer=True)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.axes[-1].set_xlabel(row_name)
    figure.suptitle(title or f"Estimated and true dimensions of {len(true)} matched vehicles")
    return figure


def plot_residuals(
    estimated: np.ndarray, true: np.ndarray, *, title: str = "", row_name: str = ROW_NAME
) -> "Figure":
    """Plots estimated minus true length, width and height (figure 13).

    Args:
      estimated: (n, 3) m: length, width, height.
      true: (n, 3) m, row by row the same vehicles.
      title: title of the figure.
      row_name: what a row is.

    Returns:
      A matplotlib figure; write it with `save_figure`.

    Raises:
      ImportError: without matplotlib, with the command that installs it.
      ValueError: for other shapes.
    """
    estimated, true = _checked_sizes(estimated, true)
    figure = _new_figure(1)
    axes = figure.add_subplot()
    residuals = estimated - true
    frames = np.arange(1, len(true) + 1)
    for axis, (name, color) in enumerate(zip(DIMENSIONS, _ESTIMATE_COLORS, strict=True)):
        mean = f", mean {residuals[:, axis].mean():+.2f} m" if len(residuals) else ""
        axes.plot(frames, residuals[:, axis], "o-", color=color, markersize=4, label=f"{name}{mean}")
    axes.axhline(0.0, color="k", linewidth=1)
    axes.set_xlabel(row_name)
    axes.set_ylabel("estimated - true (m)")
    axes.locator_params(axis="x", integer=True)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.suptitle(title or f"Residuals of {len(true)} matched vehicles (below 0: underestimated)")
    return figure


def save_figure(path: str | os.PathLike[str], figure: "Figure") -> pathlib.Path:
    """Writes a figure as PNG, under a temporary name first, and returns the path."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
    return pathlib.Path(path)
