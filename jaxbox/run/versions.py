"""Versions of this package and of those that its answers depend on."""

import importlib.metadata
import platform

from jaxbox._version import __version__

PACKAGES = ("jax", "jaxlib", "numpy", "opencv-python-headless", "chex", "matplotlib", "scipy")
"""Packages that every installation has, or that common extras bring."""
FORMAT_PACKAGES = ("pypcd4", "laspy", "pyarrow", "rosbags", "mcap", "rerun-sdk", "ray")
"""Packages of the formats and of the cluster."""


def versions(*, formats: bool = False) -> dict[str, str]:
    """Versions by package.

    Args:
      formats: whether the packages of the formats are named too.

    Returns:
      This package's first, then Python's; "not installed" where one is missing.
    """
    packages = PACKAGES + (FORMAT_PACKAGES if formats else ())
    found = {package: _version(package) for package in packages}
    return {"jaxbox": __version__, "python": platform.python_version(), **found}


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"
