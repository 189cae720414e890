"""Ground points: the detector's mask next to Patchwork++ on labelled, mapped and synthetic ground.

On SemanticKITTI after Patchwork++'s protocol: road, parking, sidewalk, other ground, lane marking and terrain
are ground; vegetation and unlabelled points are not judged. On synthetic streets against the exact mask, and
again without the feet of things: walls, bushes and wheels begin at the ground, and no height tells their
lowest returns from it. On Argoverse 2 against its ground flags, which come from a height map.

    python -m benchmarks.bench_ground --json ground.json

Reference: Lee, Lim, Myung, "Patchwork++: Fast and robust ground segmentation solving partial
under-segmentation using 3D point cloud", IROS 2022.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import common
from jaxbox import DetectorConfig, synthetic
from jaxbox.io import (
    read_argoverse2_ground,
    read_argoverse2_points,
    read_bin,
    read_semantic_labels,
    semantic_kitti,
)

PEER = "pypatchworkpp"
MISSING = f"missing: pip install {PEER}"
SEEDS = (0, 1)
FOOT_M = 0.2
"""The height at which an obstacle begins for the detector."""
SENSOR_HEIGHT_M = {"semantic_kitti": 1.723, "synthetic": 1.73, "argoverse2": 1.97}
"""What Patchwork++ has to be told; the detector finds it by itself."""

SYNTHETIC: Mapping[str, Mapping[str, Any]] = {
    "flat": {},
    "kerb": {"kerb": True},
    "slope 4 deg ahead": {"ground": "sloped", "slope_deg": 4.0},
    "slope 8 deg ahead": {"ground": "sloped", "slope_deg": 8.0},
    "slope 8 deg sideways": {"ground": "sloped", "slope_deg": 8.0, "slope_azimuth_deg": 90.0},
    "uneven, crest": {"ground": "uneven"},
    "uneven, crest, kerb": {"ground": "uneven", "kerb": True},
}


@dataclasses.dataclass(frozen=True)
class GroundTruth:
    """A sweep and which of its points are ground."""

    data_set: str
    name: str
    xyz: np.ndarray
    intensity: np.ndarray
    is_ground: np.ndarray
    judged: np.ndarray
    class_id: np.ndarray | None = None
    is_foot: np.ndarray | None = None
    """(n,) bool: on a thing, but no higher above the true ground than `FOOT_M`; None where unknown."""


Mask = Callable[[GroundTruth], np.ndarray]
"""(n,) bool: the points that a method takes for ground."""


def semantic_sweeps() -> Iterator[GroundTruth]:
    folder = common.data_folder("semantic_kitti")
    for path in sorted((folder / "labels").glob("*.label")):
        xyz, intensity = read_bin(folder / "velodyne" / f"{path.stem}.bin")
        class_id, _ = read_semantic_labels(path, num_points=len(xyz))
        is_ground = np.isin(class_id, list(semantic_kitti.GROUND_CLASSES))
        judged = ~np.isin(class_id, list(semantic_kitti.UNJUDGED_CLASSES))
        yield GroundTruth("semantic_kitti", path.stem, xyz, intensity, is_ground, judged, class_id)


def synthetic_sweeps() -> Iterator[GroundTruth]:
    for name, street in SYNTHETIC.items():
        for seed in SEEDS:
            sweep = synthetic.make_sweep(seed, **street)
            judged = np.ones(len(sweep.xyz), bool)
            x, y, z = sweep.xyz.T.astype(float)
            foot = ~sweep.is_ground & (z - sweep.scene.terrain.height(x, y) <= FOOT_M)
            yield GroundTruth(
                "synthetic", name, sweep.xyz, sweep.intensity, sweep.is_ground, judged, is_foot=foot
            )


def argoverse2_sweeps() -> Iterator[GroundTruth]:
    for path in sorted(common.data_folder("argoverse2").glob("*.bin")):
        xyz, intensity = read_argoverse2_points(path)
        is_ground = read_argoverse2_ground(path.with_suffix(".ground.u8"), num_points=len(xyz))
        judged = np.ones(len(xyz), bool)
        yield GroundTruth("argoverse2", path.stem, xyz, intensity, is_ground, judged)


SWEEPS = (semantic_sweeps, synthetic_sweeps, argoverse2_sweeps)


def detector_mask(config: DetectorConfig) -> Mask:
    def mask(truth: GroundTruth) -> np.ndarray:
        found = common.detect(truth.xyz, truth.intensity, config)
        return np.asarray(found.ground_mask)[: len(truth.xyz)]

    return mask


def patchwork_mask() -> Mask | None:
    """Patchwork++ as it comes, but for the sensor's height; None where it is not installed."""
    try:
        import pypatchworkpp  # noqa: PLC0415  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError:
        return None

    def mask(truth: GroundTruth) -> np.ndarray:
        parameters = pypatchworkpp.Parameters()
        parameters.sensor_height = SENSOR_HEIGHT_M[truth.data_set]
        method = pypatchworkpp.patchworkpp(parameters)
        method.estimateGround(np.column_stack([truth.xyz, truth.intensity]))
        ground = np.zeros(len(truth.xyz), bool)
        ground[method.getGroundIndices()] = True
        return ground

    return mask


def score(truth: GroundTruth, mask: np.ndarray) -> dict[str, Any]:
    """Precision, recall and F1 in percent, and of which classes the wrong points are."""
    hit = int(np.sum(truth.judged & truth.is_ground & mask))
    missed = truth.judged & truth.is_ground & ~mask
    false = truth.judged & ~truth.is_ground & mask
    num_missed, num_false = int(missed.sum()), int(false.sum())
    result: dict[str, Any] = {
        "precision": 100 * hit / max(hit + num_false, 1),
        "recall": 100 * hit / max(hit + num_missed, 1),
        "f1": _f1(hit, num_missed, num_false),
        "f1_without_feet": None,
        "num_missed": num_missed,
        "num_false": num_false,
    }
    if truth.is_foot is not None:
        result["f1_without_feet"] = _f1(hit, num_missed, int(np.sum(false & ~truth.is_foot)))
    if truth.class_id is not None:
        result["missed_by_class"] = _by_class(truth.class_id[missed])
        result["false_by_class"] = _by_class(truth.class_id[false])
    return result


def _f1(hit: int, missed: int, false: int) -> float:
    return 100 * 2 * hit / max(2 * hit + false + missed, 1)


def _by_class(class_id: np.ndarray) -> dict[str, int]:
    classes, counts = np.unique(class_id, return_counts=True)
    return {str(classes[i]): int(counts[i]) for i in np.argsort(-counts)}


def bench(truths: Iterator[GroundTruth], methods: Mapping[str, Mask]) -> list[dict[str, Any]]:
    return [
        {"data_set": truth.data_set, "name": truth.name, "method": method} | score(truth, mask(truth))
        for truth in truths
        for method, mask in methods.items()
    ]


def averages(rows: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Mean F1 over the sweeps of each data set, by measure and method."""
    means: dict[str, dict[str, dict[str, float]]] = {}
    for data_set in dict.fromkeys(row["data_set"] for row in rows):
        for measure in ("f1", "f1_without_feet"):
            values: dict[str, list[float]] = {}
            for row in rows:
                if row["data_set"] == data_set and row[measure] is not None:
                    values.setdefault(row["method"], []).append(row[measure])
            if values:
                by_method = {method: float(np.mean(column)) for method, column in values.items()}
                means.setdefault(data_set, {})[measure] = by_method
    return means


def main(arguments: Sequence[str] | None = None) -> None:
    options = common.parser(__doc__ or "").parse_args(arguments)
    config = common.chosen_config(options)
    methods = {options.preset: detector_mask(config)}
    methods |= {n: detector_mask(c) for n, c in DetectorConfig.presets().items() if n not in methods}
    peer = patchwork_mask()
    if peer is not None:
        methods[PEER] = peer
    rows = [row for sweeps in SWEEPS for row in bench(sweeps(), methods)]
    kept = (
        "data_set",
        "name",
        "method",
        "precision",
        "recall",
        "f1",
        "f1_without_feet",
        "num_missed",
        "num_false",
    )
    common.print_table(kept, [[row[key] for key in kept] for row in rows])
    means = averages(rows)
    for data_set, by_measure in means.items():
        for measure, by_method in by_measure.items():
            print(f"mean {measure}, {data_set}: " + ", ".join(f"{m} {v:.2f}" for m, v in by_method.items()))
    version = common.installed_version(PEER) or MISSING
    print(f"{PEER} {version}")
    common.write_report({"rows": rows, "mean_f1": means, PEER: version}, options)


if __name__ == "__main__":
    main()
