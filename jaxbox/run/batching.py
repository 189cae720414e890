"""detect_batch(): many sweeps over all devices, each by the program that a single one takes."""

import itertools
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxbox.config import DetectorConfig
from jaxbox.run.arguments import as_cloud, as_config, as_key
from jaxbox.run.compiled import detect
from jaxbox.types import Detections, PointCloud
from jaxbox.xla.backend import default_device


def detect_batch(
    clouds: Sequence[PointCloud | ArrayLike],
    config: DetectorConfig | str | None = None,
    key: jax.Array | int | None = None,
    devices: Sequence[Any] | None = None,
) -> list[Detections]:
    """Finds the vehicles of many sweeps, over several devices in parallel.

    The devices take turns, and each runs `detect` as for a single sweep: the same program, so the same bits
    (on a CPU), and no more compiles than one a device and capacity. An accelerator is not filled by single
    sweeps: `jax.vmap` them there. Calls are dispatched without waiting: while a
    device works, the next sweeps are sent to the others.

    Several devices of a CPU have to be asked for before JAX starts:
    ``jax.config.update("jax_num_cpu_devices", 2)``.

    Args:
      clouds: any number, of any capacities; arrays are padded as `detect` pads them.
      config: the settings of all, or the name of a preset; None for the default preset.
      key: the JAX random key of all, or an integer, its seed; None for 0.
      devices: JAX devices to compute on; None for all of this process.

    Returns:
      The detections of each sweep in the order of the clouds, as `detect(cloud, config, key)` gives them for
      clouds, each on its device. They may still be computing.

    Raises:
      ValueError: for no devices, settings that contradict each other, or arrays of other shapes.
      TypeError: as `detect`.
    """
    devices = checked_devices(devices)
    config, one_key = as_config(config), as_key(key)
    padded = [as_cloud(cloud, called="jaxbox.detect_batch") for cloud in clouds]
    turns = itertools.islice(itertools.cycle(devices), len(padded))
    return [detect_on(device, cloud, config, one_key) for device, cloud in zip(turns, padded, strict=True)]


def checked_devices(devices: Sequence[Any] | None) -> Sequence[Any]:
    """The devices to compute on: all of this process where none are named.

    Args:
      devices: JAX devices, or None.

    Returns:
      At least one.

    Raises:
      ValueError: for no devices.
    """
    devices = jax.local_devices() if devices is None else devices
    if not devices:
        raise ValueError("devices is empty; name at least one, or leave it out for all of this process.")
    return devices


def detect_on(
    device: Any, cloud: PointCloud, config: DetectorConfig | None, key: jax.Array | None
) -> Detections:
    """`detect` on a device, to which the cloud is sent where it is not there.

    Args:
      device: a JAX device.
      cloud: as `detect` takes it.
      config: as `detect` takes it.
      key: as `detect` takes it.

    Returns:
      The detections, which may still be computing.
    """
    # An array that was put on a device is tied to it, and JAX compiles for it again.
    if device not in _devices_of(cloud.xyz1):
        cloud, key = jax.device_put((cloud, key), device)
    return detect(cloud, config, key)


def _devices_of(array: jax.Array | np.ndarray) -> set[Any]:
    """Where JAX computes with an array: with NumPy's on its default device."""
    if isinstance(array, jax.Array):
        return array.devices()
    return {default_device()}
