"""What people hand over: arrays for clouds and sweeps, names for presets, integers for keys."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from jaxbox._padding import MAX_COLUMNS, unmasked
from jaxbox.config import DetectorConfig
from jaxbox.types import PointCloud

_COLUMNS = 3
"""x, y, z; a fourth is the intensity."""


def as_config(config: DetectorConfig | str | None) -> DetectorConfig:
    """The configuration of a preset's name.

    Args:
      config: a configuration, the name of a preset, or None for the default preset.

    Returns:
      The configuration.

    Raises:
      ValueError: for a name that no preset has.
      TypeError: for anything else.

    >>> as_config("paper") == DetectorConfig.paper()
    True
    """
    if config is None:
        return DetectorConfig()
    if isinstance(config, str):
        presets = DetectorConfig.presets()
        if config not in presets:
            raise ValueError(f"{config!r} is not a preset; choose one of {', '.join(presets)}.")
        return presets[config]
    if not isinstance(config, DetectorConfig):
        raise TypeError(
            f"config is {type(config).__name__}; give a DetectorConfig or the name of a preset. A seed is "
            "key=..., another capacity is PointCloud.from_numpy(xyz, capacity=...)."
        )
    return config


def as_key(key: Any) -> Any:
    """The random key of a seed.

    Args:
      key: a JAX random key; an integer, which is a seed and may be traced; or None for the seed 0.

    Returns:
      The key.

    Raises:
      ValueError: for several keys or seeds in one array.
      TypeError: for anything else.
    """
    if key is None:
        return _key_of(0)
    if isinstance(key, int | np.integer) and not isinstance(key, bool):
        return _key_of(int(key))
    if isinstance(key, bool) or not hasattr(key, "dtype"):
        raise TypeError(f"key is {key!r}; give an integer, or a key from jax.random.key(0).")
    is_typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    if not (is_typed or jnp.issubdtype(key.dtype, jnp.integer)):
        raise TypeError(f"key has dtype {key.dtype}; give an integer, or a key from jax.random.key(0).")
    # Of `jax.random.PRNGKey`, the keys before there was a type for them.
    is_words = key.dtype == jnp.uint32 and key.ndim == 1
    if key.ndim and not is_words:
        raise ValueError(
            f"key holds several, of shape {key.shape}, and one sweep takes one: a key for each of a batch "
            "goes through jax.vmap(lambda cloud, key: jaxbox.detect(cloud, key=key))(clouds, keys)."
        )
    return key if is_typed or is_words else jax.random.key(key)


@functools.lru_cache(maxsize=64)
def _key_of(seed: int) -> jax.Array:
    with jax.ensure_compile_time_eval(), jax.transfer_guard("allow"):
        return jax.random.key(seed)


def as_points(points: Any, *, called: str, takes_clouds: bool = True) -> tuple[np.ndarray, np.ndarray | None]:
    """The points of one sweep in an array.

    Args:
      points: (n, 3) or more columns, real numbers: x, y, z in m, sensor frame, and where there are more the
        intensity; whatever NumPy can make an array of. Masked numbers are NaN, masked intensities 0.
      called: the function that was given them, for the message.
      takes_clouds: whether that function takes a `PointCloud`, too, and so can be compiled.

    Returns:
      xyz (n, 3), and intensity (n,) or None.

    Raises:
      TypeError: for anything but an array, so for a cloud, and for an array that is being traced.
      ValueError: for another shape.
    """
    if isinstance(points, jax.core.Tracer):
        cloud = ": hand over a PointCloud there, from PointCloud.from_numpy and jaxbox.stack_clouds"
        raise TypeError(
            f"{called} pads arrays on the host, and so takes none inside jax.jit or jax.vmap"
            f"{cloud if takes_clouds else ''}."
        )
    if isinstance(points, str | bytes) or hasattr(points, "__fspath__"):
        raise TypeError(
            f"{called} takes points and no file: read it, xyz, intensity = jaxbox.io.read_points({points!r})."
        )
    if hasattr(points, "read_points"):
        raise TypeError(f"{called} takes points: read the sweep's, xyz, intensity = sweep.read_points().")
    if isinstance(points, PointCloud):
        raise TypeError(
            f"{called} takes an array and no PointCloud: cloud.xyz1[: int(cloud.num_points), :3]."
        )
    array = points if isinstance(points, np.ma.MaskedArray) else np.asarray(points)
    if array.dtype.kind not in "fiu":
        kind = f"{type(points).__qualname__} of {type(points).__module__}"
        cloud = " or a PointCloud" if takes_clouds else ""
        raise TypeError(f"{called} takes an array (n, 3) of real numbers{cloud}; this is {kind}.")
    if array.ndim != 2 or not _COLUMNS <= array.shape[1] <= MAX_COLUMNS:
        fix = _fix_of(array)
        raise ValueError(f"the points have shape {array.shape}; it must be (n, 3) or more columns{fix}.")
    intensity = array[:, _COLUMNS] if array.shape[1] > _COLUMNS else None
    return unmasked(array[:, :_COLUMNS], np.nan), unmasked(intensity, 0)


def _fix_of(array: np.ndarray) -> str:
    """What to do about a wrong shape."""
    if array.ndim == 3:
        return ": one sweep at a time, or jaxbox.detect_batch(sweeps), jaxbox.stream(sweeps)"
    if array.ndim == 2 and array.shape[1] > MAX_COLUMNS:
        return ": transpose it, points.T"
    if array.ndim == 1:
        return ": a file of float32 is np.fromfile(path, np.float32).reshape(-1, 4)"
    return ", x, y and z in metres"


def as_cloud(points: Any, *, called: str) -> PointCloud:
    """A padded cloud of points in an array; clouds stay as they are.

    Args:
      points: a cloud, or as `as_points`.
      called: the function that was given them, for the message.

    Returns:
      The cloud, of the smallest usual capacity that holds it.

    Raises:
      TypeError: as `as_points`.
      ValueError: as `as_points`.
    """
    if isinstance(points, PointCloud):
        return points
    return PointCloud.from_numpy(*as_points(points, called=called))


@dataclasses.dataclass(frozen=True)
class ReadSweep:
    """A sweep whose points are at hand."""

    name: str
    """Of the sweep."""
    xyz: np.ndarray
    """(n, 3) float32, m, sensor frame."""
    intensity: np.ndarray | None
    """(n,) float32, or None."""
    num_dropped: int = 0
    """Points that a cloud had no room for, and that are not among these."""

    def read_points(self) -> tuple[np.ndarray, np.ndarray | None]:
        """The points."""
        return self.xyz, self.intensity


def dropped_points(sweep: Any) -> int:
    """Points that a sweep was cut by before it came here; most kinds of sweeps know of none.

    Args:
      sweep: what has a name and `read_points`, and perhaps ``num_dropped``.
    """
    return getattr(sweep, "num_dropped", 0)


def as_sweeps(sweeps: Iterable[Any], *, called: str) -> Iterator[Any]:
    """Sweeps of any kind one by one; arrays and clouds are named by their number.

    Args:
      sweeps: what has a name and `read_points`, arrays as `as_points` takes them, or clouds.
      called: the function that was given them, for the message.

    Returns:
      What has a name and `read_points`.

    Raises:
      TypeError: for one sweep or one path instead of several; and as `as_points` when its turn comes.
      ValueError: as `as_points`, when its turn comes.
    """
    if isinstance(sweeps, str | bytes) or hasattr(sweeps, "__fspath__"):
        raise TypeError(f"{called} takes sweeps and no path: open them, jaxbox.io.open_sweeps({sweeps!r}).")
    if isinstance(sweeps, PointCloud) or len(getattr(sweeps, "shape", ())) == 2:
        raise TypeError(f"{called} takes sweeps and this is one: jaxbox.detect(xyz), or a list [xyz].")
    return (_as_sweep(sweep, index, called) for index, sweep in enumerate(sweeps))


def _as_sweep(sweep: Any, index: int, called: str) -> Any:
    if hasattr(sweep, "read_points"):
        return sweep
    name = f"{index:06d}"
    if isinstance(sweep, PointCloud):
        num_points = int(sweep.num_points)
        rows = np.asarray(sweep.xyz1)[:num_points]
        intensity = np.asarray(sweep.intensity)[:num_points]
        return ReadSweep(name, rows[:, :_COLUMNS], intensity, num_points - len(rows))
    return ReadSweep(name, *as_points(sweep, called=called))
