"""The detector's configuration: one sub-config a stage.

A field marked static decides a shape or a loop bound: changing it compiles again. Every other field
is compared with data and is traced: a sweep over thresholds is a `jax.vmap` and compiles once.
Lengths are metres, angles degrees (``_deg``), everything else unitless unless said.
"""

import dataclasses
from typing import Any, Literal, TypeVar, dataclass_transform

import jax

from jaxbox.config.class_priors import ClassPrior, Label, Scalar

_T = TypeVar("_T")

DEFAULT_SCORE_THRESHOLD = 0.15
"""Score from which to act on a box: over sweeps whose labels go all round (Argoverse 2, PandaSet,
SemanticKITTI) more than 9 of 10 such boxes are vehicles, see ``benchmarks/results/sensors.json``."""

GROUND_CANDIDATE_CELL_M = 1.0
"""Edge of the cells whose lowest points are candidates for the ground: wide enough that most of them near by
see the road."""


def _static(default: Any) -> Any:
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(_static,))
def config_class(cls: type[_T]) -> type[_T]:
    """Makes a frozen, keyword-only pytree dataclass; static fields are part of its structure."""
    return jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True, kw_only=True)(cls))


@config_class
class RegionConfig:
    """The part of the world that is looked at; points outside are counted and dropped.

    So are points 100 m or more above or below the sensor.
    """

    half_x_m: float = _static(default=80.0)
    """static: |x| below this."""
    half_y_m: float = _static(default=60.0)
    """static: |y| below this."""


@config_class
class FilterConfig:
    """Statistical filtering by mean shift and standard deviation (paper, 3.1)."""

    enabled: bool = _static(default=True)
    """static: whether the stage runs."""
    cell_m: float = _static(default=1.0)
    """static: edge of the grid's cells, over the region."""
    num_levels: int = _static(default=8)
    """static: cells of the grid in height, centred on the sensor; points beyond join the end levels."""
    num_iterations: int = _static(default=3)
    """static: mean shift iterations."""
    bandwidth_m: Scalar = 1.0
    """Standard deviation of the Gaussian window that weighs the neighbouring cells."""
    num_std: Scalar = 8.0
    """t: a point farther from its converged centroid than mean + t standard deviations is an outlier."""
    min_density: Scalar = 1.1
    """Points whose window holds a smaller weight are outliers: a point alone in it weighs 1."""


@config_class
class GroundConfig:
    """RANSAC ground removal (Algorithm I), and the ground grid that follows uneven roads."""

    candidates: Literal["cell_minima", "points"] = _static(default="cell_minima")
    """static: what planes are fitted to: the lowest point of each 1 m cell, or points spread evenly
    over the sweep (the paper)."""
    num_candidates: int = _static(default=4096)
    """static: how many points for ``candidates="points"``."""
    candidate_half_x_m: float = _static(default=40.0)
    """static: cell minima are taken where |x| is below this."""
    candidate_half_y_m: float = _static(default=20.0)
    """static: cell minima are taken where |y| is below this."""
    num_hypotheses: int = _static(default=128)
    """static: R, planes sampled in a round."""
    max_planes: int = _static(default=1)
    """static: rounds; each removes the inliers of its plane (Algorithm I, "repeat")."""
    num_refits: int = _static(default=3)
    """static: refits of the best plane on all its inliers."""
    tolerance_m: Scalar = 0.1
    """A candidate within this of a plane is an inlier."""
    max_slope_deg: Scalar = 12.0
    """Steeper planes are not ground."""
    min_inlier_fraction: Scalar = 0.1
    """A plane with a smaller share of the candidates is not ground."""
    surface: bool = _static(default=True)
    """static: refine the plane by the ground grid; False stops at the planes (the paper)."""
    surface_cell_m: float = _static(default=0.5)
    """static: edge of the cells whose lowest points are ground; the ground grid's are twice as wide."""
    surface_half_m: float = _static(default=80.0)
    """static: the ground grid covers |x|, |y| below this; beyond it its border value holds."""
    num_envelope_rounds: int = _static(default=10)
    """static: cells over which the slope limit spreads."""
    max_grade: Scalar = 0.07
    """Steepest rise of the ground relative to the plane, m/m."""
    band_below_m: Scalar = 0.3
    """Points lower than the plane by more than this, at the sensor, are not ground."""
    band_below_grade: Scalar = 0.02
    """Growth of that band with range, m/m."""
    band_above_m: Scalar = 0.3
    """Points higher than the plane by more than this, at the sensor, are not ground."""
    band_above_grade: Scalar = 0.06
    """Growth of that band with range, m/m."""
    blind_radius_m: Scalar = 2.5
    """Points nearer than this are the ego vehicle, not ground."""
    envelope_margin_m: Scalar = 0.1
    """A cell minimum within this of the lower envelope is ground."""
    sheet_tolerance_m: Scalar = 0.04
    """Smooth sheets of 10 x 10 cells, such as ramps, are ground, also where they rise by more than
    ``max_grade``: they deviate from a plane by less than this in the mean. 0 takes none."""
    max_sheet_grade: Scalar = 0.25
    """Steepest rise of such a sheet relative to the plane, m/m."""
    sheet_band_grade: Scalar = 0.2
    """Growth with range of the band in which sheets are looked for, m/m; it begins at ``band_above_m``."""
    min_support_share: Scalar = 0.0375
    """Ground has, within 3 m, at least this share of the points up to 1.2 m above it at its height (.05 to
    .1 m); what lies below is a reflection. 0 asks for none."""
    min_support_points: Scalar = 2.0
    """And at least this many points."""
    min_deep_ratio: Scalar = 1.0
    """Of heights more than .3 m below the plane .2 m are ground only where they hold the lowest point of so
    many cells within 3 m for each cell in the fullest .2 m at the plane; what has fewer is a mirror image in
    a wet road. 0 asks for none."""
    min_low_ratio: Scalar = 0.625
    """From .3 m below the plane to .1 m above it .2 m of heights are ground only where they hold the lowest
    point of so many cells within 3 m for each cell in the fullest .2 m above them (up to .3 m above the
    plane); what has fewer lies below the road. 0 asks for none."""
    min_pit_neighbours: Scalar = 3.0
    """A cell lower than all eight round it by ``envelope_margin_m`` is no ground where so many of them are up
    to .5 m higher: a return from below the road, alone. 9 takes out none."""
    smoothing_m: Scalar = 1.0
    """Standard deviation of the Gaussian that smooths the ground grid (and fills it, 4 x wider)."""
    min_height_m: Scalar = 0.2
    """A point higher above the ground than this is an obstacle; others are ground."""
    max_height_m: Scalar = 4.5
    """A point higher above the ground than this is overhead, and dropped."""


@config_class
class ComponentMap:
    """One occupancy grid whose connected components propose clusters."""

    cell_m: float = _static(default=0.2)
    """static: edge of the cells; neighbours (also diagonal ones) are linked."""
    num_levels: int = _static(default=1)
    """static: cells in height; 1 is a bird's-eye view map, more is a 3D grid."""
    max_cells: int = _static(default=8192)
    """static: capacity for occupied cells, where a run of neighbours along y counts once (on a map with
    levels, a run in height)."""
    max_clusters: int = _static(default=512)
    """static: capacity for clusters that pass the gates."""
    min_height_m: Scalar = 0.2
    """Only points higher above the ground than this."""
    max_height_m: Scalar = 2.6
    """Only points lower above the ground than this."""


@config_class
class ClusteringConfig:
    """Euclidean clustering on grids (paper, 3.2, Algorithm II).

    Each map of the default preset is only a proposal: a finer map splits what a coarser one merges,
    and the evidence for the boxes decides.
    """

    maps: tuple[ComponentMap, ...] = (
        ComponentMap(cell_m=0.2, max_cells=9216),
        ComponentMap(cell_m=0.1, max_cells=14336, min_height_m=0.3, max_height_m=2.0),
        ComponentMap(cell_m=0.5, max_cells=4096),
    )
    """The component maps; the first also gives the scene direction and the components for display."""
    max_obstacles: int | None = _static(default=None)
    """static: capacity for points above the ground; None is 3/4 of the cloud's capacity."""
    adaptive_start_m: Scalar = 20.0
    """Range from which the linking distance grows."""
    adaptive_growth: Scalar = 0.005
    """Growth of the linking distance with range beyond the start, per metre; 0 keeps it fixed."""
    min_points: Scalar = 8.0
    """Clusters with fewer points are dropped."""
    max_extent_m: Scalar = 18.0
    """Clusters longer than this along x or y are dropped."""


@config_class
class EvidenceConfig:
    """What each beam says about a box: hit, seen through (free) or hidden, on a polar grid."""

    enabled: bool = _static(default=True)
    """static: whether the evidence is built; without it every box counts as hit."""
    num_azimuths: int = _static(default=1440)
    """static: azimuth cells of the polar grid, all round."""
    num_ranges: int = _static(default=320)
    """static: range cells of the polar grid."""
    range_cell_m: float = _static(default=0.25)
    """static: length of a range cell."""
    min_range_m: Scalar = 1.25
    """Nearer returns are the ego vehicle."""
    hit_min_height_m: Scalar = 0.3
    """A return between these heights is a hit."""
    hit_max_height_m: Scalar = 1.2
    """See ``hit_min_height_m``."""
    raised_hit_max_height_m: Scalar = 2.0
    """The same for vehicles with a raised body, below which beams pass, see ``ClassPrior.open_below``."""
    free_min_height_m: Scalar = 0.35
    """A beam between these heights shows that the space is free."""
    free_max_height_m: Scalar = 0.8
    """See ``free_min_height_m``."""
    end_gap_m: Scalar = 0.3
    """A beam that ends between those heights shows free space up to this before its return."""


@config_class
class HullConfig:
    """Convex hull (paper, 3.3)."""

    max_vertices: int = _static(default=40)
    """static: H, capacity for hull vertices."""
    num_slices: int = _static(default=32)
    """static: slices along each axis whose extreme points reach the hull; the hull misses points by
    at most one slice (the cluster's extent over the number of slices)."""


@config_class
class BoxConfig:
    """Rectangle by trying all rotations (paper, 3.4, Algorithm III)."""

    criterion: Literal["area", "variance", "closeness", "visible_closeness"] = _static(
        default="visible_closeness"
    )
    """static: what the best rotation has: the smallest area (the paper), the smallest variance of the
    distances to the edges, the points closest to the edges, or to the two edges facing the sensor."""
    num_angles: int = _static(default=90)
    """static: A, rotations tried over 90 degrees."""
    fit_to: Literal["slab", "hull"] = _static(default="slab")
    """static: fit to points of the cluster between two heights, or to its convex hull (the paper)."""
    max_points: int = _static(default=160)
    """static: M, points of a cluster that the rectangle is fitted to; of more than .9 M about .72 M, spread
    evenly by their direction, the same in any order of the points."""
    max_slab_points: int | None = _static(default=None)
    """static: capacity for a map's points between the slab's heights; None is 1/8 of the cloud or, up to
    1/4 of it, 16,384."""
    slab_min_height_m: Scalar = 0.2
    """Only points higher than this shape the rectangle: below are wheels and kerb."""
    slab_max_height_m: Scalar = 0.8
    """Only points lower than this shape the rectangle: above are mirrors and the narrower cabin."""
    min_slab_points: Scalar = 5.0
    """Clusters with fewer points between those heights are fitted to all their points."""
    min_slab_share: Scalar = 0.2
    """Clusters with a smaller share of their points between those heights are fitted to all of them: the few
    visible points of a hidden side say little of its direction."""
    min_distance_m: Scalar = 0.05
    """Closeness: points nearer to an edge than this count as on it."""
    stray_m: Scalar = 0.03
    """The two edges nearer to the sensor lie at most so far ahead of all points but one: a mirror is not the
    vehicle's side. Not where the rectangle is fitted to a hull."""
    min_stray_points: Scalar = 40.0
    """Rectangles that are fitted to fewer points keep the outermost one at every edge."""
    scene_direction: bool = _static(default=True)
    """static: prefer the direction that most boxes of the sweep share; needs the evidence."""
    direction_weight: Scalar = 0.1
    """Height of that preference, in closeness."""
    direction_sigma_deg: Scalar = 3.0
    """Width of the vote and of the preference: exp(-(d / sigma)^2)."""
    direction_min_extent_m: Scalar = 2.2
    """Boxes with a shorter longest extent do not vote."""
    direction_max_free: Scalar = 0.15
    """Boxes with a larger part of their area seen to be free do not vote."""
    second_peak_loss: Scalar = 0.07
    """A cluster is also tried at a second peak of its closeness where that is lower by less than this;
    0 tries none. See ``completion.along_scene``."""
    min_axis_points: Scalar = 80.0
    """A cluster with so many fitted points or more is also tried along their principal axis; see
    ``completion.along_scene``."""


@config_class
class CompletionConfig:
    """Correction for occluded vehicles: sides out of sight are completed by the class prior."""

    mode: Literal["none", "away", "evidence"] = _static(default="evidence")
    """static: keep the rectangle as measured (the paper); extend its hidden sides away from the
    sensor; or let the evidence choose among hypotheses."""
    along_scene: bool = _static(default=True)
    """static: let the evidence choose among the rectangle at the best rotation, one that fits nearly as
    well, that along the scene's direction, and one along the principal axis of the points, instead of one in
    between; needs ``box.scene_direction``."""
    seen_length: Scalar = 0.72
    """A side measured at least this long, as a fraction of the class's length, may be seen whole."""
    seen_width: Scalar = 0.83
    """As ``seen_length``, for the width."""
    seen_weight: Scalar = 0.8
    """What the measured size of such a side weighs against the class's; hidden sides have the class's."""
    length_margin_m: Scalar = 0.35
    """Lengths read short by this: bumpers are round, and the far one is seen last."""
    width_margin_m: Scalar = 0.06
    """Widths read short by this."""
    end_length: Scalar = 0.67
    """From this fraction of the class's length on the farthest of all points inside a box tells where it
    ends; not in mode "none", nor without ``vehicles.neighbourhood``."""
    end_slope: Scalar = 0.25
    """It is believed in full where beams meet the long side at this slope or more."""
    end_points: Scalar = 50.0
    """Points inside the box at which it is believed half."""
    max_assignments: int = _static(default=4096)
    """static: capacity for sides of rectangles that the evidence weighs as the length of a class."""
    num_rays: int = _static(default=32)
    """static: rays over the box when hypotheses are compared."""
    num_final_rays: int = _static(default=48)
    """static: rays over the box for its score."""
    free_weight: Scalar = 0.85
    """Cost of the fraction of rays that pass through."""
    free_length_weight: Scalar = 2.0
    """Cost of the fraction of the box's area seen to be free."""
    inside_weight: Scalar = 1.0
    """Weight of the fraction of fitted points inside the box."""
    near_weight: Scalar = 0.5
    """Weight of the mean closeness of fitted points to the visible faces."""
    closeness_weight: Scalar = 1.0
    """Weight of the rectangle criterion."""
    not_away_cost: Scalar = 0.02
    """Cost of a width that does not extend away from the sensor."""
    blend_objective: Scalar = 0.3
    """Boxes of a cluster with an objective less by up to this are blended into the best, where turned against
    it by 8 to 30 degrees: a little noise would decide between them. 0 blends none."""
    row_distance_m: Scalar = 3.0
    """Of vehicles of the first class that stand side by side, three or more, each hides the sides of the
    next: only the rays that reach them count, and the surer a box is, the less what is round it. From one
    to the next it is at most this far,"""
    row_shift_m: Scalar = 0.7
    """and one stands at most this much farther forward than the other."""
    along_row_cost: Scalar = 0.1
    """Cost of a box along such a row, in place of one in it: it would reach over its neighbours' ends."""


@config_class
class VehicleConfig:
    """Vehicle decision: gates, score and suppression."""

    neighbourhood: bool = _static(default=True)
    """static: judge a box, and measure its height, by all points in and round it; False keeps the height of
    the cluster, and lets nothing round the box count (the paper)."""
    classes: tuple[ClassPrior, ...] = tuple(label.prior for label in Label)
    """Priors of the classes, in the order of `Label`."""
    large_height_m: Scalar = 1.7
    """Clusters higher than this are also tried as a van, a truck and so on."""
    large_min_points: Scalar = 20.0
    """Clusters with fewer points are not: there would be too little to tell a van from a bush."""
    large_clearance_m: Scalar = 0.8
    """Clusters that begin higher than this above the ground are not: they are trees, say."""
    max_large: int = _static(default=768)
    """static: capacity for clusters also tried as a van, a truck and so on."""
    max_candidates: int = _static(default=1024)
    """static: capacity for boxes that pass the gates, before suppression."""
    max_detections: int = _static(default=128)
    """static: K, capacity for boxes in the answer."""
    margin_m: Scalar = 0.1
    """A point this far outside a box still counts as inside."""
    ring_m: Scalar = 0.5
    """A point farther outside than the margin but nearer than this speaks against the box, unless it is
    behind a face that the sensor does not see, and so of another thing; past the ends of long vehicles also
    one that is ``ClassPrior.past_ends_m`` farther."""
    line_lengths: Scalar = 1.5
    """Of vehicles of the first class nose to tail, three or more, what is round one is of its neighbours:
    the surer a box is, the less it counts. From the middle of one to that of the next it is less
    than this many lengths."""
    top_quantile: Scalar = 0.01
    """Share of the points in a box that may lie above its top: a single return in the air is not a roof."""
    top_margin_m: Scalar = 0.03
    """Added to the top of the points: beams seldom meet the very top."""
    top_grade: Scalar = 0.0075
    """A top may be higher than that of its points by this times the range: the beams' spacing."""
    far_ground_from_m: Scalar = 30.0
    """From this range on vehicles stand lower than what is taken for the ground below their middle: on that
    1 m before them where it is lower, in full 15 m farther. Below them none is seen. Not without
    ``neighbourhood``."""
    far_ground_rise: Scalar = 0.002
    """m/m: and lower by this times the range beyond. A beam that grazes the ground returns from where its
    lower edge meets it, nearer and so higher than its middle says."""
    min_extent_m: Scalar = 1.0
    """Boxes with no measured extent as long as this, and clusters with no such diagonal, are not vehicles."""
    row_extent: Scalar = 0.6
    """In a row or a line of three or more, boxes of the first class count from this fraction of that extent
    on: of one that is seen from its end, a gap in the returns cuts slivers off."""
    saturation_points: Scalar = 100.0
    """Clusters with at least that many points lose no score for sparseness."""
    sparseness_power: Scalar = 0.3
    """score x min(1, points / saturation)^power."""
    free_scale: Scalar = 0.15
    """score x exp(-(free length of the rays inside / scale)^2), besides x the fraction of rays that hit."""
    ring_weight: Scalar = 8.0
    """score x exp(-weight x ring points / points)."""
    overhead_weight: Scalar = 6.0
    """score x exp(-weight x points above / points), where those above are connected to the vehicle."""
    hidden_length_score: Scalar = 0.7
    """score x this where neither a measured side (``completion.seen_length``) nor a seen end
    (``completion.end_length``) shows the length, x 1 where one does, and between by degree; x 1 for boxes
    shorter than ``min_extent_m``. Not in mode "none", nor without ``neighbourhood``."""
    unseen_top_score: Scalar = 0.7
    """Score of the height where the top is out of sight, so that the class's height is answered: where the
    highest beam cuts a vehicle off, less where less than half of the class's width was measured; and where
    far vehicles return from a bumper alone. 0 takes the top of the points for that of the vehicle."""
    bumper_from_m: Scalar = 20.0
    """Range from which glass and slanted panels may return nothing, in full 10 m farther; where nearly the
    class's width was measured."""
    overhead_gap_m: Scalar = 0.25
    """They are connected where the gap between its top and the height from which points are above is at most
    this, and are not where it is twice this: a ceiling or a crown is no part of what stands under it."""
    upper_height_m: Scalar = 0.9
    """Points higher than this are glass, bonnet and roof; see ``ClassPrior.recess_m``."""
    recess_share: Scalar = 0.4
    """Share of the upper points behind the faces from which the score is full."""
    upright_score: Scalar = 0.2
    """score x a factor from this, where all upper points are on the faces, to 1."""
    tall_upright_score: Scalar = 0.4
    """The same for what is as high as ``ClassPrior.upright_from_m`` where nearly the class's width was
    measured, and for vehicles in rows and lines of three or more: all but one face of them is hidden."""
    far_score_power: Scalar = 3.0
    """score x (from / range)^power beyond a range of the class, `ClassPrior.far_score_from_m`. 0 leaves it as
    it is."""
    objective_gate: Scalar = 2.4
    """score / (1 + exp(-(J - gate) / softness)), J the objective of the completion."""
    objective_softness: Scalar = 0.13
    """See ``objective_gate``."""
    min_score: Scalar = 1e-4
    """Boxes with lower scores are dropped from a reading. Where you act, cut at `DEFAULT_SCORE_THRESHOLD`."""
    max_overlap: Scalar = 0.1
    """Of two boxes with a larger bird's-eye view IoU, the lower-scoring is suppressed."""
    num_readings: int = _static(default=1)
    """static: how often the sweep is read, each time turned about the sensor by 7.3 degrees more. Of the
    boxes of one vehicle the best is kept, and scores the mean of the readings. Preset ``accurate`` has 2."""


@config_class
class HealthConfig:
    """From where on the status doubts a sweep. No real sweep in clear weather that was at hand comes near."""

    far_m: Scalar = 40.0
    """Points farther than this, or outside the region, are far; for a sensor .2 to .8 m high what is
    farther than this in proportion to its height."""
    min_far_share: Scalar = 0.004
    """With a smaller share of far points the sweep is `DEGRADED`; 0 for sweeps that are cut off nearer."""
    max_scattered_share: Scalar = 0.2
    """So it is with a larger share of directions in which a return within 4 m is seen through."""
    max_rough_share: Scalar = 0.78
    """So it is with a larger share of the ground's points near by that lie 5 cm or more off its surface."""
    max_sensor_height_m: Scalar = 4.5
    """Ground farther below the origin is doubtful."""
    max_tilt_deg: Scalar = 6.0
    """So is steeper ground."""
    max_under_share: Scalar = 0.0004
    """So is ground with a larger share of the points right under the origin, steeper than sensors look."""
    max_below_share: Scalar = 0.1
    """So is ground with a larger share of the points .3 m or more below it."""
