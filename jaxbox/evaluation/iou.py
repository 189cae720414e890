"""Overlap of boxes: in the bird's-eye view, in 3D, in the image, and of single dimensions."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox.geometry import planar

# Lists of pairs are padded to powers of two from this one on, so that few lengths are ever compiled.
_MIN_PAIRS = 1024


def box_overlaps(box_a: jax.Array, box_b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Overlap of two upright boxes, seen from above and in 3D.

    The 3D overlap is (shared area x shared height) / (volume a + volume b - shared volume).

    Args:
      box_a: (7,) float, m and rad: x, y, z of the centre, length, width, height, yaw; z is up.
      box_b: (7,), likewise. Batch both with `jax.vmap`.

    Returns:
      The bird's-eye IoU and the 3D IoU, each () in [0, 1], and 0 where a box is empty.
    """
    bev_a, bev_b = _footprint(box_a), _footprint(box_b)
    area = planar.rectangle_intersection(bev_a, bev_b)
    top = jnp.minimum(box_a[2] + box_a[5] / 2, box_b[2] + box_b[5] / 2)
    bottom = jnp.maximum(box_a[2] - box_a[5] / 2, box_b[2] - box_b[5] / 2)
    shared = area * jnp.maximum(top - bottom, 0)
    union = jnp.prod(box_a[3:6]) + jnp.prod(box_b[3:6]) - shared
    return planar.rectangle_iou(bev_a, bev_b), jnp.where(
        union > 0, shared / jnp.where(union > 0, union, 1), 0
    )


def _footprint(box: jax.Array) -> jax.Array:
    return jnp.stack([box[0], box[1], box[3], box[4], box[6]])


_batched_overlaps = jax.jit(jax.vmap(box_overlaps))


def paired_overlaps(boxes_a: np.ndarray, boxes_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Overlaps of two lists of boxes, row by row.

    Args:
      boxes_a: (P, 7) real numbers, m and rad: x, y, z of the centre, length, width, height, yaw.
      boxes_b: (P, 7), likewise.

    Returns:
      Bird's-eye IoU and 3D IoU, each (P,) float64 in [0, 1].

    Raises:
      ValueError: for another shape, or lists of different length.

    >>> boxes = np.array([[20.0, 0.0, -1.0, 4.0, 2.0, 1.5, 0.0]])
    >>> bev, box = paired_overlaps(boxes, boxes + [2.0, 0, 0, 0, 0, 0, 0])
    >>> bev.round(3).tolist(), box.round(3).tolist()
    ([0.333], [0.333])
    """
    boxes_a, boxes_b = np.asarray(boxes_a, float), np.asarray(boxes_b, float)
    if boxes_a.shape != boxes_b.shape or boxes_a.ndim != 2 or boxes_a.shape[1] != 7:
        raise ValueError(f"the boxes have shapes {boxes_a.shape} and {boxes_b.shape}; both must be (P, 7).")
    num_pairs = len(boxes_a)
    capacity = max(_MIN_PAIRS, 2 ** max(num_pairs - 1, 0).bit_length())
    padded = np.zeros((2, capacity, 7), np.float32)
    # Relative to one of the two in float64, because float32 keeps only centimetres of map coordinates.
    padded[0, :num_pairs] = boxes_a
    padded[0, :num_pairs, :3] = boxes_a[:, :3] - boxes_b[:, :3]
    padded[1, :num_pairs, 3:] = boxes_b[:, 3:]
    bev, box = _batched_overlaps(jnp.asarray(padded[0]), jnp.asarray(padded[1]))
    return np.asarray(bev, float)[:num_pairs], np.asarray(box, float)[:num_pairs]


def pairwise_overlaps(boxes_a: np.ndarray, boxes_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Overlaps of every box of one list with every box of another.

    Args:
      boxes_a: (A, 7) real numbers, m and rad: x, y, z of the centre, length, width, height, yaw.
      boxes_b: (B, 7), likewise.

    Returns:
      Bird's-eye IoU and 3D IoU, each (A, B) float64 in [0, 1].
    """
    return framewise_overlaps([(boxes_a, boxes_b)])[0]


def framewise_overlaps(
    frames: Sequence[tuple[np.ndarray, np.ndarray]],
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Overlaps of every first box with every second box of the same frame, in one compiled call.

    Args:
      frames: for each frame, boxes (A, 7) and (B, 7) as for `pairwise_overlaps`.

    Returns:
      For each frame, the bird's-eye IoU and the 3D IoU, each (A, B) float64 in [0, 1].
    """
    shapes = [(len(a), len(b)) for a, b in frames]
    empty = np.zeros((0, 7))
    rows_a = np.concatenate([empty, *(np.repeat(np.reshape(a, (-1, 7)), len(b), axis=0) for a, b in frames)])
    rows_b = np.concatenate([empty, *(np.tile(np.reshape(b, (-1, 7)), (len(a), 1)) for a, b in frames)])
    bev, box = paired_overlaps(rows_a, rows_b)
    ends = np.cumsum([rows * columns for rows, columns in shapes], dtype=int)[:-1]
    # Splitting nothing still gives one part; without frames there is none to give.
    parts = zip(shapes, np.split(bev, ends), np.split(box, ends), strict=False)
    return [(b.reshape(shape), v.reshape(shape)) for shape, b, v in parts]


def image_intersections(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """Areas that axis-aligned image boxes share.

    Args:
      boxes_a: (A, 4) real numbers, px: left, top, right, bottom.
      boxes_b: (B, 4), likewise.

    Returns:
      (A, B) float64, px^2, at least 0.
    """
    a, b = np.reshape(boxes_a, (-1, 1, 4)).astype(float), np.reshape(boxes_b, (1, -1, 4)).astype(float)
    sides = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    return np.prod(np.maximum(sides, 0), axis=-1)


def image_areas(boxes: np.ndarray) -> np.ndarray:
    """Areas of axis-aligned image boxes.

    Args:
      boxes: (B, 4) real numbers, px: left, top, right, bottom.

    Returns:
      (B,) float64, px^2.
    """
    boxes = np.reshape(boxes, (-1, 4)).astype(float)
    return np.prod(boxes[:, 2:] - boxes[:, :2], axis=-1)


def image_iou(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """Intersection over union of axis-aligned image boxes.

    Args:
      boxes_a: (A, 4) real numbers, px: left, top, right, bottom.
      boxes_b: (B, 4), likewise.

    Returns:
      (A, B) float64 in [0, 1]; 0 where both boxes are empty.

    >>> image_iou(np.array([[0, 0, 2, 2]]), np.array([[1, 0, 3, 2], [5, 5, 6, 6]])).round(3).tolist()
    [[0.333, 0.0]]
    """
    shared = image_intersections(boxes_a, boxes_b)
    union = image_areas(boxes_a)[:, None] + image_areas(boxes_b)[None, :] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def image_fractions(boxes_a: np.ndarray, boxes_b: np.ndarray) -> np.ndarray:
    """Fraction of each first image box that each second one covers (KITTI's rule for DontCare regions).

    Args:
      boxes_a: (A, 4) real numbers, px: left, top, right, bottom.
      boxes_b: (B, 4), likewise.

    Returns:
      (A, B) float64 in [0, 1]; 0 where the first is empty.
    """
    shared = image_intersections(boxes_a, boxes_b)
    area = np.broadcast_to(image_areas(boxes_a)[:, None], shared.shape)
    return np.divide(shared, area, out=np.zeros_like(shared), where=area > 0)


def dimension_iou(size_a: np.ndarray, size_b: np.ndarray) -> np.ndarray:
    """Intersection over union of two dimensions laid on the same start: the shorter over the longer.

    Args:
      size_a: (...) real numbers, m, not negative.
      size_b: (...), likewise.

    Returns:
      (...) float64 in [0, 1]; 1 where both are 0.

    >>> float(dimension_iou(np.array(3.0), np.array(4.0)))
    0.75
    """
    longer = np.maximum(size_a, size_b).astype(float)
    return np.divide(np.minimum(size_a, size_b), longer, out=np.ones_like(longer), where=longer > 0)
