"""The vehicle classes: usual sizes, and the gates that tell one from another.

Every field is compared with data, and is traced; lengths are metres.
"""

import collections
import dataclasses
import enum

import jax
import numpy as np

_HISSING = ("s", "x", "z", "ch", "sh")
"""Words that end so take -es in the plural."""

Scalar = float | jax.Array
"""A traced threshold: a Python float, or an array scalar under `jax.vmap`."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassPrior:
    """One vehicle class: size prior and gates."""

    length_m: Scalar
    """Hidden lengths are completed to this, and scored against it."""
    width_m: Scalar
    """Hidden widths are completed to this, and scored against it."""
    height_m: Scalar
    """Heights are scored against this; boxes that the highest beam cuts off have it."""
    length_below_m: Scalar
    """Width of the length score below the prior, exp(-(d / w)^2)."""
    length_above_m: Scalar
    """Width of the length score above the prior."""
    width_tolerance_m: Scalar
    """Width of the width score."""
    height_below_m: Scalar
    """Width of the height score below the prior."""
    height_above_m: Scalar
    """Width of the height score above the prior."""
    min_height_m: Scalar
    """Lower tops, after the range allowance, are not such a vehicle."""
    min_cut_height_m: Scalar
    """The same where the highest beam cuts the top off."""
    min_bumper_m: Scalar
    """The same where nothing returns from above a bumper; more than any height for classes that are not told
    so."""
    max_height_m: Scalar
    """Higher tops are not such a vehicle."""
    whole_from_m: Scalar
    """From this measured length on it may be no longer than it is seen, where lengths differ as much as those
    of trucks; the usual length asks for nothing."""
    max_length_m: Scalar
    """Longer measured extents are not such a vehicle."""
    max_width_m: Scalar
    """Wider measured extents are not such a vehicle."""
    min_box_height_m: Scalar
    """Least height of a box: measured tops are too low."""
    far_score_from_m: Scalar
    """m, range from which on the score falls (``vehicles.far_score_power``): few beams meet a vehicle there,
    and other things pass for one more easily."""
    prior_weight: Scalar
    """Factor of the score: how common the class is relative to the car, softened."""
    count_max_height_m: Scalar
    """Points lower than this above the ground belong to the vehicle; higher ones within the box
    speak against it."""
    recess_m: Scalar
    """Glass, bonnet and roof lie farther than this behind the faces that the sensor sees; walls, hedges
    and fences are upright. -1 asks for nothing."""
    upright_from_m: Scalar
    """From this height on, in full .1 m higher, a rear may be upright: compact vans look like high cars. See
    ``vehicles.tall_upright_score``; more than any height for classes that have no such vehicles."""
    past_ends_m: Scalar
    """Points so much farther past the ends of the box speak against it too, see ``vehicles.ring_m``: walls
    and facades go on there. Those up to .6 m before the end and .3 m before the side that the sensor sees are
    its own."""
    open_below: Scalar
    """Share of the free space behind hits that is no evidence against such a vehicle: 1 or more where beams
    pass below the body, 0 where they do not. Where they do, returns from higher up are hits too, see
    ``evidence.raised_hit_max_height_m``."""
    own_share: Scalar
    """Score x the share of the points in the box that its cluster holds / this, where it holds less: the rest
    of a hedge or a house fills the box of its part. 0 asks for nothing."""
    min_open: Scalar
    """Share of the rays over a box that see free space in it, below the body say, where nothing else tells
    such a vehicle from a wall: its top lies above the highest beam, or little of its width was measured. The
    fewer do, the less it scores; 0 asks for nothing."""


_FRONT_PROFILES = {
    "CAR": (0.70, 0.88, 0.93, 0.94, 0.93, 0.87, 0.73, 0.63, 0.54, 0.47),
    "VAN": (0.90, 0.86, 0.89, 0.90, 0.91, 0.85, 0.87, 0.81, 0.63, 0.53),
}
"""Means over labelled cars and vans of KITTI."""
_NO_PROFILE = (1.0,) * 10
"""Of a class whose front and back look alike: nothing is known of its front."""


def classes_in_words(labels: np.ndarray) -> str:
    """How many of each class there are.

    Args:
      labels: (k,) int, of `Label`.

    Returns:
      Words; empty for none.

    >>> classes_in_words(np.array([0, 1, 0, 0]))
    '3 cars, 1 van'
    """
    counts = collections.Counter(Label(label) for label in labels.tolist())
    return ", ".join(
        f"{counts[label]} {label.plural if counts[label] > 1 else label.word}"
        for label in Label
        if counts[label]
    )


class Label(enum.IntEnum):
    """The vehicle classes, by the number that `Detections.label` holds: their places in this table.

    All else asks it for names, numbers and priors, so that another class is another entry at the end. Every
    cluster is tried as the first class, and only large clusters as the others too.

    Sizes are medians over the 7,481 KITTI object label files, but for the length of trucks, which is mostly
    hidden (median 10.81 m): a truck of 4.3 to 17 m overlaps with one of 8.5 m by half, and from half of that
    on it may be as long as it is seen. Gates and widths were chosen on KITTI.

    >>> Label.VAN, Label.VAN.word, Label.VAN.prior.length_m
    (<Label.VAN: 1>, 'van', 4.98)
    """

    _value_: int
    prior: ClassPrior
    """Usual size, and gates."""

    def __new__(cls, prior: ClassPrior) -> "Label":
        """A label with the next number, and its prior."""
        label = int.__new__(cls, len(cls.__members__))
        label._value_, label.prior = len(cls.__members__), prior
        return label

    @property
    def front_profile(self) -> tuple[float, ...]:
        """Top height along the vehicle from rear to front, in equal parts, as shares of its height.

        >>> len(Label.CAR.front_profile), set(Label.TRUCK.front_profile)
        (10, {1.0})
        """
        return _FRONT_PROFILES.get(self.name, _NO_PROFILE)

    @property
    def word(self) -> str:
        """The class in words and in files: "car", say."""
        return self.name.lower()

    @property
    def plural(self) -> str:
        """The word for several.

        >>> Label.TRUCK.plural
        'trucks'
        """
        return f"{self.word}es" if self.word.endswith(_HISSING) else f"{self.word}s"

    @classmethod
    def named(cls, name: str) -> "Label | None":
        """The class of a name, in singular or plural and in letters of any size; None for no class.

        >>> Label.named("Vans"), Label.named("bus")
        (<Label.VAN: 1>, None)
        """
        return next((each for each in cls if name.lower() in (each.word, each.plural)), None)

    CAR = ClassPrior(
        length_m=3.9,
        width_m=1.63,
        height_m=1.5,
        length_below_m=0.8,
        length_above_m=2.0,
        width_tolerance_m=0.4,
        height_below_m=0.3,
        height_above_m=0.6,
        min_height_m=1.0,
        min_cut_height_m=0.4,
        min_bumper_m=0.4,
        max_height_m=2.3,
        whole_from_m=3.9,
        max_length_m=6.5,
        max_width_m=2.4,
        min_box_height_m=1.48,
        far_score_from_m=50.0,
        prior_weight=1.0,
        count_max_height_m=2.2,
        recess_m=0.3,
        upright_from_m=1.75,
        past_ends_m=0.0,
        open_below=0.0,
        own_share=0.0,
        min_open=0.0,
    )
    VAN = ClassPrior(
        length_m=4.98,
        width_m=1.88,
        height_m=2.13,
        length_below_m=0.8,
        length_above_m=1.5,
        width_tolerance_m=0.3,
        height_below_m=0.35,
        height_above_m=0.35,
        min_height_m=2.2,
        min_cut_height_m=2.2,
        min_bumper_m=10.0,
        max_height_m=2.7,
        whole_from_m=4.98,
        max_length_m=7.5,
        max_width_m=2.6,
        min_box_height_m=1.8,
        far_score_from_m=45.0,
        prior_weight=0.7,
        count_max_height_m=2.7,
        recess_m=0.15,
        upright_from_m=10.0,
        past_ends_m=2.0,
        open_below=1.0,
        own_share=0.8,
        min_open=0.0,
    )
    TRUCK = ClassPrior(
        length_m=8.5,
        width_m=2.63,
        height_m=3.34,
        length_below_m=5.0,
        length_above_m=8.0,
        width_tolerance_m=0.4,
        height_below_m=0.8,
        height_above_m=0.8,
        min_height_m=2.4,
        min_cut_height_m=1.8,
        min_bumper_m=10.0,
        max_height_m=4.2,
        whole_from_m=4.25,
        max_length_m=18.0,
        max_width_m=3.2,
        min_box_height_m=2.6,
        far_score_from_m=100.0,
        prior_weight=0.5,
        count_max_height_m=4.2,
        recess_m=-1.0,
        upright_from_m=10.0,
        past_ends_m=2.0,
        open_below=1.0,
        own_share=0.4,
        min_open=0.05,
    )
