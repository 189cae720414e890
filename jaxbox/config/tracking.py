"""The tracker's configuration: all of it is compared with data, and traced."""

from jaxbox.config.class_priors import Scalar
from jaxbox.config.schema import config_class


@config_class
class TrackConfig:
    """How detections of successive sweeps become tracks; see `jaxbox.tracking`."""

    birth_score: Scalar = 0.02
    """A detection that belongs to no track begins one from this score on. It is low, because a track's score
    is about the mean of its detections', and a vehicle that is seen in one sweep only should not be lost."""
    high_score: Scalar = 0.1
    """Detections from this score on are matched first (ByteTrack: two stages),"""
    low_score: Scalar = 0.01
    """and then those from this one on; lower ones are ignored."""
    gate: Scalar = 16.0
    """Largest squared Mahalanobis distance between a track and its detection, with 2 degrees of freedom."""
    acceleration_mps2: Scalar = 3.0
    """Standard deviation of the white acceleration of the constant-velocity model, m/s^2."""
    position_sd_m: Scalar = 0.05
    """Standard deviation of a detection's position at the sensor,"""
    position_sd_grade: Scalar = 0.003
    """and its growth with range, m/m."""
    placement_sd_m: Scalar = 0.3
    """Added in the gate only: completed boxes jump where the visible side changes."""
    birth_speed_sd_mps: Scalar = 8.0
    """Standard deviation of a new track's velocity, m/s, along each axis."""
    confirm_hits: Scalar = 2.0
    """Detections after which a track is confirmed; one that misses its detection before ends."""
    max_misses: Scalar = 4.0
    """Sweeps in which a track may miss its detection though it would be visible."""
    max_hidden: Scalar = 30.0
    """Sweeps in which a track may be hidden behind something else, but in no more than it was detected."""
    hidden_share: Scalar = 0.5
    """A track is hidden where more than this share of the azimuths over its box has a nearer return,"""
    hidden_gap_m: Scalar = 0.7
    """nearer than the box by more than this."""
    unseen_sd_m: Scalar = 0.35
    """A track that the sweep did not see scores less the less its place is known: x exp(-(sd / this)^2), sd
    the standard deviation of where it is expected, m."""
    yaw_memory: Scalar = 0.95
    """What of the yaw's votes remains after a sweep while the vehicle stands,"""
    yaw_memory_moving: Scalar = 0.8
    """and while it moves."""
    turn_gain: Scalar = 0.3
    """Share of the yaw's innovation that corrects the turn rate of a moving vehicle."""
    course_speed_mps: Scalar = 3.0
    """Speed from which the course votes for the yaw too, m/s,"""
    course_weight: Scalar = 3.0
    """with this weight; a detection's is its score times the root of its points."""
    moving_speed_mps: Scalar = 1.0
    """A vehicle moves once it is faster than this, and than three standard deviations, m/s,"""
    standing_speed_mps: Scalar = 0.5
    """and until it is slower than this, m/s."""
    starting_mps2: Scalar = 0.8
    """Change of speed over 1 s from which a slow vehicle starts or stops, m/s^2."""
    turning_deg_per_s: Scalar = 10.0
    """Change of course over 1 s from which a vehicle turns, degrees a second."""
    lane_change_m: Scalar = 2.0
    """Shift to the side over 5 s, of its course before as of that after, from which it changes lanes, m,"""
    lane_course_deg: Scalar = 8.0
    """where its course at both ends agrees within this."""
    max_gap_s: Scalar = 1.0
    """All tracks end where the next sweep comes later than this, s."""
    max_ego_speed_mps: Scalar = 70.0
    """Above this ego speed, m/s, the pose is taken to be wrong, and all tracks end."""
