"""Window correlations for all hypotheses of inverse depth."""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled

_ROW = "float32[::1]"


# Only loops that write one row and read a few are vectorized.
@compiled(f"void({_ROW}, {_ROW}, {_ROW}, {_ROW}, float32, float32, float32)")
def _project(
    coordinates: NDArray[np.float32],
    field: NDArray[np.float32],
    ray: NDArray[np.float32],
    depth: NDArray[np.float32],
    offset: float,
    shift: float,
    shift_depth: float,
) -> None:
    """Compute one coordinate of a row of pixels in a source view."""
    tiny, min_ratio, zero = np.float32(np.finfo(np.float32).tiny), np.float32(1e-6), np.float32(0)
    half, behind = np.float32(0.5), np.float32(-1e9)  # outside every picture
    for x in range(len(coordinates)):
        q = max(field[x] + offset, tiny)
        ratio = depth[x] + shift_depth * q
        coordinate = (ray[x] + shift * q) / max(ratio, min_ratio) - half
        coordinates[x] = coordinate if ratio > zero else behind


@compiled(
    f"void({_ROW}, boolean[::1], {_ROW}, {_ROW}, boolean[::1], float32[:,::1], boolean[:,::1])"
)
def _look_up(
    values: NDArray[np.float32],
    visible: NDArray[np.bool_],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    needed: NDArray[np.bool_],
    tone: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> None:
    """Sample a source bilinearly at a row of points; mark points with a usable nearest pixel."""
    height, width = tone.shape
    zero, half = np.float32(0), np.float32(0.5)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    for x in range(len(values)):
        if not needed[x]:
            continue
        u, v = min(max(across[x], zero), right), min(max(down[x], zero), bottom)
        column, line = np.uint32(u), np.uint32(v)
        next_column = np.uint32(min(column + 1, width - 1))
        next_line = np.uint32(min(line + 1, height - 1))
        fraction_u, fraction_v = u - np.float32(column), v - np.float32(line)
        upper = tone[line, column]
        upper += fraction_u * (tone[line, next_column] - upper)
        lower = tone[next_line, column]
        lower += fraction_u * (tone[next_line, next_column] - lower)
        values[x] = upper + fraction_v * (lower - upper)
        inside = abs(across[x] - u) <= half and abs(down[x] - v) <= half
        nearest_line = line if fraction_v < half else next_line
        nearest_column = column if fraction_u < half else next_column
        visible[x] = inside and usable[nearest_line, nearest_column]


@compiled(f"void({_ROW}, {_ROW}, {_ROW}, {_ROW})")
def _add_powers(
    total: NDArray[np.float32],
    square: NDArray[np.float32],
    weight: NDArray[np.float32],
    values: NDArray[np.float32],
) -> None:
    for x in range(len(total)):
        scaled = weight[x] * values[x]
        total[x] += scaled
        square[x] += scaled * values[x]


@compiled(f"void({_ROW}, {_ROW}, {_ROW})")
def _add(total: NDArray[np.float32], a: NDArray[np.float32], b: NDArray[np.float32]) -> None:
    for x in range(len(total)):
        total[x] += a[x] * b[x]


@compiled(f"void({_ROW}, {_ROW})")
def _increase(total: NDArray[np.float32], values: NDArray[np.float32]) -> None:
    for x in range(len(total)):
        total[x] += values[x]


@compiled(f"void({_ROW}, {_ROW}, {_ROW}, {_ROW}, {_ROW}, boolean[::1], float32)")
def _correlate(
    scores: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    product: NDArray[np.float32],
    power: NDArray[np.float32],
    valid_row: NDArray[np.bool_],
    floor: float,
) -> None:
    zero = np.float32(0)
    for x in range(len(scores)):
        spread = max(square[x] - mean[x] * mean[x], zero)
        correlation = product[x] / np.sqrt((spread + floor) * (power[x] + floor))
        scores[x] = correlation if valid_row[x] else zero


@compiled(f"void({_ROW}, {_ROW})")
def _swap(above: NDArray[np.float32], below: NDArray[np.float32]) -> None:
    """Sort each pair of values, the larger one into ``above``."""
    for x in range(len(above)):
        first, second = above[x], below[x]
        above[x], below[x] = max(first, second), min(first, second)


@compiled(
    "void(float32[:,::1], float32[::1], float32[:,:,:,::1], float32[:,::1], float32[:,:,::1], "
    "boolean[:,:,::1], float32[:,:,::1], float32[:,:,::1], float32[:,::1], boolean[:,::1], "
    "float32, int64, float32[:,:,::1])"
)
def window_scores(
    field: NDArray[np.float32],
    offsets: NDArray[np.float32],
    ray: NDArray[np.float32],
    shift: NDArray[np.float32],
    tone: NDArray[np.float32],
    usable: NDArray[np.bool_],
    weight: NDArray[np.float32],
    deviation: NDArray[np.float32],
    power: NDArray[np.float32],
    valid: NDArray[np.bool_],
    floor: float,
    best: int,
    scores: NDArray[np.float32],
) -> None:
    """Compute the score of every pixel for the field plus each offset.

    Rows are processed in bands: a band's weights stay in the cache for all offsets and sources.

    Args:
        field: Inverse depths; the sum with an offset is clamped to the smallest positive float.
        ray: See :class:`~pimper_torch.stages.coarse.window_matching.Pairing`, also for ``shift``.
        tone: Of the sources, like ``usable``.
        weight: Of the pixels of every window, ``entry height width``; sums to 1.
        deviation: This weight times the tone's difference from the window's mean.
        power: Variance of the tone in every window.
        valid: Valid pixels of the reference view; the score of others is 0.
        floor: Added to variances: regularization of windows without texture.
        best: The score is the mean of this number of largest correlations.
    """
    num_sources, height, width = tone.shape
    num_entries = weight.shape[0]
    side = int(math.sqrt(num_entries) + 0.5)
    radius = side // 2
    best = min(best, num_sources)
    # The weights of a band, read for every hypothesis, fit a core's cache: 768 kB.
    band = max(8, (3 << 18) // (8 * num_entries * width))
    sampled = np.zeros((num_sources, band + 2 * radius, width + 2 * radius), dtype=np.float32)
    visible = np.zeros((num_sources, band + 2 * radius, width), dtype=np.bool_)
    across, down = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    sums = np.empty((3, width), dtype=np.float32)
    correlations = np.empty((num_sources, width), dtype=np.float32)
    # Range of columns with valid pixels in each row.
    first, last = np.full(height, width), np.zeros(height, dtype=np.int64)
    for y in range(height):
        for x in range(width):
            if valid[y, x]:
                first[y], last[y] = min(first[y], x), max(last[y], x + 1)
    scores[:] = 0
    for top in range(0, height, band):
        end = min(height, top + band)
        for index in range(len(offsets)):
            for s in range(num_sources):
                for row in range(end - top + 2 * radius):
                    y = min(max(top + row - radius, 0), height - 1)
                    low, high = first[y], last[y]
                    if low >= high:
                        continue
                    u, v = across[low:high], down[low:high]
                    moved, depth = field[y, low:high], ray[s, 2, y, low:high]
                    offset, along = offsets[index], shift[s, 2]
                    _project(u, moved, ray[s, 0, y, low:high], depth, offset, shift[s, 0], along)
                    _project(v, moved, ray[s, 1, y, low:high], depth, offset, shift[s, 1], along)
                    values = sampled[s, row, low + radius : high + radius]
                    needed = valid[y, low:high]
                    _look_up(values, visible[s, row, low:high], u, v, needed, tone[s], usable[s])
                    sampled[s, row, :radius] = sampled[s, row, radius]
                    sampled[s, row, width + radius :] = sampled[s, row, width + radius - 1]
            for y in range(top, end):
                low, high = first[y], last[y]
                if low >= high:
                    continue
                for s in range(num_sources):
                    mean, square, product = sums[0, low:high], sums[1, low:high], sums[2, low:high]
                    sums[:] = 0
                    for entry in range(num_entries):
                        column = low + entry % side
                        values = sampled[s, y - top + entry // side, column : column + high - low]
                        _add_powers(mean, square, weight[entry, y, low:high], values)
                        _add(product, deviation[entry, y, low:high], values)
                    valid_row = visible[s, y - top + radius, low:high]
                    row_scores, varied = correlations[s, low:high], power[y, low:high]
                    _correlate(row_scores, mean, square, product, varied, valid_row, floor)
                for rank in range(best):
                    for s in range(num_sources - 1, rank, -1):
                        _swap(correlations[s - 1, low:high], correlations[s, low:high])
                    _increase(scores[index, y, low:high], correlations[rank, low:high])
                for x in range(low, high):
                    mean_of_best = scores[index, y, x] / np.float32(best)
                    scores[index, y, x] = mean_of_best if valid[y, x] else np.float32(0)
