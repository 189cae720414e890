"""The traced thresholds that the page has sliders for: none of them recompiles when it moves."""

import dataclasses
from collections.abc import Callable, Mapping

from jaxbox.config import DetectorConfig
from jaxbox.config.fields import traced_fields, traced_ranges


def _always(_: DetectorConfig) -> bool:
    return True


def _with_filter(config: DetectorConfig) -> bool:
    return config.filtering.enabled


def _with_surface(config: DetectorConfig) -> bool:
    return config.ground.surface


def _with_slab(config: DetectorConfig) -> bool:
    return config.box.fit_to == "slab"


def _with_evidence(config: DetectorConfig) -> bool:
    return config.evidence.enabled


def _with_hypotheses(config: DetectorConfig) -> bool:
    return config.completion.mode == "evidence"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Threshold:
    """One slider."""

    name: str
    """Dotted, of a traced setting."""
    label: str
    """A few words, for the page."""
    hint: str
    """What it does, in a sentence."""
    low: float
    """Left end."""
    high: float
    """Right end."""
    step: float
    """Between two stops."""
    unit: str = ""
    """Of its numbers; empty for those that have none."""
    matters: Callable[[DetectorConfig], bool] = _always
    """Whether settings use it at all: some presets leave the stage out."""

    @property
    def tooltip(self) -> str:
        """What it does, its unit, the numbers that it takes, and its name in settings files.

        >>> THRESHOLDS["ground"][1].tooltip.split("are ")[1]
        'obstacles. In m; a finite number. Setting: ground.min_height_m.'
        """
        unit = f"In {self.unit}; " if self.unit else ""
        allowed = traced_ranges(DetectorConfig())[self.name].text
        text = unit + allowed
        return f"{self.hint} {text[0].upper()}{text[1:]}. Setting: {self.name}."

    def value(self, config: DetectorConfig) -> float:
        """What settings have for it.

        >>> THRESHOLDS["ground"][0].value(DetectorConfig())
        0.1
        """
        return float(traced_fields(config)[self.name])


THRESHOLDS: Mapping[str, tuple[Threshold, ...]] = {
    "filter": (
        Threshold(
            name="filtering.num_std",
            label="outlier distance",
            unit="standard deviations",
            hint="A point farther from its centroid than the mean and that many deviations is an outlier.",
            low=0.5,
            high=16.0,
            step=0.5,
            matters=_with_filter,
        ),
        Threshold(
            name="filtering.min_density",
            label="least density",
            hint="Points with less weight of points round them are outliers; a point alone weighs 1.",
            low=0.0,
            high=10.0,
            step=0.1,
            matters=_with_filter,
        ),
    ),
    "ground": (
        Threshold(
            name="ground.tolerance_m",
            label="plane tolerance",
            unit="m",
            hint="A candidate within this of a plane speaks for it.",
            low=0.01,
            high=0.5,
            step=0.01,
        ),
        Threshold(
            name="ground.min_height_m",
            label="obstacles from",
            unit="m",
            hint="Points higher above the ground than this are obstacles.",
            low=0.0,
            high=1.0,
            step=0.01,
        ),
        Threshold(
            name="ground.max_height_m",
            label="obstacles up to",
            unit="m",
            hint="Points higher above the ground than this are overhead, and dropped.",
            low=1.0,
            high=8.0,
            step=0.1,
        ),
        Threshold(
            name="ground.max_grade",
            label="steepest ground",
            unit="m/m",
            hint="Steepest rise of the ground relative to its plane.",
            low=0.0,
            high=0.3,
            step=0.01,
            matters=_with_surface,
        ),
    ),
    "clusters": (
        Threshold(
            name="clustering.min_points",
            label="fewest points",
            unit="points",
            hint="Clusters with fewer points are dropped.",
            low=1.0,
            high=100.0,
            step=1.0,
        ),
        Threshold(
            name="clustering.max_extent_m",
            label="greatest length",
            unit="m",
            hint="Clusters longer than this along x or y are dropped.",
            low=2.0,
            high=30.0,
            step=0.5,
        ),
        Threshold(
            name="clustering.adaptive_start_m",
            label="links grow from",
            unit="m",
            hint="Range from which the linking distance grows.",
            low=0.0,
            high=60.0,
            step=1.0,
        ),
        Threshold(
            name="clustering.adaptive_growth",
            label="link growth",
            unit="1/m",
            hint="Growth of the linking distance with range; 0 keeps it fixed.",
            low=0.0,
            high=0.05,
            step=0.001,
        ),
    ),
    "boxes": (
        Threshold(
            name="box.slab_min_height_m",
            label="outline from",
            unit="m",
            hint="Only points higher above the ground than this shape the rectangle.",
            low=0.0,
            high=1.0,
            step=0.05,
            matters=_with_slab,
        ),
        Threshold(
            name="box.slab_max_height_m",
            label="outline up to",
            unit="m",
            hint="Only points lower above the ground than this shape the rectangle.",
            low=0.3,
            high=3.0,
            step=0.05,
            matters=_with_slab,
        ),
        Threshold(
            name="completion.free_length_weight",
            label="cost of free area",
            hint="Cost of the share of a box that the beams have seen to be free.",
            low=0.0,
            high=8.0,
            step=0.1,
            matters=_with_hypotheses,
        ),
        Threshold(
            name="completion.seen_weight",
            label="trust in seen sides",
            hint="What the measured size of a side seen whole weighs against the class's usual size.",
            low=0.0,
            high=1.0,
            step=0.05,
            matters=_with_hypotheses,
        ),
    ),
    "score": (
        Threshold(
            name="vehicles.min_score",
            label="least score",
            hint="Boxes with lower scores are dropped.",
            low=0.0,
            high=1.0,
            step=0.01,
        ),
        Threshold(
            name="vehicles.max_overlap",
            label="greatest overlap",
            hint="Of two boxes that overlap more (intersection over union from above), the better stays.",
            low=0.0,
            high=1.0,
            step=0.01,
        ),
        Threshold(
            name="vehicles.free_scale",
            label="tolerated free rays",
            hint="The smaller, the more it costs a box that rays pass through it.",
            low=0.01,
            high=1.0,
            step=0.01,
            matters=_with_evidence,
        ),
        Threshold(
            name="vehicles.ring_weight",
            label="cost of neighbours",
            hint="What points just outside a box cost it.",
            low=0.0,
            high=40.0,
            step=0.5,
        ),
        Threshold(
            name="vehicles.upright_score",
            label="score of walls",
            hint="Factor of the score where all upper points are on the faces, as a wall's or a hedge's are.",
            low=0.0,
            high=1.0,
            step=0.05,
        ),
        Threshold(
            name="vehicles.objective_gate",
            label="worst fit to beams",
            hint="Boxes that explain the beams worse than this score low.",
            low=0.0,
            high=6.0,
            step=0.1,
            matters=_with_hypotheses,
        ),
    ),
}
"""Sliders by stage, in the order of the stages."""
