"""One sequence as the metrics of tracking see it: identities, and the overlap of each pair in a frame."""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Self

import numpy as np

from jaxbox._extras import require

EPSILON = float(np.finfo(float).eps)
"""Overlaps reach a limit that they miss by no more than this, as in the official evaluator."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Labels that count and the results that are right or wrong, frame by frame."""

    true_ids: Sequence[np.ndarray]
    """For each of T frames (A,) int: identities of the labels, 0 to num_true_ids - 1, unique in a frame."""
    ids: Sequence[np.ndarray]
    """For each frame (B,) int: identities of the results, likewise."""
    overlaps: Sequence[np.ndarray]
    """For each frame (A, B) float64, in [0, 1]."""
    num_true_ids: int
    """Different identities among the labels."""
    num_ids: int
    """Different identities among the results."""

    @classmethod
    def of(
        cls, true_ids: Sequence[np.ndarray], ids: Sequence[np.ndarray], overlaps: Sequence[np.ndarray]
    ) -> Self:
        """Numbers the identities from 0 on.

        Args:
          true_ids: for each frame (A,) int, any numbers, unique in a frame.
          ids: for each frame (B,) int, likewise.
          overlaps: for each frame (A, B).

        Raises:
          ValueError: for an identity twice in one frame.
        """
        true_ids, num_true_ids = _renumbered(true_ids, "labels")
        ids, num_ids = _renumbered(ids, "results")
        return cls(true_ids, ids, overlaps, num_true_ids, num_ids)

    @functools.cached_property
    def true_counts(self) -> np.ndarray:
        """(num_true_ids,) int: frames of each label's identity."""
        return np.bincount(_joined(self.true_ids), minlength=self.num_true_ids)

    @functools.cached_property
    def counts(self) -> np.ndarray:
        """(num_ids,) int: frames of each result's identity."""
        return np.bincount(_joined(self.ids), minlength=self.num_ids)


def _joined(ids: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0, int), *ids]).astype(int)


def _renumbered(ids: Sequence[np.ndarray], name: str) -> tuple[list[np.ndarray], int]:
    for frame, here in enumerate(ids):
        if len(set(np.asarray(here).tolist())) < len(here):
            raise ValueError(f"{name}: frame {frame} has an identity twice; make them unique in a frame.")
    unique, numbers = np.unique(_joined(ids), return_inverse=True)
    return np.split(numbers, np.cumsum([len(here) for here in ids], dtype=int)[:-1])[: len(ids)], len(unique)


@dataclasses.dataclass(frozen=True)
class Sums:
    """Counts and sums of a sequence; those of several sequences together are their sum, field by field."""

    def __add__(self, other: Self) -> Self:
        fields = [field.name for field in dataclasses.fields(self)]
        return type(self)(*(getattr(self, name) + getattr(other, name) for name in fields))

    def to_dict(self) -> dict[str, Any]:
        """Numbers and lists only, for JSON."""
        raise NotImplementedError


def assign(benefit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs rows and columns one to one so that the sum of their benefits is greatest.

    Args:
      benefit: (A, B) real numbers.

    Returns:
      Rows and columns of the min(A, B) pairs, rows ascending.

    Raises:
      ImportError: without SciPy, naming the extra.

    >>> rows, columns = assign(np.array([[0.9, 0.8], [0.7, 0.0]]))
    >>> rows.tolist(), columns.tolist()
    ([0, 1], [1, 0])
    """
    optimize = require("scipy.optimize", extra="track", what="Metrics of tracking")
    return optimize.linear_sum_assignment(-benefit)


def assign_above(
    overlap: np.ndarray, min_overlap: float, *, bonus: np.ndarray | float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs rows and columns one to one, of those that overlap enough, so that the sum is greatest.

    Args:
      overlap: (A, B) in [0, 1].
      min_overlap: from which a pair may be taken.
      bonus: (A, B), added to the overlap of pairs that are preferred.

    Returns:
      Rows and columns of the pairs, rows ascending.
    """
    benefit = np.where(overlap < min_overlap - EPSILON, 0, overlap + bonus)
    rows, columns = assign(benefit)
    taken = benefit[rows, columns] > EPSILON
    return rows[taken], columns[taken]


def ratio(part: float, whole: float) -> float:
    """A fraction; without a whole the part itself, which is 0 for parts of nothing.

    Args:
      part: a count or a sum.
      whole: a count.

    Returns:
      part / max(whole, 1).
    """
    return float(part / max(whole, 1))
