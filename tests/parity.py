"""The sweeps that parity is tested on, and what each stage is fed: the reference's own results so far.

A stage and its reference get the same float32 inputs, so that each answers for its own differences only.
"""

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxbox import reference, synthetic
from jaxbox.config import DetectorConfig
from jaxbox.run import compiled
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


SMALL_CODE = "--xla_backend_optimization_level=2 --xla_backend_extra_options=xla_cpu_optimize_for_size"
"""The flags that all tests compile with: the same bits (see test_determinism), in three quarters of the time.

An answer takes 1.8 times as long, which is little in tests.
"""

UNOPTIMISED = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""Options with which the compiler takes two thirds of the time: the answers are right, not fast."""
# A choice that there is up to jax 0.10.
_EMITTERS = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}
QUICKLY = UNOPTIMISED | _EMITTERS
"""Options with which it takes a third: rounded otherwise too, also from one program to the next.

Both are for static settings that one test alone has, of which it asks nothing that the compiler decides.
"""
UNOPTIMISED_PROCESS = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
"""The environment of a process that compiles all it has with the first of these options."""
_NO_EMITTERS = "".join(f" --{option}=false" for option in _EMITTERS)
QUICK_PROCESS = UNOPTIMISED_PROCESS | {"XLA_FLAGS": SMALL_CODE + _NO_EMITTERS}
"""Likewise, with the second."""

_detect_quickly = jax.jit(compiled._find, compiler_options=QUICKLY)


def detect_quickly(cloud, config=None):
    """As `jaxbox.detect`, compiled with `QUICKLY`."""
    return _detect_quickly(*compiled._operands(cloud, config, None))


def slow_but_first(values):
    """Parameters of a test, of which all but the first are slow, such as presets."""
    first, *others = (value if isinstance(value, tuple) else (value,) for value in values)
    return [pytest.param(*first), *(pytest.param(*value, marks=pytest.mark.slow) for value in others)]


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


@PerForm
def _words_of(free, hits):
    """Which cells are free, and which are hit, of (B, BLOCK, A) bool as words; see `Evidence`."""
    # Where each free cell ends, the next begins: the compiled stage sums the two.
    changes = jnp.diff(free.reshape(-1, free.shape[2]).astype(jnp.int32), axis=0, prepend=0)
    return covered_words(changes.reshape(free.shape)), next_words(hits)


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


class Proposal(NamedTuple):
    """A cluster, and the rectangles round it at all rotations."""

    members: np.ndarray
    """(k,) int: rows of its points among the obstacles."""
    xy: np.ndarray
    """(j, 2) m: the points that rectangles are fitted to."""
    curve: np.ndarray
    """(A,): criterion at each rotation."""
    extents: np.ndarray
    """(A, 4) m: see `reference.try_rotations`."""


@dataclasses.dataclass(eq=False)
class Case:
    """One sweep, and the results of the reference's stages on it, rounded to float32."""

    name: str
    xyz: np.ndarray
    """(n, 3) float32, m: the finite points in the region."""

    @functools.cached_property
    def inlier(self) -> np.ndarray:
        return reference.filter_outliers(self.xyz, CONFIG.filtering, CONFIG.region)

    @functools.cached_property
    def candidates(self) -> np.ndarray:
        return reference.cell_minima(self.xyz[self.inlier], CONFIG.ground).astype(np.float32)

    @functools.cached_property
    def plane(self) -> np.ndarray:
        plane, found, _ = reference.fit_ground_plane(
            self.candidates.astype(float), CONFIG.ground, rng=np.random.default_rng(0)
        )
        assert found
        return plane.astype(np.float32)

    @functools.cached_property
    def surface(self) -> np.ndarray:
        xyz = self.xyz[self.inlier].astype(float)
        return reference.fit_ground_surface(xyz, self.plane, CONFIG.ground).astype(np.float32)

    def ground_elevation(self, xyz: np.ndarray) -> np.ndarray:
        return reference.ground_elevation(xyz, self.plane, self.surface, CONFIG.ground)

    @functools.cached_property
    def height(self) -> np.ndarray:
        """(n,) float32, m, of all points, outliers too."""
        xyz = self.xyz.astype(float)
        height = reference.height_above_ground(xyz, self.plane, self.surface, CONFIG.ground)
        return height.astype(np.float32)

    @functools.cached_property
    def obstacles(self) -> reference.Obstacles:
        low, high = CONFIG.ground.min_height_m, CONFIG.ground.max_height_m
        rows = np.flatnonzero(self.inlier & (self.height > low) & (self.height < high))
        assert len(rows) <= MAX_OBSTACLES
        return reference.index_obstacles(self.xyz.astype(float), self.height.astype(float), rows)

    @functools.cached_property
    def first_map(self) -> reference.Clusters:
        return reference.find_clusters(self.obstacles, CONFIG.clustering.maps[0], CONFIG)

    @property
    def slot(self) -> np.ndarray:
        """(m,) cluster of each obstacle in the first map, -1 for none."""
        return self.first_map.of_point

    @functools.cached_property
    def proposals(self) -> list[Proposal]:
        """Of the first map."""
        clusters = self.first_map.clusters
        outlines = reference.outline_clusters(self.obstacles, clusters, CONFIG)
        fits = reference.fit_rectangles(outlines, CONFIG.box)
        return [
            Proposal(cluster.members, xy, rotations.curve, rotations.extents)
            for cluster, xy, rotations in zip(clusters, outlines, fits, strict=True)
        ]

    @functools.cached_property
    def evidence(self) -> reference.Evidence:
        xyz, height = self.xyz[self.inlier].astype(float), self.height[self.inlier].astype(float)
        return reference.build_evidence(
            xyz, height, -float(self.plane[2]), self.ground_elevation, CONFIG.evidence
        )

    def evidence_as_input(self) -> Evidence:
        """The reference's evidence in the layout of the compiled stages."""
        blocks = (
            flagged(sums).T.reshape(-1, BLOCK, len(sums))
            for sums in (
                self.evidence.free_sums,
                np.concatenate([self.evidence.hit_sums, self.evidence.raised_hit_sums]),
            )
        )
        free, hit = _words_of(*blocks)
        return Evidence(
            free=free,
            hit=hit,
            steepest=jnp.float32(self.evidence.steepest),
            num_ranges=CONFIG.evidence.num_ranges,
        )

    @functools.cached_property
    def boxes(self) -> list[tuple[Proposal, reference.CompletedBox | None]]:
        """Each proposal completed as a car."""
        car = CONFIG.vehicles.classes[0]
        return [(p, complete(p, int(np.argmax(p.curve)), car, self.evidence)) for p in self.proposals]


def complete(proposal, angle, prior, evidence, mode="evidence", in_row=()):
    """The reference's box of a proposal, of its rectangles at some rotations."""
    rectangles = [rectangle_of(proposal, a) for a in np.atleast_1d(angle)]
    config = dataclasses.replace(CONFIG.completion, mode=mode)
    return reference.complete_box(proposal.xy, rectangles, prior, evidence, config, in_row=in_row)


def rectangle_of(proposal, angle):
    """The reference's rectangle of a proposal at the rotation of that number."""
    turn = angle * np.pi / 2 / len(proposal.curve)
    return reference.Rectangle(proposal.extents[angle], turn, float(proposal.curve[angle]))


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
    return Case(name, xyz[reference.select_points(xyz, CONFIG.filtering, CONFIG.region).in_region])


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
