"""Steps one after the other, over the leading axis of arrays."""

from collections.abc import Callable
from typing import Any

import jax


def scan_sequence(step: Callable[[Any, Any], tuple[Any, Any]], state: Any, items: Any) -> tuple[Any, Any]:
    """Hands a state from item to item, and gathers what each step gives.

    Law: ``for item in items: state, given = step(state, item)``, with all that was given stacked.

    Args:
      step: maps the state and an item to the next state and what is gathered.
      state: pytree of arrays.
      items: pytree of (F, ...) arrays.

    Returns:
      The last state, and a pytree of (F, ...) arrays.
    """
    return jax.lax.scan(step, state, items)
