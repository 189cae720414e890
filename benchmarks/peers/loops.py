"""The simple chain as hand-written loops: filter, plane, components, extents, angle search; one thread.

It is the floor: what the arithmetic costs a compiler that is given loops rather than arrays. A program of
arrays that is as fast wastes nothing.
"""

# pyright: reportMissingImports=false
# A peer may be missing.

import math

import numba
import numpy as np

HALF_X_M, HALF_Y_M = 80.0, 48.0
CELL_M = 1.0
LEVELS = 6
LOWEST_M = -3.0
SPREAD = 2.0
"""Points farther than the mean distance to their cell's centre and that many deviations are outliers."""
SAMPLES = 4096
FIT_POINTS = 96
"""Points of a cluster that the angle search looks at."""
ANGLES = 90


@numba.njit(cache=True, fastmath=True)
def _filter(xyz: np.ndarray) -> np.ndarray:
    nx, ny = int(2 * HALF_X_M / CELL_M), int(2 * HALF_Y_M / CELL_M)
    sums = np.zeros((nx * ny * LEVELS, 4), np.float32)
    cell = np.empty(len(xyz), np.int32)
    for i in range(len(xyz)):
        x, y, z = xyz[i]
        a, b = int((x + HALF_X_M) / CELL_M), int((y + HALF_Y_M) / CELL_M)
        c = min(max(int((z - LOWEST_M) / CELL_M), 0), LEVELS - 1)
        a, b = min(max(a, 0), nx - 1), min(max(b, 0), ny - 1)
        cell[i] = (a * ny + b) * LEVELS + c
        row = sums[cell[i]]
        row[0] += x
        row[1] += y
        row[2] += z
        row[3] += 1
    distance = np.empty(len(xyz), np.float32)
    total = total_sq = 0.0
    for i in range(len(xyz)):
        row = sums[cell[i]]
        scale = 1 / row[3]
        dx, dy, dz = xyz[i, 0] - row[0] * scale, xyz[i, 1] - row[1] * scale, xyz[i, 2] - row[2] * scale
        distance[i] = math.sqrt(dx * dx + dy * dy + dz * dz)
        total += distance[i]
        total_sq += distance[i] * distance[i]
    mean = total / max(len(xyz), 1)
    limit = mean + SPREAD * math.sqrt(max(total_sq / max(len(xyz), 1) - mean * mean, 0))
    return distance <= limit


@numba.njit(cache=True, fastmath=True)
def _plane(
    xyz: np.ndarray, inlier: np.ndarray, hypotheses: int, tolerance: float, rng: np.random.Generator
) -> np.ndarray:
    """(3,) a, b, c of z = a x + b y + c with the most of a sample's points."""
    step = max(len(xyz) // SAMPLES, 1)
    sample = np.empty((len(xyz) // step + 1, 3), np.float32)
    count = 0
    for i in range(0, len(xyz), step):
        if inlier[i] and xyz[i, 2] < -0.5:
            sample[count] = xyz[i]
            count += 1
    best, most = np.array([0.0, 0.0, -1.73]), -1
    for _ in range(hypotheses if count >= 3 else 0):
        p, q, r = (
            sample[rng.integers(0, count)],
            sample[rng.integers(0, count)],
            sample[rng.integers(0, count)],
        )
        ax, ay, az = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        bx, by, bz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        nz = ax * by - ay * bx
        if abs(nz) < 1e-3:
            continue
        a, b = -(ay * bz - az * by) / nz, -(az * bx - ax * bz) / nz
        if a * a + b * b > 0.04:
            continue
        c = p[2] - a * p[0] - b * p[1]
        votes = 0
        for i in range(count):
            votes += abs(sample[i, 2] - a * sample[i, 0] - b * sample[i, 1] - c) < tolerance
        if votes > most:
            best[0], best[1], best[2], most = a, b, c, votes
    return best


@numba.njit(cache=True)
def _find(parent: np.ndarray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@numba.njit(cache=True, fastmath=True)
def _components(xyz: np.ndarray, link: float) -> tuple[np.ndarray, int]:
    """(n,) component of each point: touching cells of a grid from above."""
    nx, ny = int(2 * HALF_X_M / link) + 2, int(2 * HALF_Y_M / link) + 2
    parent = np.full(nx * ny, -1, np.int32)
    cell = np.empty(len(xyz), np.int32)
    for i in range(len(xyz)):
        a, b = int((xyz[i, 0] + HALF_X_M) / link) + 1, int((xyz[i, 1] + HALF_Y_M) / link) + 1
        a, b = min(max(a, 1), nx - 2), min(max(b, 1), ny - 2)
        cell[i] = a * ny + b
        parent[cell[i]] = cell[i]
    for c in range(ny, nx * ny - ny):
        if parent[c] >= 0:
            for d in (c + 1, c + ny - 1, c + ny, c + ny + 1):
                if parent[d] >= 0:
                    parent[_find(parent, d)] = _find(parent, c)
    number = np.full(nx * ny, -1, np.int32)
    count = 0
    label = np.empty(len(xyz), np.int32)
    for i in range(len(xyz)):
        root = _find(parent, cell[i])
        if number[root] < 0:
            number[root] = count
            count += 1
        label[i] = number[root]
    return label, count


@numba.njit(cache=True, fastmath=True)
def _rectangle(
    points: np.ndarray, cos: np.ndarray, sin: np.ndarray
) -> tuple[int, float, float, float, float]:
    best, most, bounds = 0, -1.0, (0.0, 0.0, 0.0, 0.0)
    for k in range(len(cos)):
        u0, u1, v0, v1 = 1e9, -1e9, 1e9, -1e9
        for i in range(len(points)):
            u = points[i, 0] * cos[k] + points[i, 1] * sin[k]
            v = points[i, 1] * cos[k] - points[i, 0] * sin[k]
            u0, u1, v0, v1 = min(u0, u), max(u1, u), min(v0, v), max(v1, v)
        worth = 0.0
        for i in range(len(points)):
            u = points[i, 0] * cos[k] + points[i, 1] * sin[k]
            v = points[i, 1] * cos[k] - points[i, 0] * sin[k]
            worth += 1 / max(min(u - u0, u1 - u, v - v0, v1 - v), 0.05)
        if worth > most:
            best, most, bounds = k, worth, (u0, u1, v0, v1)
    return best, bounds[0], bounds[1], bounds[2], bounds[3]


@numba.njit(cache=True, fastmath=True)
def detect(
    xyz: np.ndarray,
    hypotheses: int,
    tolerance: float,
    max_height: float,
    link: float,
    min_points: int,
    rng: np.random.Generator,
) -> tuple[int, int, np.ndarray]:
    """Points kept, clusters, and (k, 7) boxes: x, y, length, width, yaw, height, bottom."""
    inlier = _filter(xyz)
    a, b, c = _plane(xyz, inlier, hypotheses, tolerance, rng)
    kept = np.empty((len(xyz), 3), np.float32)
    count = 0
    for i in range(len(xyz)):
        height = xyz[i, 2] - a * xyz[i, 0] - b * xyz[i, 1] - c
        if inlier[i] and tolerance < height < max_height:
            kept[count] = xyz[i]
            count += 1
    kept = kept[:count]
    label, num = _components(kept, link)
    size = np.zeros(num, np.int32)
    low, high = np.full(num, 1e9, np.float32), np.full(num, -1e9, np.float32)
    for i in range(count):
        k = label[i]
        size[k] += 1
        low[k], high[k] = min(low[k], kept[i, 2]), max(high[k], kept[i, 2])
    # A reservoir of each cluster's points for the angle search.
    points, seen = np.empty((num, FIT_POINTS, 2), np.float32), np.zeros(num, np.int32)
    for i in range(count):
        k = label[i]
        place = seen[k] if seen[k] < FIT_POINTS else rng.integers(0, seen[k] + 1)
        if place < FIT_POINTS:
            points[k, place] = kept[i, :2]
        seen[k] += 1
    angles = np.arange(ANGLES) * (math.pi / 2 / ANGLES)
    cos, sin = np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32)
    boxes, clusters = np.empty((num, 7)), 0
    for k in range(num):
        if size[k] < min_points:
            continue
        best, u0, u1, v0, v1 = _rectangle(points[k, : min(size[k], FIT_POINTS)], cos, sin)
        u, v, length, width, yaw = (u0 + u1) / 2, (v0 + v1) / 2, u1 - u0, v1 - v0, angles[best]
        if width > length:
            length, width, yaw = width, length, yaw + math.pi / 2
        box = boxes[clusters]
        box[0], box[1] = u * cos[best] - v * sin[best], u * sin[best] + v * cos[best]
        box[2], box[3], box[4], box[5], box[6] = length, width, yaw, high[k] - low[k], low[k]
        clusters += 1
    return count, clusters, boxes[:clusters]
