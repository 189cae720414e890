"""Laws of arithmetic, packed bits, hashing, least squares and grids, against NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import parity
import pytest
from scipy import ndimage

from jaxbox.xla import arithmetic, bits, chunks, grids, hashing, least_squares

# Arithmetic.


def test_fast_max_and_min_are_those_of_numpy_also_of_infinities():
    values = np.array([-np.inf, -3, 0, 1e-30, 2, np.inf], np.float32)
    one, other = np.meshgrid(values, values)
    np.testing.assert_array_equal(arithmetic.fast_max(one, other), np.maximum(one, other))
    np.testing.assert_array_equal(arithmetic.fast_min(one, other), np.minimum(one, other))


@pytest.mark.parametrize("size_m", [1e-20, 1.0, 1e15])
def test_arctan2_is_within_3e_7_rad_of_the_true_angle(size_m):
    angle = np.append(np.random.default_rng(0).uniform(-np.pi, np.pi, 100_000), np.arange(-4, 5) * np.pi / 4)
    y, x = (size_m * values.astype(np.float32) for values in (np.sin(angle), np.cos(angle)))
    y, x = y.astype(np.float32), x.astype(np.float32)
    error = jax.jit(arithmetic.arctan2)(y, x) - np.arctan2(y.astype(float), x.astype(float))
    # Half a turn is as far to the left as to the right.
    error = (error + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(error).max() < 3e-7


def test_arctan2_is_zero_at_the_origin_and_right_along_the_axes():
    y, x = np.array([[0, 0, 1, 0, -1], [0, 1, 0, -1, 0]], np.float32)
    np.testing.assert_allclose(arithmetic.arctan2(y, x), np.arctan2(y, x), atol=3e-7)


def test_cosine_and_sine_are_within_2e_7_up_to_a_quarter_turn():
    angle = np.linspace(-np.pi / 2, np.pi / 2, 100_001, dtype=np.float32)
    cosine, sine = jax.jit(arithmetic.cos_sin)(angle)
    assert np.abs(cosine - np.cos(angle.astype(float))).max() < 2e-7
    assert np.abs(sine - np.sin(angle.astype(float))).max() < 2e-7


@pytest.mark.parametrize(
    ("coefficients", "function", "end", "bound"),
    [
        (arithmetic.ARCTAN, lambda t, p: np.arctan(t) - (t + t**3 * p), 1.0, 1e-8),
        (arithmetic.SINE, lambda t, p: np.sin(t) - (t + t**3 * p), np.pi / 2, 5e-9),
        (arithmetic.COSINE, lambda t, p: np.cos(t) - (1 + t**2 * p), np.pi / 2, 2e-9),
    ],
)
def test_the_polynomials_are_as_close_as_they_say(coefficients, function, end, bound):
    t = np.linspace(0, end, 100_001)
    assert np.abs(function(t, np.polyval(coefficients, t**2))).max() < bound


# Bits.

pack_bits = jax.jit(bits.pack_bits, static_argnames="axis")
count_bits = jax.jit(bits.count_bits)
lowest_bit = jax.jit(bits.lowest_bit)


@pytest.mark.parametrize("shape", [(1,), (31,), (32,), (33,), (3, 70, 2), (64, 5)])
def test_packed_bits_are_the_flags_and_count_and_begin_as_those_do(shape):
    flags = np.random.default_rng(len(shape)).random(shape) < 0.2
    for axis in range(-1, len(shape)):
        moved = np.moveaxis(flags, axis, -1)
        moved = np.pad(moved, [(0, 0)] * (flags.ndim - 1) + [(0, -moved.shape[-1] % 32)])
        moved = moved.reshape(*moved.shape[:-1], -1, 32)
        words = np.moveaxis(np.asarray(pack_bits(flags, axis=axis)), axis, -1)
        assert words.dtype == np.uint32
        np.testing.assert_array_equal((words[..., None] >> np.arange(32)) & 1, moved)
        np.testing.assert_array_equal(count_bits(words), moved.sum(axis=-1))
        some = moved.any(axis=-1)
        np.testing.assert_array_equal(lowest_bit(words)[some], moved.argmax(axis=-1)[some])
    np.testing.assert_array_equal(pack_bits(flags.astype(np.uint8)), pack_bits(flags))


@pytest.mark.parametrize("num_flags", [1, 16, 32])
def test_joined_bits_are_those_that_are_packed(num_flags):
    flags = np.random.default_rng(num_flags).random((num_flags, 3, 5)) < 0.5
    joined = jax.jit(bits.join_bits)(list(flags))
    np.testing.assert_array_equal(joined, pack_bits(flags, axis=0)[0])


def test_every_bit_of_a_word_can_be_the_lowest_or_the_only_one():
    place = np.arange(32, dtype=np.uint32)
    for words in (np.uint32(1) << place, np.uint32(2**32 - 1) << place):
        np.testing.assert_array_equal(lowest_bit(words), place)
    assert count_bits(np.array([0, 1, 2**31, 2**32 - 1], np.uint32)).tolist() == [0, 1, 1, 32]


# Hashing.

BINS = 64


@pytest.mark.parametrize("size", [2, 16, 4096, 2**31])
def test_lattice_numbers_are_fractions_of_a_sum_of_multiples(size):
    i, j = np.random.default_rng(size).integers(-(2**15), 2**15, (2, 1000))
    numbers = np.asarray(hashing.lattice_numbers(jnp.asarray(i, jnp.int32), jnp.asarray(j, jnp.int32), size))
    golden, plastic = (1 + 5**0.5) / 2, np.roots([1, 0, -1, -1]).real.max()
    turn = numbers / size - (i / golden + j / plastic)
    # The ratios have 32 bits, and the numbers are rounded down.
    assert np.abs((turn + 0.5) % 1 - 0.5 + 0.5 / size).max() <= 0.5 / size + 2**16 / 2**32


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("shape", [(20_000,), (200, 100)])
def test_hashed_numbers_are_as_likely_everywhere_and_do_not_hang_together(seed, shape):
    numbers = np.asarray(hashing.hashed_uniform(jax.random.key(seed), seed % 2, shape))
    assert numbers.shape == shape
    assert numbers.dtype == np.float32
    assert 0 <= numbers.min() < 0.001
    assert 0.999 < numbers.max() < 1
    flat = numbers.reshape(-1)
    expected = flat.size / BINS
    chi_square = ((np.histogram(flat, BINS, (0, 1))[0] - expected) ** 2 / expected).sum()
    # Of 63 degrees of freedom: less than one seed in ten thousand lies beyond.
    assert 20 < chi_square < 115
    assert abs(np.corrcoef(flat[1:], flat[:-1])[0, 1]) < 0.04


def test_another_key_or_round_gives_other_numbers_and_the_same_ones_the_same():
    key, other = jax.random.split(jax.random.key(0))
    first = hashing.hashed_uniform(key, 0, (10_000,))
    np.testing.assert_array_equal(first, hashing.hashed_uniform(key, 0, (10_000,)))
    for numbers in (hashing.hashed_uniform(key, 1, (10_000,)), hashing.hashed_uniform(other, 0, (10_000,))):
        assert np.mean(np.asarray(first) == numbers) < 0.001
        assert abs(np.corrcoef(first, numbers)[0, 1]) < 0.04


# Least squares.

refit_plane = parity.PerForm(least_squares.refit_plane)
NO_PLANE = np.array([0.1, -0.2, -1.5], np.float32)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("offset_m", [0.0, 60.0])
def test_refit_plane_is_the_least_squares_plane_of_the_inliers(seed, offset_m):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (300, 3)) + np.array([offset_m, 0, 0])
    a, b, c = plane = rng.uniform(-0.1, 0.1, 3)
    inliers = rng.random(300) < 0.7
    points[inliers, 2] = (
        a * points[inliers, 0] + b * points[inliers, 1] + c + rng.normal(0, 0.1, inliers.sum())
    )
    points = points.astype(np.float32)
    columns = np.column_stack([points[inliers, :2], np.ones(inliers.sum())]).astype(float)
    expected = np.linalg.lstsq(columns, points[inliers, 2].astype(float))[0]
    found = refit_plane(points, inliers, (plane + np.array([0.01, -0.01, 0.1])).astype(np.float32))
    np.testing.assert_allclose(found[:2], expected[:2], atol=2e-5)
    np.testing.assert_allclose(found[2], expected[2], atol=2e-5 * (1 + offset_m))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("inliers", ["none", "one", "on a line"])
def test_refit_plane_keeps_a_plane_that_the_inliers_leave_open(inliers):
    points = np.random.default_rng(0).normal(size=(300, 3)).astype(np.float32)
    flags = np.arange(300) < {"none": 0, "one": 1, "on a line": 40}[inliers]
    points[:40, 1] = 2 * points[:40, 0]
    np.testing.assert_array_equal(refit_plane(points, flags, NO_PLANE), NO_PLANE)


# Grids.


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("num_rows", "num_cells"), [(1, 1), (50, 7), (3000, 40)])
def test_rows_are_summed_by_cell(num_rows, num_cells):
    rng = np.random.default_rng(num_rows)
    rows = rng.integers(0, num_cells, (num_rows, 4)).astype(np.float32)
    cell, sums = jax.jit(
        lambda rows: grids.sum_cells(lambda r: r[:, 0].astype(jnp.uint32), rows, num_cells=num_cells)
    )(rows)
    np.testing.assert_array_equal(cell, rows[:, 0])
    expected = np.zeros((num_cells, 4), np.float32)
    np.add.at(expected, rows[:, 0].astype(int), rows)
    np.testing.assert_array_equal(sums, expected)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("num_cells", [4, 40, 4 * chunks.FILTER_BLOCKS, 4 * chunks.FILTER_BLOCKS + 4])
@pytest.mark.parametrize("num_points", [1, 50, 5000])
def test_map_cells_looks_up_a_function_of_each_points_cell(num_cells, num_points):
    rng = np.random.default_rng(num_cells)
    cell = rng.integers(0, num_cells, num_points).astype(np.uint32)
    table = rng.normal(size=(num_cells, 4)).astype(np.float32)
    sums = np.zeros((num_cells, 4), np.float32)
    np.add.at(sums, cell, 1)
    function = jax.jit(lambda cells, sums: grids.map_cells(lambda c: jnp.asarray(table)[c], cells, sums))
    columns = function(cell, sums)
    assert len(columns) == 3
    np.testing.assert_array_equal(np.stack(columns, axis=1), table[cell, :3])


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (5, 3), (4, 16)])
@pytest.mark.parametrize(("num_levels", "num_above"), [(1, 0), (3, 2)])
@pytest.mark.parametrize("num_points", [0, 1, 400])
def test_window_counts_are_of_the_nine_cells_round_each(shape, num_levels, num_above, num_points):
    rng = np.random.default_rng(num_points)
    level, row, column = (rng.integers(0, size, num_points, np.int32) for size in (num_levels, *shape))
    valid = rng.random(num_points) < 0.8

    @jax.jit
    def count(level, row, column, valid):
        cell = grids.margin_cells(row, column, shape)
        levels = {"num_levels": num_levels, "num_above": num_above}
        return cell, grids.window_counts(level, cell, valid, shape=shape, **levels)

    cell, counts = count(level, row, column, valid)
    np.testing.assert_array_equal(cell, row * (shape[1] + 1) + column)
    expected = np.zeros((num_levels + num_above, *shape))
    np.add.at(expected, (level[valid], row[valid], column[valid]), 1)
    expected = ndimage.convolve(expected, np.ones((1, 3, 3)), mode="constant")
    assert counts.shape[0] == num_levels + num_above
    inside = np.arange(shape[0])[:, None] * (shape[1] + 1) + np.arange(shape[1])
    np.testing.assert_array_equal(counts[:, inside], expected)


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize("times", [1, 2, 3])
def test_enlarged_cells_are_squares_of_each(times):
    grid = np.arange(15, dtype=np.float32).reshape(3, 5)
    larger = jax.jit(functools.partial(grids.enlarge_cells, times=times))(grid)
    np.testing.assert_array_equal(larger, np.kron(grid, np.ones((times, times))))


@pytest.mark.usefixtures("platform")
@pytest.mark.parametrize(("sheets", "levels", "width"), [(3, 3, 3), (4, 5, 7), (6, 4, 3)])
@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_window_sums_are_those_of_the_27_neighbours(sheets, levels, width, weight):
    cells = np.random.default_rng(levels).integers(0, 50, (sheets, levels, width, 4)).astype(np.float32)
    sums = jax.jit(lambda s, w: grids.window_sums(s, levels, w))(
        cells.reshape(sheets * levels, -1), np.float32(weight)
    )
    expected = np.zeros((sheets - 2, levels - 2, width - 2, 4))
    for i, j, k in np.ndindex(3, 3, 3):
        part = cells[i : sheets - 2 + i, j : levels - 2 + j, k : width - 2 + k]
        expected += weight ** (abs(i - 1) + abs(j - 1) + abs(k - 1)) * part
    at = jax.jit(functools.partial(grids.window_at))(sums, np.arange(sums.size // 4, dtype=np.uint32))
    np.testing.assert_array_equal(at, np.reshape(sums, (-1, 4)))
    # The lines but for the margins of a grid whose sheets lie one after the other.
    assert sums.shape == (sheets * levels - 2 * levels - 2, 4 * width - 8)
    for i, j in np.ndindex(sheets - 2, levels - 2):
        np.testing.assert_allclose(sums[i * levels + j], expected[i, j].reshape(-1), rtol=1e-6)
