"""Where tracks were lately, seen from where the sensor is now: what pictures and viewers draw behind them."""

import collections

import numpy as np

from jaxbox.tracking.tracks import Tracks, TrackStatus

TRAIL_S = 2.0
"""How long ago a trail begins, s."""


class Trails:
    """The ways of the tracks over the last seconds, sweep by sweep, on the host."""

    def __init__(self, duration_s: float = TRAIL_S) -> None:
        """Begins without any.

        Args:
          duration_s: how long ago a trail begins, s.
        """
        self._duration_s = duration_s
        self._places: dict[int, collections.deque[tuple[float, np.ndarray]]] = {}

    def add(self, tracks: Tracks, T_world_sensor: np.ndarray, time_s: float) -> dict[int, np.ndarray]:
        """Takes the tracks of the next sweep.

        Args:
          tracks: on the host.
          T_world_sensor: (4, 4) float64, m, at the sweep.
          time_s: of the sweep, s.

        Returns:
          For the id of each track that lives: (m, 3) float64, m, where its centre was, the oldest place first
          and the present one last, in the sensor frame of this sweep. None of a sweep that was passed over,
          whose tracks are those of the one before.
        """
        if TrackStatus.TIME_NOT_LATER in TrackStatus(int(tracks.status)):
            return {}
        rows = np.flatnonzero(tracks.valid)
        ids = np.asarray(tracks.id)[rows].tolist()
        center = np.asarray(tracks.center, np.float64)[rows]
        world = center @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
        self._places = {track_id: self._places.get(track_id, collections.deque()) for track_id in ids}
        trails = {}
        for track_id, place in zip(ids, world, strict=True):
            places = self._places[track_id]
            places.append((time_s, place))
            while len(places) > 1 and not 0 <= time_s - places[0][0] <= self._duration_s:
                places.popleft()
            way = np.array([place for _, place in places])
            trails[track_id] = (way - T_world_sensor[:3, 3]) @ T_world_sensor[:3, :3]
        return trails
