"""The health of one sweep's answer in numbers and words: what a system logs and alarms on.

All on the host, from what `detect` returns anyway; `jaxbox.summarise` is the way in.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxbox.config import DEFAULT_SCORE_THRESHOLD, DetectorConfig
from jaxbox.config.capacities import CAPACITIES, CLOUD_CAPACITY
from jaxbox.config.schema import GROUND_CANDIDATE_CELL_M
from jaxbox.run.arguments import as_config
from jaxbox.types import NUM_POINT_COUNTS, Counts, Detections, GroundPlane, Label, Status

POINT_PLACES = tuple(field.name for field in dataclasses.fields(Counts)[:NUM_POINT_COUNTS])
"""Where a point can be, see `Counts`; each is in exactly one."""


@dataclasses.dataclass(frozen=True)
class CapacityUse:
    """How full one capacity was."""

    field: str
    """The setting that enlarges it."""
    needed: int
    """What it had to hold."""
    capacity: int
    """What it holds."""

    @property
    def dropped(self) -> int:
        """What did not fit."""
        return max(self.needed - self.capacity, 0)

    @property
    def share(self) -> float:
        """Needed over capacity: above 1 something was dropped; near 1 it soon will be."""
        return self.needed / self.capacity


@dataclasses.dataclass(frozen=True)
class Spread:
    """Minimum, median and maximum of some values; None of each where there is none."""

    minimum: float | None
    """In the values' unit, as the next two."""
    median: float | None
    """The middle one, or the mean of the middle two."""
    maximum: float | None
    """In the same unit."""

    @classmethod
    def of(cls, values: np.ndarray) -> "Spread":
        """The spread of (n,) numbers.

        >>> Spread.of(np.array([3.0, 1.0]))
        Spread(minimum=1.0, median=2.0, maximum=3.0)
        """
        if len(values) == 0:
            return cls(None, None, None)
        return cls(float(values.min()), float(np.median(values)), float(values.max()))


@dataclasses.dataclass(frozen=True)
class GroundSummary:
    """The ground plane, as a sensor's mount has it."""

    found: bool
    """False where no plane had enough support; height and tilt then mean little."""
    sensor_height_m: float
    """Distance of the sensor from the plane, m; negative below it."""
    tilt_deg: float
    """Angle between the plane's normal and the sensor's z axis, degrees, in [0, 90)."""
    inliers: int
    """Candidates within the tolerance of the plane."""
    inlier_share: float
    """Inliers over all places for candidates, in [0, 1]; those without a point count too, so that it falls
    where the sensor sees less of the road."""

    @classmethod
    def of(cls, plane: GroundPlane, config: DetectorConfig) -> "GroundSummary":
        """The ground of one sweep."""
        a, b, c = (float(value) for value in plane.coefficients)
        slope, inliers = math.hypot(a, b), int(plane.num_inliers)
        return cls(
            found=bool(plane.found),
            sensor_height_m=-c / math.hypot(1, slope),
            tilt_deg=math.degrees(math.atan(slope)),
            inliers=inliers,
            inlier_share=inliers / _num_candidates(config),
        )


@dataclasses.dataclass(frozen=True)
class ReturnsSummary:
    """What weather, a failing sensor or a wrong origin do to the returns, see `Counts`, `HealthConfig`."""

    far_share: float
    """Share of the finite points that are far, in [0, 1]; small in fog and rain."""
    scattered_share: float
    """Share of the directions in which a near return was seen through, in [0, 1]; large in snow and dust."""
    rough_share: float
    """Share of the ground's points near by that lie off it, in [0, 1]; large where ranges are noisy."""
    points_under: int
    """Ground points right under the origin; many where it is not the sensor's."""
    below_share: float
    """Share of the region's points .3 m or more below the ground, in [0, 1]; large where the road is not the
    ground that was found, and where it mirrors."""

    @classmethod
    def of(cls, counts: Counts, config: DetectorConfig) -> "ReturnsSummary":
        """Those of one sweep; shares of nothing are 0."""
        finite = counts.num_points - int(counts.dropped_points) - int(counts.nonfinite_points)
        in_region = finite - int(counts.out_of_range_points)
        return cls(
            far_share=int(counts.far_points) / max(finite, 1),
            scattered_share=int(counts.scattered_azimuths) / config.evidence.num_azimuths,
            rough_share=int(counts.rough_points) / max(int(counts.near_ground_points), 1),
            points_under=int(counts.points_under),
            below_share=int(counts.points_below) / max(in_region, 1),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Summary:
    """What happened to one sweep, in numbers and words."""

    num_points: int
    """Points of the sweep."""
    points: dict[str, int]
    """How many are in each of `POINT_PLACES`; they sum to `num_points`."""
    capacities: tuple[CapacityUse, ...]
    """Every capacity, those of the maps one by one."""
    status: Status
    """The bits."""
    num_boxes: int
    """Boxes from `min_score` on."""
    boxes: dict[str, int]
    """Those by class, each a `Label.word` such as "car"."""
    min_score: float
    """The cut."""
    score: Spread
    """Of the boxes from the cut on, as all that follows."""
    range_m: Spread
    """Of their centres from the sensor, m, in the plane."""
    length_m: Spread
    """Of their lengths, m."""
    width_m: Spread
    """Of their widths, m."""
    height_m: Spread
    """Of their heights, m."""
    ground: GroundSummary
    """The ground plane."""
    returns: ReturnsSummary
    """By what the status doubts a sweep."""

    @property
    def dropped(self) -> dict[str, int]:
        """What did not fit, by setting; empty where everything did."""
        return {use.field: use.dropped for use in self.capacities if use.dropped}

    def point_share(self, place: str) -> float:
        """Share of the sweep's points in one of `POINT_PLACES`, in [0, 1]; 0 for a sweep without points."""
        return self.points[place] / self.num_points if self.num_points else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Numbers, strings, lists, dicts and None only, for JSON; the status in sentences."""
        capacities = {
            use.field: {
                "needed": use.needed,
                "capacity": use.capacity,
                "share": use.share,
                "dropped": use.dropped,
            }
            for use in self.capacities
        }
        return dataclasses.asdict(self) | {"capacities": capacities, "status": self.status.describe()}


def summarise(
    detections: Detections,
    config: DetectorConfig | str | None = None,
    *,
    min_score: float = DEFAULT_SCORE_THRESHOLD,
) -> Summary:
    """Gathers what a system alarms on: counts a stage, how full each capacity was, boxes, the ground.

    It waits for the answer and works on the host.

    Args:
      detections: of one sweep: of a batch, take one from `Detections.unstack`.
      config: the settings that `detect` had, or the name of a preset, which say how large each capacity is;
        None for the default.
      min_score: boxes with lower scores are not listed.

    Returns:
      The summary; its `to_dict` is for JSON.
    """
    config = as_config(config)
    counts, score = detections.counts, np.asarray(detections.score)
    keep = np.asarray(detections.valid) & (score >= min_score)
    label, center, size = (
        np.asarray(a)[keep] for a in (detections.label, detections.center, detections.size)
    )
    return Summary(
        num_points=counts.num_points,
        points={place: int(getattr(counts, place)) for place in POINT_PLACES},
        capacities=tuple(_capacities(counts, detections.ground_mask.shape[-1], config)),
        status=Status(int(detections.status)),
        num_boxes=int(keep.sum()),
        boxes={kind.word: int((label == kind).sum()) for kind in Label},
        min_score=min_score,
        score=Spread.of(score[keep]),
        range_m=Spread.of(np.hypot(center[:, 0], center[:, 1])),
        length_m=Spread.of(size[:, 0]),
        width_m=Spread.of(size[:, 1]),
        height_m=Spread.of(size[:, 2]),
        ground=GroundSummary.of(detections.ground, config),
        returns=ReturnsSummary.of(counts, config),
    )


def _capacities(counts: Counts, num_rows: int, config: DetectorConfig) -> Sequence[CapacityUse]:
    """Every capacity next to what it had to hold, in the order of the stages."""
    uses = [CapacityUse(CLOUD_CAPACITY, counts.num_points, num_rows)]
    for row in CAPACITIES:
        sizes = row.sizes(config, num_rows)
        needed = np.atleast_1d(getattr(counts, row.count))[: len(sizes)].tolist()
        uses += [CapacityUse(name, n, size) for (name, size), n in zip(sizes.items(), needed, strict=True)]
    return uses


def _num_candidates(config: DetectorConfig) -> int:
    ground = config.ground
    if ground.candidates == "points":
        return ground.num_candidates
    halves_m = (ground.candidate_half_x_m, ground.candidate_half_y_m)
    return math.prod(round(2 * half_m / GROUND_CANDIDATE_CELL_M) for half_m in halves_m)
