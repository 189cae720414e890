"""What `Detections` and `Tracks` have in common for people: length, boxes, choices, tables and pictures.

The classes stay what a compiled function returns, arrays of a fixed number of rows. All here is of the host:
it waits for the arrays, and counts the rows that are valid.
"""

import importlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Generic, Self, TypeVar, overload

import jax
import jax.core
import numpy as np

from jaxbox._box import Box, ByValue
from jaxbox._extras import require
from jaxbox.config import Label, RegionConfig
from jaxbox.geometry.rigid import rotation_about_z

AnyBox = TypeVar("AnyBox", bound=Box)
AnyRows = TypeVar("AnyRows", bound="BoxRows[Any]")

ScoreByClass = Mapping[Label, float] | Mapping[str, float]
"""By class, or by a name as `Label.word`."""
MAX_LISTED = 6
"""Boxes that a text lists, the first ones."""
MIN_CORNERS = 3
"""Of a polygon."""


class BoxRows(ByValue, Generic[AnyBox]):
    """Boxes of one sweep, one a row that is valid."""

    valid: Any
    score: Any
    label: Any
    center: Any
    size: Any
    yaw: Any
    heading: Any
    front_probability: Any

    _of_sweep: ClassVar[frozenset[str]]
    """Names of what has no row for each box."""

    def on_host(self) -> Self:
        """The same in NumPy arrays."""
        raise NotImplementedError

    def _box_at(self, row: int) -> AnyBox:
        """The box of a row, which is valid, of a sweep on the host."""
        raise NotImplementedError

    def _fields_of_box(self, row: int) -> dict[str, Any]:
        """What `Box` has, of a row of a sweep on the host."""
        return {
            "label": Label(self.label[row]),
            "score": float(self.score[row]),
            "center": np.asarray(self.center[row]),
            "size": np.asarray(self.size[row]),
            "yaw": float(self.yaw[row]),
            "heading": float(self.heading[row]),
            "front_probability": float(self.front_probability[row]),
        }

    def _title(self) -> str:
        """What there is, in a line, of a sweep on the host."""
        raise NotImplementedError

    def _with_rows(self, rows: np.ndarray) -> Self:
        """Some rows (k,) int of a sweep on the host."""
        chosen = {
            name: value if name in self._of_sweep else jax.tree.map(lambda leaf: leaf[rows], value)
            for name, value in vars(self).items()
        }
        return type(self)(**chosen)

    def __len__(self) -> int:
        """How many boxes there are; arrays of a compiled function have more rows than that."""
        return int(np.count_nonzero(_one_sweep(self).valid))

    def __iter__(self) -> Iterator[AnyBox]:
        host = _one_sweep(self)
        return (host._box_at(int(row)) for row in np.flatnonzero(host.valid))

    @overload
    def __getitem__(self, index: int | np.integer) -> AnyBox: ...
    @overload
    def __getitem__(self, index: slice | Sequence[Any] | np.ndarray | jax.Array) -> Self: ...
    def __getitem__(self, index: Any) -> Any:
        """One box by its number; or some boxes by a slice, numbers or a mask, of one value a box or a row.

        ``detections[:]`` is all of them, without padding.
        """
        host = _one_sweep(self)
        rows = _chosen_rows(np.asarray(host.valid), index)
        return host._box_at(int(rows)) if np.ndim(rows) == 0 else host._with_rows(rows)

    def above(self, score: float | ScoreByClass) -> Self:
        """The boxes of at least that score, such as `jaxbox.DEFAULT_SCORE_THRESHOLD`.

        Args:
          score: of all classes; or by class, such as ``{"car": 0.15, "van": 0.2}``, where classes that are
            not named keep all their boxes.

        Returns:
          Those boxes.

        Raises:
          ValueError: for an unknown class, naming the known ones; for two names of one class; for NaN.
        """
        host = _one_sweep(self)
        return self[reaches(host.score, host.label, score)]

    def of(self, *labels: Label | str) -> Self:
        """The boxes of some classes.

        Args:
          labels: at least one, such as "car" or `jaxbox.Label.CAR`.

        Returns:
          Those boxes.

        Raises:
          ValueError: for an unknown class, naming the known ones.
        """
        wanted = [_label(label).value for label in labels]
        return self[np.isin(_one_sweep(self).label, wanted)]

    def within(self, area: RegionConfig | Any) -> Self:
        """The boxes whose centres lie in an area, seen from above.

        Args:
          area: a region, as a configuration has it; or the corners of a polygon in either direction,
            (m, 2 or more) m, sensor frame.

        Returns:
          Those boxes.

        Raises:
          ValueError: for a polygon of another shape, or with a corner that is NaN or infinite.
        """
        center = np.asarray(_one_sweep(self).center, np.float64)
        if isinstance(area, RegionConfig):
            return self[(abs(center[:, 0]) < area.half_x_m) & (abs(center[:, 1]) < area.half_y_m)]
        return self[in_polygon(center, area)]

    def unstack(self) -> list[Self]:
        """The sweeps of a batch one by one, on the host: what `jax.vmap` stacked.

        Raises:
          ValueError: where this is one sweep already.
        """
        if np.ndim(self.valid) < 2:
            raise ValueError(
                f"these are the {type(self).__name__} of one sweep; there is nothing to unstack."
            )
        host = self.on_host()
        return [jax.tree.map(lambda leaf, k=k: leaf[k], host) for k in range(len(host.valid))]

    def __repr__(self) -> str:
        name = type(self).__name__
        if isinstance(self.valid, jax.core.Tracer) or not isinstance(self.valid, np.ndarray | jax.Array):
            return f"<{name} of {self.valid}>"
        if self.valid.ndim != 1:
            return f"<{name} of a batch {self.valid.shape[:-1]}; unstack() gives its sweeps>"
        host = self.on_host()
        rows = np.flatnonzero(host.valid)
        lines = [f"{name}: {host._title()}", *(f"  {host._box_at(int(row))}" for row in rows[:MAX_LISTED])]
        return "\n".join(lines + [f"  and {len(rows) - MAX_LISTED} more"] * (len(rows) > MAX_LISTED))

    def _repr_html_(self) -> str | None:
        """For notebooks: the text, and the boxes from above."""
        if isinstance(self.valid, jax.core.Tracer) or np.ndim(self.valid) != 1:
            return None
        return later_module("viz.html").picture_with_text(repr(self), self.draw())

    def draw(self, xyz: np.ndarray | None = None, *, frame: Any = None, title: str = "") -> np.ndarray:
        """Draws the boxes from above.

        Args:
          xyz: (n, 3 or more) m, the points of the sweep; None draws what the answer itself knows of them.
          frame: a `jaxbox.viz.BirdEyeFrame`, the part of the world; None is 40 m behind to 60 m ahead.
          title: first line of the legend.

        Returns:
          (h, w, 3) uint8, red green blue, for `jaxbox.viz.save_png` or any plot.
        """
        raise NotImplementedError

    def to_columns(self) -> dict[str, np.ndarray]:
        """The boxes as columns (k,), by the names of the Parquet files, see `jaxbox.io.parquet`.

        Returns:
          ``label`` in words, ``score``, ``center_x``, ``center_y``, ``center_z``, ``length``, ``width``,
          ``height`` (m), ``yaw``, ``heading`` (rad), ``front_probability``, and what the class adds.
        """
        boxes = self[:]
        return {
            "label": np.array([Label(label).word for label in boxes.label.tolist()], str),
            "score": boxes.score,
            **dict(zip(("center_x", "center_y", "center_z"), boxes.center.T, strict=True)),
            **dict(zip(("length", "width", "height"), boxes.size.T, strict=True)),
            "yaw": boxes.yaw,
            "heading": boxes.heading,
            "front_probability": boxes.front_probability,
        }

    def to_pandas(self) -> Any:
        """A `pandas.DataFrame` of `to_columns` (extra ``pandas``)."""
        return require("pandas", extra="pandas", what="Data frames").DataFrame(self.to_columns())

    def to_polars(self) -> Any:
        """A `polars.DataFrame` of `to_columns` (extra ``polars``)."""
        return require("polars", extra="polars", what="Data frames").DataFrame(self.to_columns())

    def to_arrow(self) -> Any:
        """A `pyarrow.Table` of `to_columns` (extra ``arrow``)."""
        return require("pyarrow", extra="arrow", what="Arrow tables").table(self.to_columns())

    def __arrow_c_stream__(self, requested_schema: Any = None) -> Any:
        """Lets DuckDB, Polars and others take the boxes by Arrow's own protocol (extra ``arrow``)."""
        return self.to_arrow().__arrow_c_stream__(requested_schema)

    def to_nuscenes(self, *, T_global_sensor: np.ndarray | None = None, sample_token: str = "") -> list[dict]:
        """The boxes as nuScenes' results, see `jaxbox.io.nuscenes.boxes_to_nuscenes`."""
        return later_module("io.nuscenes").boxes_to_nuscenes(
            self, T_global_sensor=T_global_sensor, sample_token=sample_token
        )

    def to_open3d(self) -> list[Any]:
        """An `open3d.geometry.OrientedBoundingBox` a box (extra ``open3d``), whose x points to the front."""
        geometry = require("open3d", extra="open3d", what="Its boxes").geometry
        return [
            geometry.OrientedBoundingBox(
                box.center.astype(np.float64), rotation_about_z(box.heading), box.size.astype(np.float64)
            )
            for box in self
        ]


def later_module(module: str) -> Any:
    """A module of a later layer, imported when a person asks for a picture or the form of a file.

    What people call at the prompt reaches up, as the ``plot`` of a table does. What is compiled must not.

    Args:
      module: its name within jaxbox.

    Returns:
      The module.
    """
    return importlib.import_module(f"jaxbox.{module}")


def _one_sweep(rows: Any) -> Any:
    """The sweep on the host.

    Raises:
      TypeError: while a function is traced.
      ValueError: for a batch.
    """
    name = type(rows).__name__
    if isinstance(rows.valid, jax.core.Tracer):
        raise TypeError(
            f"how many {name} there are is not known inside jax.jit or jax.vmap: use the arrays with `valid` "
            "there, and the methods on what the compiled function returns."
        )
    if np.ndim(rows.valid) != 1:
        batch = np.shape(rows.valid)[:-1]
        raise ValueError(f"these are {name} of a batch {batch}: take its sweeps one by one, from unstack().")
    return rows.on_host()


def _chosen_rows(valid: np.ndarray, index: Any) -> np.ndarray:
    """Rows of the boxes that an index names; () for one box.

    Raises:
      IndexError: where there is no such box.
      TypeError: for anything but an index.
    """
    rows = np.flatnonzero(valid)
    if isinstance(index, slice):
        return rows[index]
    index = np.asarray(index)
    if index.dtype == bool:
        if index.shape == valid.shape:
            return np.flatnonzero(valid & index)
        if index.shape != rows.shape:
            raise IndexError(f"the mask has shape {index.shape}; it must be ({len(rows)},), one value a box.")
        return rows[index]
    if index.size == 0:
        return rows[:0]
    if index.dtype.kind not in "iu" or index.ndim > 1:
        raise TypeError(
            f"{index!r} is not an index of boxes: give a number, a slice, numbers or a mask (k,). By class "
            'it is .of("car"), by score .above(0.5), by place .within(polygon).'
        )
    if np.any((index < -len(rows)) | (index >= len(rows))):
        raise IndexError(f"there is no box {index.tolist()}: {len(rows)} boxes, numbered from 0.")
    return rows[index]


def _label(label: Label | str) -> Label:
    if isinstance(label, Label):
        return label
    if (known := Label.named(str(label))) is not None:
        return known
    words = ", ".join(f'"{known.word}"' for known in Label)
    raise ValueError(f"{label!r} is not a class; choose one of {words}.")


def reaches(score: Any, label: Any, least: float | ScoreByClass) -> np.ndarray:
    """Which boxes score enough.

    Args:
      score: (n,) float.
      label: (n,) int, `Label`.
      least: the score of all classes, or of some.

    Returns:
      (n,) bool.

    Raises:
      ValueError: for an unknown class, two names of one class, or NaN.
    """
    score = np.asarray(score)
    if any(map(np.isnan, least.values() if isinstance(least, Mapping) else [least])):
        raise ValueError(f"the score is {least}, which no box reaches; give a number from 0 to 1.")
    if not isinstance(least, Mapping):
        return score >= least
    known: dict[Label, float] = {}
    for name, value in least.items():
        if (named := _label(name)) in known:
            raise ValueError(f"{name!r} is {named.word!r} again: give one score a class.")
        known[named] = value
    table = np.array([known.get(each, -np.inf) for each in Label], score.dtype)
    return score >= table[np.asarray(label)]


def in_polygon(center: np.ndarray, polygon: Any) -> np.ndarray:
    """Which points are in a polygon: a ray from them along +x crosses it an odd number of times.

    Args:
      center: (k, 2 or more) float64, m.
      polygon: (m, 2 or more) m, three corners or more, in either direction.

    Returns:
      (k,) bool.

    Raises:
      ValueError: for a polygon of another shape, or with a corner that is NaN or infinite.
    """
    corners = np.asarray(polygon, np.float64)
    if corners.ndim != 2 or corners.shape[0] < MIN_CORNERS or corners.shape[1] < 2:
        raise ValueError(
            f"the polygon has shape {corners.shape}; it must be (m, 2), three corners or more, in metres; "
            "a rectangle round the sensor is a jaxbox.config.RegionConfig."
        )
    if not np.isfinite(corners[:, :2]).all():
        raise ValueError("a corner of the polygon is NaN or infinite; give finite numbers, in metres.")
    x, y = center[:, None, 0], center[:, None, 1]
    x0, y0 = corners[:, 0], corners[:, 1]
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    crosses = (y0 <= y) != (y1 <= y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
    return np.count_nonzero(crosses & (x < at), axis=1) % 2 == 1
