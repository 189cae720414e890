"""Which beam made each point, and sweeps as a sensor of fewer beams would have seen them.

Files of spinning sensors often hold one beam after the other, each in one turn of the azimuth: KITTI's,
SemanticKITTI's and `jaxbox.synthetic`'s do. There a beam ends where the azimuth falls back. Files in the
order of time, or moved to another frame, do not tell.
"""

import numpy as np

_MIN_BACK_RAD = np.pi
"""The azimuth of a beam falls back by nearly a turn; by less where the sensor's noise turns it back."""
_LARGE_STEP_RAD = 0.5
_MAX_LARGE_SHARE = 0.05
"""Of the steps in azimuth that many may be so large: where the view is blocked."""
_MAX_MISSING = 0.1
"""Beams of a sensor that may leave no trace in a sweep, as a share."""


def beam_of_points(xyz: np.ndarray) -> np.ndarray:
    """Numbers the beams of a sweep that holds one beam after the other.

    The azimuth, in [0, 2 pi) from +x, steps from one end to the other between two beams, and nowhere else
    but where the points of one beam are turned back over +x by noise: such a pair of steps cancels out.

    Args:
      xyz: (n, 3) m, sensor frame, in the order of the file.

    Returns:
      (n,) int, from 0 in the file's order, never falling; NaN and infinity belong to the beam before them.
      Other orders give as many "beams" as there are such steps, which is for the caller to judge.

    >>> turn = np.radians(np.arange(0, 360, 90))
    >>> beam_of_points(np.tile(np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]), (2, 1))).tolist()
    [0, 0, 0, 0, 1, 1, 1, 1]
    """
    finite = np.isfinite(xyz).all(axis=1)
    azimuth = np.arctan2(xyz[finite, 1].astype(np.float64), xyz[finite, 0]) % (2 * np.pi)
    step = np.diff(azimuth, prepend=azimuth[:1])
    direction = -1.0 if np.sum(step > 0) < np.sum(step < 0) else 1.0
    # A jump back by a turn is a new beam, unless the next jump goes forward by a turn.
    turns = np.cumsum((direction * step < -_MIN_BACK_RAD).astype(int) - (direction * step > _MIN_BACK_RAD))
    beam = np.zeros(len(xyz), int)
    beam[finite] = np.maximum.accumulate(turns) if len(turns) else 0
    return np.maximum.accumulate(beam) if len(beam) else beam


def goes_beam_by_beam(xyz: np.ndarray) -> bool:
    """Whether the points of a sweep can be in the order of beams: each next to the one before.

    Args:
      xyz: (n, 3) m, sensor frame.

    Returns:
      False where more than a few steps in azimuth are large, as in a shuffled sweep.
    """
    finite = np.isfinite(xyz).all(axis=1)
    azimuth = np.arctan2(xyz[finite, 1].astype(np.float64), xyz[finite, 0])
    step = np.abs(np.angle(np.exp(1j * np.diff(azimuth))))
    return len(step) == 0 or bool(np.mean(step > _LARGE_STEP_RAD) < _MAX_LARGE_SHARE)


def thin_beams(xyz: np.ndarray, *, num_beams: int, keep_every: int, first: int = 0) -> np.ndarray:
    """Which points a sensor would have seen that has every second beam only, or every fourth, ...

    Args:
      xyz: (n, 3) m, sensor frame, one beam after the other, as `beam_of_points` needs it.
      num_beams: of the sensor; what is found must agree, or the file is in another order.
      keep_every: 1 keeps all beams, 2 every second.
      first: the first beam that is kept, below `keep_every`.

    Returns:
      (n,) bool: points to keep.

    Raises:
      ValueError: where the points are not in the order of beams, or the numbers make no sense.

    >>> turn = np.radians(np.arange(0, 360, 10))
    >>> sweep = np.tile(np.column_stack([np.cos(turn), np.sin(turn), 0 * turn]), (2, 1))
    >>> thin_beams(sweep, num_beams=2, keep_every=2, first=1).nonzero()[0][[0, -1]].tolist()
    [36, 71]
    """
    if keep_every < 1 or not 0 <= first < keep_every:
        raise ValueError(
            f"keep_every is {keep_every} and first {first}; they must be at least 1, and in [0, keep_every)."
        )
    beam = beam_of_points(xyz)
    found = int(beam.max(initial=-1)) + 1
    # A beam without a return leaves no trace; a first or last point beyond the cut is a beam more.
    if len(xyz) and (not goes_beam_by_beam(xyz) or abs(found - num_beams) > max(1, _MAX_MISSING * num_beams)):
        raise ValueError(
            f"the azimuth turns {found} times and the sensor has {num_beams} beams: the points are not in "
            "the order of beams. Take the sensor's own files, before they are sorted or moved."
        )
    return beam % keep_every == first
