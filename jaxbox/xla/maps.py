"""Passes over points that are on several maps: tables (maps, N), a chunk of points at a time."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxbox.xla import chunks
from jaxbox.xla.backend import on_accelerator
from jaxbox.xla.barriers import materialize
from jaxbox.xla.components import NONE, CellGrids
from jaxbox.xla.indexing import scatter
from jaxbox.xla.loops import for_chunks, whole_chunks


def flag_cells(
    find: Callable[[Any, Any, jax.Array], list[jax.Array]],
    prepare: Callable[[Any], Any],
    columns: Any,
    num_rows: jax.Array,
    cells: CellGrids,
) -> tuple[jax.Array, jax.Array]:
    """Finds the cell of each point on each map, and flags the cells that hold points.

    Law: the table is ``find`` of all points, and a flag is set where it names the cell.

    Args:
      find: maps what is prepared, a chunk of the columns, and whether its points count, to their cells,
        (chunk,) int32 a map.
      prepare: what is the same for all maps, of a chunk of the columns.
      columns: pytree of (N, ...) arrays.
      num_rows: () int32; how many points count, from the first on, which may be more than N.
      cells: static, those of all maps.

    Returns:
      table: (maps, N or some more) int32.
      flags: (F,) uint8, 1 at `CellGrids.flag` of the cells.
    """
    size = jax.tree.leaves(columns)[0].shape[0]
    num_rows = jnp.minimum(num_rows, size)  # The padding of the last chunk holds no points.
    chunk = _chunk_size(size)
    whole = whole_chunks(columns, chunk)
    whole_size = jax.tree.leaves(whole)[0].shape[0]
    row = jnp.arange(chunk, dtype=jnp.int32)

    def step(start: jax.Array, state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        table, flags = state
        part = _chunk(whole, start)
        found = find(materialize(prepare(part)), part, start.astype(jnp.int32) + row < num_rows)
        if on_accelerator():
            cell = jnp.stack(found)
            return _write(table, jnp.uint32(0), start, cell), _flag(flags, cell, cells)
        for i, cell in enumerate(found):
            flags = flags.at[cells.flag(cell)].set(1, mode="promise_in_bounds")
            table = _write(table, jnp.uint32(i), start, cell)
        return table, flags

    table = jnp.zeros((len(cells.shapes), whole_size), jnp.int32)
    return _for_chunks(step, (table, jnp.zeros(cells.num_flags, jnp.uint8)), num_rows, whole_size)


def _flag(flags: jax.Array, cell: jax.Array, cells: CellGrids) -> jax.Array:
    """Flags cells of all maps in one scatter, which reads and writes the flags once.

    Rows that have no cell flag none: atomic updates of one address are serialized.
    """
    return scatter("set", flags, jnp.where(cell == NONE, cells.num_flags, cells.flag(cell)), 1)


def map_tables(
    function: Callable[[jax.Array, Any], Any],
    table: jax.Array,
    *,
    num_rows: jax.Array,
    init: Any,
    prepare: Callable[[Any], Any] | None = None,
    columns: Any = None,
) -> Any:
    """Applies a function to a table map by map. Law: ``function(table[i], prepare(columns))`` for each map i.

    Args:
      function: maps a chunk (chunk,) of a row of the table, and what is prepared, to a pytree of such chunks.
      table: (maps, M), with M as `flag_cells` gives it.
      num_rows: () int32; points beyond this many may keep what `init` says.
      init: pytree of (maps, M) arrays.
      prepare: what is the same for all maps, of a chunk of the columns; None for nothing.
      columns: pytree of (N, ...) arrays that `prepare` reads.

    Returns:
      Pytree of (maps, M) arrays.
    """
    num_maps, size = table.shape
    whole = None if prepare is None else whole_chunks(columns, _chunk_size(size))

    def step(start: jax.Array, out: Any) -> Any:
        shared = None if prepare is None else materialize(prepare(_chunk(whole, start)))

        def on_map(i: jax.Array, out: Any) -> Any:
            of_map = jax.lax.dynamic_slice(table, (i, start), (1, _chunk_size(size)))[0]
            new = function(of_map, shared)
            return jax.tree.map(lambda o, n: _write(o, i, start, n), out, new)

        return _for_maps(num_maps, on_map, out)

    return _for_chunks(step, init, num_rows, size)


def _for_chunks(step: Callable[[jax.Array, Any], Any], init: Any, num_rows: jax.Array, capacity: int) -> Any:
    """Calls a step with the first row of each chunk that holds points, and its state.

    On an accelerator once, with all points: the host would wait for the end of each chunk.
    """
    if on_accelerator():
        return step(jnp.uint32(0), init)
    return for_chunks(num_rows, chunks.MAP_POINTS, step, init, capacity=capacity)


def _for_maps(num_maps: int, step: Callable[[jax.Array, Any], Any], state: Any) -> Any:
    """Map after map: what is written out for each would have kernels for each."""
    if on_accelerator():
        return functools.reduce(lambda state, i: step(jnp.uint32(i), state), range(num_maps), state)
    return jax.lax.fori_loop(jnp.uint32(0), jnp.uint32(num_maps), step, state)


def _chunk_size(num_rows: int) -> int:
    """Points taken at a time: on an accelerator all."""
    return num_rows if on_accelerator() else chunks.MAP_POINTS


def _chunk(columns: Any, start: jax.Array) -> Any:
    """Rows of a chunk, of columns that are whole chunks."""
    if on_accelerator():
        return columns
    return jax.tree.map(lambda a: jax.lax.dynamic_slice_in_dim(a, start, chunks.MAP_POINTS), columns)


def _write(table: jax.Array, i: jax.Array, start: jax.Array, values: jax.Array) -> jax.Array:
    return jax.lax.dynamic_update_slice(table, jnp.atleast_2d(values), (i, start))
