"""The sweeps that parity is tested on, and what each stage is fed: the reference's own results so far.

A stage and its reference get the same float32 inputs, so that each answers for its own differences only.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxbox import reference, synthetic
from jaxbox.config import ComponentMap, DetectorConfig
from jaxbox.reference.proposals import (
    Obstacles,
    Proposal,
    find_clusters,
    index_obstacles,
    make_proposals,
    select_options,
)
from jaxbox.stages.state import Evidence
from jaxbox.xla import backend
from jaxbox.xla.ragged import PointLists
from jaxbox.xla.range_bits import BLOCK, covered_words, next_words

NUM_SEEDS = 20
REAL_FRAMES = ("000001", "000008", "000080", "000134", "001497")
"""Five roads of five drives: a rural road, parked cars, a tram line, a crossing, a traffic jam."""
CAPACITY = 2**17
"""Rows that every sweep is padded to, so that each stage compiles once."""
MAX_OBSTACLES = 3 * 2**15
"""Rows for points above the ground."""
MAX_CLUSTERS = 512
"""Rows for the clusters of one map."""

CONFIG = DetectorConfig()
REGION = select_options(CONFIG.region, "half_x_m", "half_y_m")
SURFACE_GRID = {"cell_m": CONFIG.ground.surface_cell_m, "half_m": CONFIG.ground.surface_half_m}
SURFACE = SURFACE_GRID | select_options(
    CONFIG.ground,
    *("num_envelope_rounds", "max_grade", "band_below_m", "band_below_grade", "band_above_m"),
    *("band_above_grade", "blind_radius_m", "envelope_margin_m", "smoothing_m"),
)


class PerForm:
    """A function jitted once for each form of what is done otherwise on a CPU, see the fixture `platform`.

    Functions that are jitted at the top of a module would keep the form that they were traced in first.
    """

    def __init__(self, function: Callable[..., Any], **options: Any) -> None:
        self.function = function
        # Two jits of one function would share its traces: so each has a function of its own.
        self._of_form = [jax.jit(functools.partial(function), **options) for _ in range(2)]

    @property
    def jitted(self) -> Any:
        """The jitted function of the form that is asked for in this context."""
        return self._of_form[backend.on_accelerator()]

    def __call__(self, *args: Any, **named: Any) -> Any:
        return self.jitted(*args, **named)


def in_both_forms(function, *args, **named):
    """What a function that reads the platform, a `PerForm` say, gives for a CPU and for an accelerator."""
    results = []
    for accelerator in (False, True):
        with backend.building_for(accelerator=accelerator):
            results.append(on_host(function(*args, **named)))
    return results


def all_options(config, *drop):
    names = (field.name for field in dataclasses.fields(config))
    return select_options(config, *(name for name in names if name not in drop))


def pad(rows, capacity, fill=0):
    """Rows for a stage: float32 or int32, padded to a capacity."""
    rows = np.asarray(rows)
    dtype = {"f": np.float32, "i": np.int32, "b": bool}[rows.dtype.kind]
    out = np.full((capacity, *rows.shape[1:]), fill, dtype)
    out[: len(rows)] = rows
    return jnp.asarray(out)


def flagged(sums):
    """(A, B * BLOCK) bool: which range cells count, from the reference's sums of those before."""
    cells = np.diff(sums, axis=1, append=sums[:, -1:]) > 0
    return np.pad(cells, [(0, 0), (0, -cells.shape[1] % BLOCK)])


def on_host(tree):
    """The same tree of NumPy arrays: slicing those compiles nothing."""
    return jax.tree.map(np.asarray, tree)


def padded_mask(count, capacity):
    return jnp.arange(capacity) < count


@dataclasses.dataclass(eq=False)
class Case:
    """One sweep, and the results of the reference's stages on it, rounded to float32."""

    name: str
    xyz: np.ndarray
    """(n, 3) float32, m: the finite points in the region."""

    @functools.cached_property
    def inlier(self) -> np.ndarray:
        return reference.filter_outliers(self.xyz, **REGION, **all_options(CONFIG.filtering, "enabled"))

    @functools.cached_property
    def candidates(self) -> np.ndarray:
        half = {"half_x_m": CONFIG.ground.candidate_half_x_m, "half_y_m": CONFIG.ground.candidate_half_y_m}
        return reference.cell_minima(self.xyz[self.inlier], **half).astype(np.float32)

    @functools.cached_property
    def plane(self) -> np.ndarray:
        names = ("num_hypotheses", "num_refits", "tolerance_m", "max_slope_deg", "min_inlier_fraction")
        options = select_options(CONFIG.ground, *names)
        plane, found, _ = reference.fit_ground_plane(
            self.candidates.astype(float), rng=np.random.default_rng(0), **options
        )
        assert found
        return plane.astype(np.float32)

    @functools.cached_property
    def surface(self) -> np.ndarray:
        grid = reference.fit_ground_surface(self.xyz[self.inlier].astype(float), self.plane, **SURFACE)
        return grid.astype(np.float32)

    @functools.cached_property
    def height(self) -> np.ndarray:
        """(n,) float32, m, of all points, outliers too."""
        xyz = self.xyz.astype(float)
        return reference.height_above_ground(xyz, self.plane, self.surface, **SURFACE_GRID).astype(np.float32)

    @functools.cached_property
    def obstacles(self) -> Obstacles:
        low, high = CONFIG.ground.min_height_m, CONFIG.ground.max_height_m
        rows = np.flatnonzero(self.inlier & (self.height > low) & (self.height < high))
        assert len(rows) <= MAX_OBSTACLES
        return index_obstacles(self.xyz.astype(float), self.height.astype(float), rows)

    def cluster_map(self, component_map: ComponentMap) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        return find_clusters(self.obstacles, component_map, CONFIG)

    @functools.cached_property
    def slot(self) -> np.ndarray:
        """(m,) cluster of each obstacle in the first map, -1 for none."""
        return self.cluster_map(CONFIG.clustering.maps[0])[1]

    @functools.cached_property
    def proposals(self) -> list[Proposal]:
        """Of the first map."""
        return make_proposals(self.obstacles, self.slot, CONFIG)

    @functools.cached_property
    def evidence(self) -> reference.Evidence:
        return reference.build_evidence(
            self.xyz[self.inlier].astype(float),
            self.height[self.inlier].astype(float),
            sensor_height_m=-float(self.plane[2]),
            **all_options(CONFIG.evidence, "enabled"),
        )

    def evidence_as_input(self) -> Evidence:
        """The reference's evidence in the layout of the compiled stages."""
        free, hits = (
            jnp.asarray(flagged(sums).T).reshape(-1, BLOCK, len(sums))
            for sums in (self.evidence.free_sums, self.evidence.hit_sums)
        )
        # Where each free cell ends, the next begins: the compiled stage sums the two.
        changes = jnp.diff(free.reshape(-1, free.shape[2]).astype(jnp.int32), axis=0, prepend=0)
        return Evidence(
            free=covered_words(changes.reshape(free.shape)),
            hit=next_words(hits),
            support=jnp.asarray(self.evidence.support, jnp.float32),
            num_ranges=CONFIG.evidence.num_ranges,
        )

    @functools.cached_property
    def boxes(self) -> list[tuple[Proposal, reference.CompletedBox | None]]:
        """Each proposal completed as a car."""
        car = CONFIG.vehicles.classes[0]
        return [(p, complete(p, int(np.argmax(p.curve)), car, self.evidence)) for p in self.proposals]


def complete(proposal, angle, prior, evidence, mode="evidence"):
    readings = [
        reference.Reading(proposal.extents[a], a * np.pi / 2 / len(proposal.curve), float(proposal.curve[a]))
        for a in np.atleast_1d(angle)
    ]
    return reference.complete_box(
        proposal.xy,
        readings,
        evidence=evidence,
        mode=mode,
        **select_options(prior, "length_m", "width_m", "max_length_m", "max_width_m"),
        **all_options(CONFIG.completion, "mode", "num_final_rays", "along_scene", "max_assignments"),
    )


@functools.lru_cache
def synthetic_cases() -> tuple[Case, ...]:
    grounds = ("flat", "sloped", "uneven")
    sweeps = (
        synthetic.make_sweep(
            seed, ground=grounds[seed % 3], slope_deg=3.0, kerb=seed % 2 == 0, num_beams=32, num_azimuths=599
        )
        for seed in range(NUM_SEEDS)
    )
    return tuple(_case(f"seed {seed}", sweep.xyz) for seed, sweep in enumerate(sweeps))


@functools.lru_cache
def real_cases(data_root: pathlib.Path) -> tuple[Case, ...]:
    folder = data_root / "kitti_object" / "training" / "velodyne"
    sweeps = {f: np.fromfile(folder / f"{f}.bin", np.float32).reshape(-1, 4)[:, :3] for f in REAL_FRAMES}
    return tuple(_case(f"frame {frame}", xyz) for frame, xyz in sweeps.items())


def _case(name: str, xyz: np.ndarray) -> Case:
    return Case(name, xyz[reference.select_points(xyz, **REGION)[1]])


def padded_points(cases):
    """Stacks of (K, M, 2) float32 fitted points of clusters, and how many of them count."""
    clusters = [proposal.xy for case in cases for proposal in case.proposals]
    points = np.zeros((len(clusters), CONFIG.box.max_points, 2), np.float32)
    for row, xy in zip(points, clusters, strict=True):
        row[: len(xy)] = xy
    return points, np.array([len(xy) for xy in clusters], np.int32)


def point_lists(points, count):
    """The same points as the compiled stages take them."""
    size, most = points.shape[:2]
    x, y = jnp.asarray(points).reshape(-1, 2).T
    return PointLists(x, y, jnp.arange(size) * most, jnp.asarray(count), most)


def assert_share(bad, total, limit, what):
    """Fails where more than a share `limit` of `total` things differ."""
    assert total > 0, f"nothing to compare: {what}"
    assert bad <= limit * total, f"{bad} of {total} differ, {bad / total:.2e}: {what}"


def assert_within(difference, limit, what):
    """Fails where any difference, of numbers that are there, exceeds the limit."""
    difference = np.abs(np.asarray(difference, float))
    assert difference.size > 0, f"nothing to compare: {what}"
    assert np.max(difference) <= limit, f"{np.max(difference):.2e} of {limit:.2e}: {what}"
