"""Colours of points and boxes, red green blue."""

import cv2
import numpy as np

Color = tuple[int, int, int]

BACKGROUND: Color = (16, 20, 26)
INK: Color = (226, 230, 236)
FAINT: Color = (96, 106, 120)
UNASSIGNED: Color = (92, 98, 108)
"""Points of no cluster."""
ESTIMATE: Color = (255, 190, 40)
"""A box of the detector, and a right one where there is truth."""
FALSE_ALARM: Color = (255, 70, 70)
TRUTH: Color = (70, 225, 120)
MISS: Color = (255, 90, 235)
HULL: Color = (120, 215, 255)
LOOSE: Color = (90, 190, 255)
"""A box that found its vehicle but fits it badly."""
IGNORED: Color = (158, 162, 170)
"""What is neither right nor wrong."""

LOW_M, HIGH_M = -0.3, 3.0
"""Heights above the ground that the colour scale spans: a little below the road to a van's roof."""

_DARK, _SHADES = (52, 56, 64), 84

PALETTE_SIZE = 512
"""Ids that differ by a multiple of this share a colour."""
GOLDEN_TURN = 0.61803398875
"""Hues that advance by this share of the circle never come close for neighbouring ids."""


def color_by_height(height: np.ndarray, *, low_m: float = LOW_M, high_m: float = HIGH_M) -> np.ndarray:
    """Colours heights from blue (low) over green to red (high).

    Args:
      height: (n,) real numbers, m.
      low_m: height of the lowest colour, m.
      high_m: height of the highest colour, m.

    Returns:
      (n, 3) uint8.

    >>> color_by_height(np.array([0.0, 2.0])).shape
    (2, 3)
    """
    share = (np.asarray(height, np.float64) - low_m) / (high_m - low_m)
    level = (255 * np.clip(np.nan_to_num(share), 0.0, 1.0)).astype(np.uint8)
    # The ends of the scale are too dark on a dark ground, so they are not used.
    level = (20 + level.astype(np.int64) * 215 // 255).astype(np.uint8)
    scale = cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO)
    return np.ascontiguousarray(scale[:, 0, ::-1])[level]


def shade_by_height(height: np.ndarray, *, low_m: float = LOW_M, high_m: float = HIGH_M) -> np.ndarray:
    """Greys for heights from dark (low) to light (high), for pictures whose colours mean something else.

    Args:
      height: (n,) real numbers, m.
      low_m: height of the darkest grey, m.
      high_m: height of the lightest grey, m.

    Returns:
      (n, 3) uint8.

    >>> shade_by_height(np.array([-9.0, 9.0])).tolist()
    [[52, 56, 64], [136, 140, 148]]
    """
    share = np.clip(np.nan_to_num((np.asarray(height, np.float64) - low_m) / (high_m - low_m)), 0.0, 1.0)
    return (np.array(_DARK) + share[:, None] * _SHADES).astype(np.uint8)


def color_by_id(ids: np.ndarray) -> np.ndarray:
    """Colours ids so that neighbouring ones differ; the same id always has the same colour.

    Args:
      ids: (n,) integers; negative ones mean none and are grey.

    Returns:
      (n, 3) uint8.

    >>> color_by_id(np.array([-1])).tolist()
    [[92, 98, 108]]
    """
    ids = np.asarray(ids, np.int64)
    return np.where(ids[:, None] < 0, np.array(UNASSIGNED, np.uint8), _palette()[ids % PALETTE_SIZE])


def _palette() -> np.ndarray:
    """(PALETTE_SIZE, 3) uint8, always computed as a whole: OpenCV rounds short rows otherwise."""
    ids = np.arange(PALETTE_SIZE)
    hue = (ids * GOLDEN_TURN) % 1.0 * 180
    hsv = np.stack([hue, 140 + (ids * 37) % 90, np.full(PALETTE_SIZE, 255)], axis=-1)
    return cv2.cvtColor(hsv.astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0]


def in_linear_light(colors: np.ndarray) -> np.ndarray:
    """Colours as renderers blend them: proportional to light, and not encoded for a screen.

    Args:
      colors: (..., 3) uint8, sRGB.

    Returns:
      (..., 3) uint8, linear.

    Reference: IEC 61966-2-1, the sRGB transfer function.

    >>> in_linear_light(np.array([255, 190, 40], np.uint8)).tolist()
    [255, 131, 5]
    """
    share = np.asarray(colors, np.float64) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)
