"""Laws of what is built of rows: segments, lists, runs, bits, components, hulls, maps; in both forms."""

import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from scipy import ndimage

from jaxbox.xla import (
    barriers,
    bits,
    chunks,
    components,
    hulls,
    maps,
    pairs,
    ragged,
    range_bits,
    runs,
    segments,
    suppression,
)

# Segments.

segment_minima = parity.PerForm(segments.segment_minima, static_argnames="num_segments")


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_maps", [1, 4, 5])
@pytest.mark.parametrize("size", [1, 7, 300])
@pytest.mark.parametrize(("num_flags", "max_half"), [(1, 9), (2, 2**15 - 1), (2, 9), (3, 9)])
def test_segments_have_the_maxima_and_counts_of_their_rows(num_maps, size, num_flags, max_half, monkeypatch):
    # Two counts share a word as long as none can be too large for half of it.
    monkeypatch.setattr(segments, "MAX_HALF", max_half)
    rng = np.random.default_rng(size)
    values, num_segments = rng.normal(size=(size, 2)).astype(np.float32), 9
    flags = rng.random((size, num_flags)) < 0.5
    segment = rng.integers(0, num_segments, (num_maps, size), np.int32)
    rows = jnp.asarray(values), jnp.asarray(flags)

    def describe(row):
        values, flags = row
        columns = [flags[..., k].astype(jnp.float32) for k in range(num_flags)]
        return [values[..., 0], -values[..., 1]], columns

    reduce = jax.jit(
        lambda num: segments.reduce_segments(
            describe, rows, jnp.asarray(segment), num_rows=num, num_segments=num_segments
        )
    )
    for num in (0, 1, size // 2, size, size + 9):
        table = reduce(jnp.int32(num))
        expected = np.tile(np.float32([-np.inf, -np.inf, *[0] * num_flags]), (num_segments, 1))
        for of_map in segment:
            np.maximum.at(expected[:, 0], of_map[:num], values[:num, 0])
            np.maximum.at(expected[:, 1], of_map[:num], -values[:num, 1])
            np.add.at(expected[:, 2:], of_map[:num], flags[:num])
        np.testing.assert_array_equal(table, expected)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("operation", "ufunc"), [("add", np.add), ("max", np.maximum)])
@pytest.mark.parametrize(("size", "table_numbers"), [(1, 2**20), (7, 1), (300, 2**20)])
def test_segments_are_folded_from_what_their_rows_look_up(operation, ufunc, size, table_numbers, monkeypatch):
    monkeypatch.setattr(chunks, "TABLE_NUMBERS", table_numbers)
    rng = np.random.default_rng(size)
    # Whole numbers: their sums are exact in any order.
    table, num_segments = rng.integers(-9, 9, (20, 2)).astype(np.float32), 5
    segment, row = rng.integers(0, [[num_segments + 1], [20]], (2, size), np.int32)
    padded = jnp.asarray(np.concatenate([table, np.zeros((1, 2), np.float32)]))

    def describe(segment, row):
        return padded[row] + segment[:, None].astype(jnp.float32)

    fold = jax.jit(
        lambda num: segments.fold_segments(
            operation, describe, segment, row, num_rows=num, num_segments=num_segments, absent=20
        )
    )
    for num in (0, 1, size // 2, size, size + 9):
        expected = np.full((num_segments + 1, 2), 0 if operation == "add" else -np.inf, np.float32)
        ufunc.at(expected, segment[:num], table[row[:num]] + segment[:num, None])
        np.testing.assert_array_equal(fold(jnp.int32(num)), expected[:-1])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("size", "num_segments"), [(1, 1), (50, 7), (1003, 20), (4000, 3000)])
def test_segment_minima_are_those_of_the_valid_values(size, num_segments):
    rng = np.random.default_rng(size)
    values = rng.normal(size=size).astype(np.float32)
    segment, valid = rng.integers(0, num_segments + 3, size, np.int32), rng.random(size) < 0.7
    found = segment_minima(values, segment, valid, num_segments=num_segments)
    expected = np.full(num_segments + 3, np.inf, np.float32)
    np.minimum.at(expected, segment[valid], values[valid])
    np.testing.assert_array_equal(found, expected[:num_segments])


@pytest.mark.parametrize("num_rows", [1, 2, 255, 256, 10_000, 2**20])
def test_the_maximum_of_keys_names_a_row_as_good_as_the_best(num_rows):
    rng = np.random.default_rng(num_rows)
    value = rng.random(num_rows).astype(np.float32)
    index = np.arange(num_rows, dtype=np.int32)
    key = segments.argmax_key(value, index, num_rows)
    assert key.dtype == jnp.uint32
    np.testing.assert_array_equal(segments.argmax_row(key, num_rows), index)
    best = int(segments.argmax_row(jnp.max(key), num_rows))
    assert value[best] >= value.max() - 2.0**-11
    # Of the ends of the range too, and of none.
    ends = segments.argmax_key(np.float32([0, 1]), np.int32([num_rows - 1, 0]), num_rows)
    assert segments.argmax_row(ends, num_rows).tolist() == [num_rows - 1, 0]
    assert int(ends[1]) > int(ends[0]) > 0
    assert int(segments.argmax_row(jnp.uint32(0), num_rows)) == -1


# Lists of points.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("max_points", [1, 3, 16, 200])
def test_the_points_of_a_cluster_are_listed_in_order_and_spread_over_all_it_has(max_points):
    rng = np.random.default_rng(max_points)
    size, num_clusters = 150, 6
    xy = rng.normal(size=(40, 2)).astype(np.float32)
    cluster = rng.choice(num_clusters - 1, size, p=[0.8, 0.1, 0.05, 0.04, 0.01]).astype(np.int32)
    row = rng.integers(0, 40, size, np.int32)

    @jax.jit
    def tables(num):
        lists = ragged.list_points(
            *map(jnp.asarray, (cluster, row)),
            num,
            jnp.asarray(xy),
            num_clusters=num_clusters,
            max_points=max_points,
        )
        asked = jnp.array([4, 0, 0, num_clusters, 5, 1])
        return lists.total, lists.count, lists.table(asked)

    for num in (0, 1, 100, size):
        total, count, (x, y, num_points) = tables(jnp.int32(num))
        own = [xy[row[:num][cluster[:num] == k]] for k in range(num_clusters)]
        assert total.tolist() == [len(points) for points in own]
        assert count.tolist() == [min(len(points), max_points) for points in own]
        own.append(xy[:0])
        for column, k in enumerate([4, 0, 0, num_clusters, 5, 1]):
            taken = min(len(own[k]), max_points)
            assert int(num_points[column]) == taken
            chosen = np.arange(taken) * len(own[k]) // max(taken, 1)
            found = np.stack([x[:taken, column], y[:taken, column]], axis=1)
            np.testing.assert_array_equal(found, own[k][chosen])


@pytest.mark.parametrize(
    ("operation", "combine", "ufunc", "initial"),
    [("add", jnp.add, np.add, 0), ("max", jnp.maximum, np.maximum, -7)],
    ids=["add", "max"],
)
def test_fold_points_takes_each_point_of_each_cluster_once(operation, combine, ufunc, initial, platform):
    x, y = np.random.default_rng(4).normal(size=(2, 6, 3)).astype(np.float32)

    def update(state, x, y):
        both, product = state
        values = (
            jnp.where(x < 9, jnp.stack([x, y]), initial),
            jnp.where(x < 9, jnp.stack([y, x + y]), initial),
        )
        return combine(both, values[0]), combine(product, values[1])

    options = {"absent": (9.0, jnp.zeros(3)), "operation": operation}
    init = (jnp.full((2, 3), initial, jnp.float32),) * 2
    fold = jax.jit(lambda counts: ragged.fold_points(x, y, counts, init, update, **options))
    for counts in ([0, 0, 0], [1, 0, 6], [6, 6, 6], [2, 9, 3]):
        found = fold(jnp.array(counts))
        for cluster, count in enumerate(np.minimum(counts, 6)):
            for values, total in zip((np.stack([x, y]), np.stack([y, x + y])), found, strict=True):
                expected = ufunc.reduce(values[:, :count, cluster], axis=1, initial=initial)
                np.testing.assert_allclose(total[:, cluster], expected, atol=1e-5)


# Runs of rows.

LONGEST = 3 * chunks.RUN_ROWS + 1


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("num_owners", "num_runs"), [(1, 1), (3, 5), (45, 30)])
def test_fold_runs_sees_each_row_of_each_run_once_with_its_owner(num_owners, num_runs):
    size = 400

    @jax.jit
    def visits(first, length):
        def update(seen, owner, valid, columns):
            row, again = columns
            assert owner.shape == valid.shape[:1]
            assert row.shape == valid.shape
            valid = valid & (row == again // 2)
            return seen.at[owner[:, None], jnp.where(valid, row, size)].add(1, mode="drop")

        column = jnp.arange(size + chunks.RUN_ROWS)
        seen = jnp.zeros((num_owners, size), jnp.int32)
        return runs.fold_runs(update, seen, first, length, [column, 2 * column])

    lengths = (0, 1, chunks.RUN_ROWS, chunks.RUN_ROWS + 1, LONGEST)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        first = rng.integers(0, size - LONGEST, (num_owners, num_runs), np.int32)
        length = rng.choice(lengths, first.shape).astype(np.int32) * (seed > 0)
        expected = np.zeros((num_owners, size), int)
        for (owner, run), start in np.ndenumerate(first):
            expected[owner, start : start + length[owner, run]] += 1
        np.testing.assert_array_equal(visits(first, length), expected)


@pytest.mark.parametrize("num_levels", [5, 15])
@pytest.mark.parametrize("density", [0.0, 0.4, 1.0])
def test_count_kinds_counts_each_kind_and_each_level(num_levels, density):
    rng = np.random.default_rng(num_levels)
    kinds = rng.random((5, 9, chunks.RUN_ROWS)) < density
    level = rng.integers(0, num_levels + 1, kinds.shape[1:], np.int32)
    level[0] = num_levels - 1
    counts = runs.count_kinds(list(jnp.asarray(kinds)), jnp.asarray(level), num_levels)
    of_level = (level[..., None] == np.arange(num_levels)).sum(axis=1)
    np.testing.assert_array_equal(counts, np.concatenate([kinds.sum(axis=2).T, of_level], axis=1))


def test_maximum_nonnegative_is_the_maximum_also_of_zeros_and_infinities():
    values = np.random.default_rng(0).exponential(size=(5, 9)).astype(np.float32)
    values[1:4] = [[0] * 9, [0] * 8 + [np.inf], [1e-40] + [0] * 8]
    found = runs.maximum_nonnegative(values)
    np.testing.assert_array_equal(found, values.max(axis=1))


# Range cells.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("num_blocks", "num_columns"), [(1, 1), (3, 5), (13, 2)])
def test_covered_words_tell_which_cells_intervals_cover_and_how_many_before(num_blocks, num_columns):
    size = num_blocks * range_bits.BLOCK

    @jax.jit
    def words_of(first, last, cell, column):
        beams = range_bits.count_changes(size * num_columns, first, last)
        words = range_bits.covered_words(beams.reshape(num_blocks, range_bits.BLOCK, num_columns))
        return beams, words, range_bits.set_before(*range_bits.words_at([words], [cell], [column]), cell)

    for num in (0, 1, 4, 40):
        rng = np.random.default_rng(num)
        ends = np.sort(rng.integers(0, size + 1, (2, 40)), axis=0)
        column = rng.integers(0, num_columns, 40)
        # Intervals that do not count lie beyond the last cell; an end past the range does too.
        beyond = (np.arange(40) >= num) | (ends == size)
        first, last = np.where(beyond, size * num_columns, ends * num_columns + column).astype(np.int32)
        cell, of_cell = np.indices((size, num_columns)).astype(np.int32)
        beams, words, before = words_of(first, last, cell, of_cell)
        covered = np.zeros((size, num_columns), bool)
        for begin, end, k in zip(*ends[:, :num], column[:num], strict=True):
            covered[begin:end, k] = True
        changes = [np.bincount(e, minlength=size * num_columns + 1)[:-1] for e in (first, last)]
        np.testing.assert_array_equal(beams, changes[0] - changes[1])
        np.testing.assert_array_equal(range_bits.flagged_cells(words), covered)
        np.testing.assert_array_equal(before, covered.cumsum(axis=0) - covered)


@pytest.mark.usefixtures("platform")
def test_shared_cells_are_those_that_are_set_in_both():
    flags = np.random.default_rng(0).random((2, 3, range_bits.BLOCK, 5)) < 0.5
    hits, beams = flags[0], flags[1].astype(np.int32)
    shared = jax.jit(
        lambda hits, beams: range_bits.shared_cells(
            range_bits.next_words(hits), range_bits.covered_words(beams)
        )
    )(hits, beams)
    # A cell is covered where as many beams as before it have begun and not ended.
    covered = beams.reshape(-1, 5).cumsum(axis=0).reshape(beams.shape) > 0
    np.testing.assert_array_equal(shared, (hits & covered).sum(axis=1))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("num_blocks", "num_columns"), [(1, 1), (3, 5), (13, 2)])
def test_next_set_is_the_first_flag_at_a_cell_or_beyond(num_blocks, num_columns):
    size = num_blocks * range_bits.BLOCK

    @jax.jit
    def search(hits, cell, column):
        words = range_bits.next_words(hits.reshape(num_blocks, range_bits.BLOCK, num_columns))
        return words, range_bits.next_set(*range_bits.words_at([words], [cell], [column]), cell)

    for density in (0.0, 0.03, 0.5, 1.0):
        hits = np.random.default_rng(size).random((size, num_columns)) < density
        cell, column = np.indices(hits.shape).astype(np.int32)
        words, found = search(hits, cell, column)
        np.testing.assert_array_equal(range_bits.flagged_cells(words), hits)
        for (row, k), at in np.ndenumerate(np.asarray(found)):
            beyond = np.flatnonzero(hits[row:, k])
            assert at == (row + beyond[0] if len(beyond) else range_bits.NEVER)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("num_cells", "num_columns"), [(1, 1), (15, 3), (40, 5)])
@pytest.mark.parametrize("num_beams", [1, 60])
def test_beams_are_drawn_cell_by_cell(num_cells, num_columns, num_beams):
    rng = np.random.default_rng(num_cells)
    column = rng.integers(0, num_columns, num_beams, np.int32)
    hit = rng.random((2, num_beams)) < 0.5, rng.integers(0, num_cells, num_beams, np.int32)
    first, last = np.sort(rng.integers(0, num_cells + 1, (2, num_beams), np.int32), axis=0)
    free = (rng.random(num_beams) < 0.5) & (first < last), first, last
    draw = jax.jit(lambda *beams: range_bits.draw_beams(*beams, num_columns=num_columns, num_cells=num_cells))
    words = draw(column, hit, free)
    size = (num_cells // range_bits.BLOCK + 1) * range_bits.BLOCK
    is_free, is_hit = np.zeros((size, num_columns), bool), np.zeros((size, 2 * num_columns), bool)
    for kind, valid in enumerate(hit[0]):
        is_hit[hit[1][valid], kind * num_columns + column[valid]] = True
    for k, begin, end in zip(column[free[0]], first[free[0]], last[free[0]], strict=True):
        is_free[begin:end, k] = True
    np.testing.assert_array_equal(range_bits.flagged_cells(words[0]), is_free)
    np.testing.assert_array_equal(range_bits.flagged_cells(words[1]), is_hit)


@pytest.mark.usefixtures("platform")
def test_words_at_are_those_of_the_cells_blocks_in_each_table():
    rng = np.random.default_rng(0)
    tables = [rng.integers(0, 2**32, (5, width), np.uint32) for width in (7, 14)]
    cells = rng.integers(0, 5 * range_bits.BLOCK, (2, 4, 9), np.int32)
    columns = [rng.integers(0, table.shape[1], (4, 9), np.int32) for table in tables]
    found = jax.jit(functools.partial(range_bits.words_at))(tables, list(cells), columns)
    for table, cell, column, words in zip(tables, cells, columns, found, strict=True):
        np.testing.assert_array_equal(words, table[cell // range_bits.BLOCK, column])


# Components.


@functools.partial(parity.PerForm, static_argnames=("row", "max_runs"))
def label(flags, row, max_runs):
    """Components, and that of every cell: one program, however many of them are occupied."""
    found = components.label_components(flags, row, max_runs=max_runs)
    return found, found.at(jnp.arange(row.num_flags, dtype=jnp.int32))


GRIDS = [((1, 1, 1),), ((40, 33, 1),), ((9, 8, 5),), ((12, 40, 1), (9, 8, 5), (5, 3, 1), (6, 5, 14))]


def cells_of(grids, i, occupied):
    """The cells of a map that are occupied, in its order."""
    place = np.argwhere(occupied)
    return (grids.starts[i] + place @ np.array(grids.strides[i])).astype(np.int32)


def spiral(size):
    """A map whose one component winds inwards, so that the ends of a chain of links meet late."""
    occupied = np.zeros((size, size, 1), bool)
    low, high = 0, size
    while low < high:
        occupied[low, low:high] = occupied[low:high, high - 1] = occupied[high - 1, low + 2 : high] = True
        occupied[low + 2 : high, low + 2] = True
        low, high = low + 2, high - 2
    return occupied


def assert_labelled(occupied):
    """Components are SciPy's, in the order of the maps and of their first cells."""
    grids = components.CellGrids(tuple(cells.shape for cells in occupied))
    cells = [cells_of(grids, i, each) for i, each in enumerate(occupied)]
    flags = np.zeros(grids.num_flags, np.uint8)
    flags[np.asarray(grids.flag(jnp.arange(grids.num_flags)))[np.concatenate(cells)]] = 1
    max_runs = 1 + sum(cells.size for cells in occupied)
    found, of_cell = parity.on_host(label(flags, grids, max_runs=max_runs))
    first = 1
    for i, each in enumerate(occupied):
        expected, num = ndimage.label(each, np.ones((3, 3, 3)))
        assert int(found.first[i]) == first
        np.testing.assert_array_equal(of_cell[cells[i]], expected[each] + first - 1)
        # A run goes along the lines: of the height in space, of y in a bird's-eye view.
        line = 1 if each.shape[2] == 1 else 2
        begins = np.diff(each.astype(int), axis=line, prepend=0) == 1
        assert int(found.num_runs[i]) == begins.sum()
        first += num
    assert int(found.first[-1]) == first
    assert of_cell[components.NONE] == components.NONE


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("shapes", GRIDS)
def test_components_are_those_of_scipy_with_8_or_26_neighbours_map_by_map(shapes):
    for density in (0.0, 0.1, 0.3, 0.5, 1.0):
        rng = np.random.default_rng(int(10 * density))
        assert_labelled([rng.random(shape) < density for shape in shapes])


@pytest.mark.usefixtures("platform")
def test_a_component_that_winds_is_one():
    assert ndimage.label(spiral(41), np.ones((3, 3, 3)))[1] == 1
    assert_labelled([spiral(41)])
    assert_labelled([np.ascontiguousarray(spiral(41)[::-1].transpose(1, 0, 2))])


# Hulls.

lower_hulls = parity.PerForm(hulls.lower_hulls)


def monotone_chain(points):
    """Andrew's lower hull, without points on its edges."""
    chain = []
    for point in sorted({x: min(y for other, y in points if other == x) for x, _ in points}.items()):
        while len(chain) > 1:
            (x, y), (to_x, to_y) = chain[-2:]
            if (to_x - x) * (point[1] - y) - (to_y - y) * (point[0] - x) > 0:
                break
            chain.pop()
        chain.append(point)
    return chain


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_points", [1, 2, 7, 60])
@pytest.mark.parametrize(
    "kind", ["anywhere", "on few places", "on a line", "above one another", "in one place"]
)
def test_lower_hulls_are_monotone_chains_set_by_set(num_points, kind):
    rng = np.random.default_rng(num_points)
    x, y = {
        "anywhere": rng.normal(size=(2, num_points, 9)),
        "on few places": rng.integers(-4, 5, (2, num_points, 9)),
        "on a line": np.array([[1], [2]])[:, None] * rng.integers(-9, 9, (num_points, 9)),
        "above one another": np.array([[[0]], [[1]]]) * rng.integers(-9, 9, (2, num_points, 9)),
        "in one place": np.full((2, num_points, 9), 3),
    }[kind].astype(np.float32)
    # One set without points, and others with few.
    x[rng.random(x.shape) < np.linspace(0, 1, 9)] = np.nan
    chain_x, chain_y, num_vertices = lower_hulls(x, y)
    assert chain_x.shape == chain_y.shape == (num_points + 1, 9)
    for k in range(9):
        exist = x[:, k] == x[:, k]
        chain = monotone_chain(list(zip(x[exist, k].tolist(), y[exist, k].tolist(), strict=True)))
        assert int(num_vertices[k]) == len(chain)
        found = np.stack([chain_x[:, k], chain_y[:, k]], axis=1)
        np.testing.assert_array_equal(found[: len(chain)], np.reshape(chain, (-1, 2)))
        last = chain[-1] if chain else (0, 0)
        assert all(tuple(row) in (last, (-np.inf, -np.inf)) for row in found[max(len(chain), 1) :])
        assert chain or not found[0].any()


# Pairs.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, 63, 64, 65, 200])
def test_words_of_a_row_join_what_it_is_to_each_row_that_counts(size):
    rng = np.random.default_rng(size)
    rows = rng.integers(0, 100, (size, 2)).astype(np.int32)
    flags = rng.integers(0, 2**32, 100, np.uint32)

    def relation(own, other):
        return jnp.asarray(flags)[(own[0] + 3 * other[1]) % 100]

    join = jax.jit(lambda num: pairs.join_pairs(jnp.asarray(rows), jnp.arange(size) < num, relation))
    for num in {0, 1, size // 2, size}:
        words = flags[(rows[:num, None, 0] + 3 * rows[None, :num, 1]) % 100]
        expected = np.zeros(size, np.uint32)
        expected[:num] = np.bitwise_or.reduce(words, axis=1, initial=0)
        np.testing.assert_array_equal(join(jnp.int32(num)), expected)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("share", [0, 0.1, 0.5, 1])
def test_rows_that_a_mask_picks_are_joined_with_each_other_alone(share):
    rng = np.random.default_rng(0)
    rows, mask = rng.integers(0, 32, 200).astype(np.uint32), rng.uniform(size=200) < share
    join = jax.jit(
        lambda mask: pairs.join_pairs(jnp.asarray(rows), mask, lambda own, other: own ^ (1 << other))
    )
    each = np.uint32(rows[:, None] ^ (np.uint32(1) << rows[None, :]))
    expected = np.where(mask, np.bitwise_or.reduce(each[:, mask], axis=1, initial=0), 0)
    np.testing.assert_array_equal(join(mask), expected)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("combine", [np.add, np.bitwise_or])
def test_pairs_are_reduced_along_either_axis(combine, axis):
    words = np.random.default_rng(axis).integers(0, 2**32, (7, 5), np.uint32)
    found = barriers.reduce_pairs(jnp.asarray(words), getattr(jax.lax, combine.__name__), axis)
    np.testing.assert_array_equal(found, combine.reduce(words, axis=axis, dtype=np.uint32))


def test_all_pairs_are_each_row_with_each_other_one():
    first, second = np.arange(6).reshape(3, 2), np.arange(10).reshape(5, 2)
    found = pairs.all_pairs(lambda a, b: a[0] - b[1], jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_array_equal(found, first[:, None, 0] - second[None, :, 1])


# Packed sums.


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("most", [[1], [1] * 5 + [320, 320], [2**27 - 1, 3], [1] * 40, [2**27 - 1] * 2])
def test_sums_side_by_side_in_words_are_those_of_each(axis, most):
    rng = np.random.default_rng(len(most))
    counts = [rng.integers(0, each + 1, (32, 31), np.int32) for each in most]
    counts[0][:] = most[0]
    sums = bits.sum_packed([jnp.asarray(each) for each in counts], most, axis=axis)
    assert len(sums) == len(most)
    for found, each in zip(sums, counts, strict=True):
        assert found.dtype == jnp.int32
        np.testing.assert_array_equal(found.astype(np.uint32), each.sum(axis=axis, dtype=np.uint32))


# Suppression.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, bits.WORD_BITS - 1, bits.WORD_BITS, 100])
def test_conflicts_are_suppressed_as_by_the_greedy_loop(size):
    suppress = jax.jit(
        lambda rows, valid: suppression.suppress_conflicts(
            rows, valid, lambda a, b: abs(a[0] - b[0]) < a[1] + b[1]
        )
    )
    for seed, reach in itertools.product(range(3), (0.0, 0.02, 0.2, 9.0)):
        rng = np.random.default_rng(seed)
        rows = np.column_stack([rng.random(size), np.full(size, reach / 2)]).astype(np.float32)
        # The last ones of a chain know only after many rounds.
        rows[:, 0] = np.sort(rows[:, 0]) if seed == 0 else rows[:, 0]
        valid = np.arange(size) < rng.integers(0, size + 1) if seed == 1 else np.ones(size, bool)
        kept = []
        for i in np.flatnonzero(valid):
            if all(abs(rows[i, 0] - rows[j, 0]) >= rows[i, 1] + rows[j, 1] for j in kept):
                kept.append(i)
        np.testing.assert_array_equal(np.flatnonzero(suppress(rows, valid)), kept)


@pytest.mark.usefixtures("platform")
def test_every_second_row_of_a_chain_of_conflicts_is_kept():
    rows = jnp.arange(75.0)[:, None]
    keep = suppression.suppress_conflicts(rows, jnp.ones(75, bool), lambda a, b: abs(a[0] - b[0]) < 1.5)
    assert keep.tolist() == [i % 2 == 0 for i in range(75)]


# Points on several maps.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("size", [1, chunks.MAP_POINTS, chunks.MAP_POINTS + 1])
def test_the_cells_of_points_are_listed_and_flagged_and_tables_are_mapped_map_by_map(size):
    grids = components.CellGrids(((20, 9, 1), (6, 5, 4)))
    columns = {"a": jnp.asarray(np.random.default_rng(size).integers(0, 10**6, size, np.int32))}
    num_cells = np.array([200, 120])
    lows = np.array(grids.starts[:2])

    @jax.jit
    def both(num_rows):
        def find(prepared, part, valid):
            return [
                jnp.where(valid, int(low) + (prepared + i * part["a"]) % int(num), components.NONE)
                for i, (low, num) in enumerate(zip(lows, num_cells, strict=True))
            ]

        def prepare(part):
            return part["a"] // 3

        table, flags = maps.flag_cells(find, prepare, columns, num_rows, grids)
        init = jnp.full(table.shape, -1, jnp.int32), jnp.zeros(table.shape, bool)
        mapped = maps.map_tables(
            lambda cell, prepared: (cell + prepared, cell > 0),
            table,
            num_rows=num_rows,
            init=init,
            prepare=prepare,
            columns=columns,
        )
        alone = maps.map_tables(lambda cell, _: 2 * cell, table, num_rows=num_rows, init=init[0])
        return table, flags[grids.flag(jnp.arange(grids.num_flags, dtype=jnp.int32))], mapped, alone

    for num in sorted({0, 1, size // 2, size, size + 5}):
        table, flags, (total, found), doubled = both(jnp.int32(num))
        values = np.asarray(columns["a"])
        prepared, valid = values // 3, np.arange(size) < num
        which = np.array([[0], [1]])
        cell = np.where(valid, lows[:, None] + (prepared + which * values) % num_cells[:, None], 0)
        np.testing.assert_array_equal(table[:, :size], cell)
        flagged = set(np.flatnonzero(flags)) - {components.NONE}
        assert flagged == set(cell[cell > 0])
        counts = slice(min(num, size))
        np.testing.assert_array_equal(total[:, counts], (cell + prepared)[:, counts])
        np.testing.assert_array_equal(found[:, counts], (cell > 0)[:, counts])
        np.testing.assert_array_equal(doubled[:, counts], 2 * cell[:, counts])


# Chunks.


@pytest.mark.parametrize("factor", [0.5, 2])
def test_no_chunk_size_changes_a_result(factor, monkeypatch):
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=(2, 11, 5)).astype(np.float32)
    first, length = jnp.asarray(rng.integers(0, 90, (2, 40, 30), np.int32))

    def results():
        def update(state, owner, valid, columns):
            return state.at[owner].add(jnp.sum(jnp.where(valid, columns[0], 0), axis=1))

        return [
            ragged.fold_points(
                x, y, jnp.arange(5) * 3, jnp.full(5, -9.0),
                lambda state, x, _: jnp.maximum(state, x), absent=(-9.0, 0.0), operation="max",
            ),
            runs.fold_runs(update, jnp.zeros(40, jnp.int32), first, length, [jnp.arange(300)]),
            segments.segment_minima(x[:, 0], jnp.arange(11) % 3, y[:, 0] < 1, num_segments=3),
        ]  # fmt: skip

    # Each time another function, or it would not be traced anew.
    before = jax.jit(functools.partial(results))()
    for name in ("FOLDED_POINTS", "RUN_BLOCKS", "MINIMA_TABLES"):
        monkeypatch.setattr(chunks, name, int(factor * getattr(chunks, name)))
    chex.assert_trees_all_equal(jax.jit(functools.partial(results))(), before)
