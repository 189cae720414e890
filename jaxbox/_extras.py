"""Libraries that only some formats and methods need, and the extra that brings each of them."""

import importlib
from typing import Any


def require(module: str, *, extra: str, what: str) -> Any:
    """Imports a library of an optional extra.

    Args:
      module: dotted name of what to import.
      extra: of this package, that installs it.
      what: is done with it, for the message.

    Returns:
      The module.

    Raises:
      ImportError: with the command that installs the extra.

    >>> require("no_such_library", extra="pcd", what="PCD files")
    Traceback (most recent call last):
    ImportError: PCD files need no_such_library: pip install 'jaxbox[pcd]'
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.split(".", maxsplit=1)[0]
        raise ImportError(f"{what} need {library}: pip install 'jaxbox[{extra}]'") from error
