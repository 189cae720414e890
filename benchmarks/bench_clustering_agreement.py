"""How far grid components agree with Euclidean clusters by KD-tree and queue (the paper's Algorithm II).

    python -m benchmarks.bench_clustering_agreement [--radius 0.6 ...] [--preset paper] [--json FILE]

Both cluster the same points: those that the first component map of the preset takes, of each real sweep.
The grid links points in cells that touch, so between one cell's edge and 2 sqrt(3) of them apart; the
Euclidean clusters link points within the radius. The table is of the adjusted Rand index over all points,
and of the share of points in clusters of vehicle size that the other method has too.
"""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse

from benchmarks import common
from jaxbox import DetectorConfig
from jaxbox.io import open_sweeps
from jaxbox.reference import NO_CLUSTER, euclidean_clusters, select_clusters

RADII_M = (0.5, 0.6, 0.7)
"""The paper's preset has cells of 0.35 m; these are 1.4 to 2 of their edges."""

SAME_OVERLAP = 0.9
"""Two clusters are the same where they share more than this of the points in either."""


def adjusted_rand_index(first: np.ndarray, second: np.ndarray) -> float:
    """Agreement of two partitions of the same points: 1 where equal, about 0 where unrelated.

    Args:
      first: (n,) int, not negative.
      second: (n,) int, not negative.

    Returns:
      At most 1; 1 too where neither parts any two points, or both part all.

    Reference:
      Hubert and Arabie 1985, "Comparing partitions".

    >>> adjusted_rand_index(np.array([0, 0, 1, 1]), np.array([5, 5, 2, 2]))
    1.0
    """
    table = sparse.coo_matrix((np.ones(len(first)), (first, second))).tocsr()
    both, in_first, in_second = (
        float(np.sum(count * (count - 1) / 2))
        for count in (table.data, np.asarray(table.sum(axis=1)), np.asarray(table.sum(axis=0)))
    )
    expected = in_first * in_second / max(len(first) * (len(first) - 1) / 2, 1)
    most = (in_first + in_second) / 2
    return 1.0 if most == expected else (both - expected) / (most - expected)


def share_in_same_clusters(first: np.ndarray, second: np.ndarray) -> float:
    """Share of the points in clusters of the first that are also, but for a tenth, clusters of the second.

    Args:
      first: (n,) int, `NO_CLUSTER` for points of none.
      second: (n,) int, likewise.

    Returns:
      In [0, 1]; 1 without clusters.
    """
    same = 0
    for cluster in range(first.max(initial=NO_CLUSTER) + 1):
        inside = first == cluster
        others, counts = np.unique(second[inside & (second != NO_CLUSTER)], return_counts=True)
        if len(others):
            shared, other = counts.max(), others[np.argmax(counts)]
            union = inside.sum() + (second == other).sum() - shared
            same += inside.sum() if shared > SAME_OVERLAP * union else 0
    return float(same / max(np.sum(first != NO_CLUSTER), 1)) if np.any(first != NO_CLUSTER) else 1.0


def agreement(
    xyz: np.ndarray, component: np.ndarray, *, radius_m: float, config: DetectorConfig
) -> dict[str, float]:
    """Holds grid components against Euclidean clusters of the same points.

    Args:
      xyz: (n, 3) m.
      component: (n,) int, of the grid, not negative.
      radius_m: longest hop of the Euclidean clusters.
      config: with the size gates, see `jaxbox.reference.select_clusters`.

    Returns:
      The index over all points, the share in clusters that are the same, and the numbers of clusters.
    """
    _, component = np.unique(component, return_inverse=True)
    euclidean = euclidean_clusters(xyz, radius_m=radius_m)

    def select(labels: np.ndarray) -> tuple[np.ndarray, int]:
        least = float(config.vehicles.min_extent_m)
        return select_clusters(xyz[:, :2], labels, config.clustering, min_extent_m=least)

    (grid_slot, num_grid), (euclidean_slot, num_euclidean) = select(component), select(euclidean)
    return {
        "rand_index": adjusted_rand_index(component, euclidean),
        "share_same": share_in_same_clusters(grid_slot, euclidean_slot),
        "grid_clusters": num_grid,
        "euclidean_clusters": num_euclidean,
    }


def grid_components(xyz: np.ndarray, config: DetectorConfig) -> tuple[np.ndarray, np.ndarray]:
    """The points that the first map of the detector takes, (m, 3) m, and their components (m,)."""
    component = np.asarray(common.detect(xyz, None, config).point_component)[: len(xyz)]
    member = component >= 0
    return xyz[member].astype(float), component[member]


def bench(folder: pathlib.Path, config: DetectorConfig, radii: Sequence[float]) -> list[dict[str, Any]]:
    """One row a sweep and radius."""
    rows = []
    for sweep in open_sweeps(folder):
        xyz, component = grid_components(sweep.read_points()[0], config)
        rows += [
            {"sweep": sweep.name, "points": len(xyz), "radius_m": radius}
            | agreement(xyz, component, radius_m=radius, config=config)
            for radius in radii
        ]
    return rows


def medians(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Median and least agreement of each radius over the sweeps."""
    out = []
    for radius in dict.fromkeys(row["radius_m"] for row in rows):
        chosen = [row for row in rows if row["radius_m"] == radius]
        index, same = (np.array([row[name] for row in chosen]) for name in ("rand_index", "share_same"))
        out.append(
            {
                "radius_m": radius,
                "sweeps": len(chosen),
                "rand_index": float(np.median(index)),
                "rand_index_min": float(index.min()),
                "share_same": float(np.median(same)),
                "share_same_min": float(same.min()),
            }
        )
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the table."""
    parser = common.parser(__doc__ or "")
    parser.set_defaults(preset="paper")
    parser.add_argument("--radius", type=float, nargs="+", default=list(RADII_M), help="m")
    options = parser.parse_args(arguments)
    config = common.chosen_config(options)
    rows = bench(common.data_folder("kitti_object") / "training", config, options.radius)
    common.print_table(list(rows[0]), [list(row.values()) for row in rows])
    print()
    summary = medians(rows)
    common.print_table(list(summary[0]), [list(row.values()) for row in summary])
    common.write_report({"sweeps": rows, "summary": summary}, options)


if __name__ == "__main__":
    main()
