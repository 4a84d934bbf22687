"""Windows and their correlation through moved fields: the twin of ``Matcher``."""

import math

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.switch import compiled

# Bytes of windows' weights that are read again for every field: as much as stays in a core's cache.
_CACHED = 3 << 18

_ROW = "float32[::1]"


@compiled(
    "void(float32[:,::1], boolean[:,::1], float64[::1], float64, float32[:,:,::1], "
    "float32[:,:,::1], float32[:,::1])"
)
def window_weights(
    tone: NDArray[np.float32],
    here: NDArray[np.bool_],
    spatial: NDArray[np.float64],
    likeness: float,
    weight: NDArray[np.float32],
    deviation: NDArray[np.float32],
    power: NDArray[np.float32],
) -> None:
    """Fill in what :func:`window_scores` knows of every window of a view beforehand.

    Args:
        tone: Of the view, ``height width``.
        here: Where it says something; elsewhere 0 is filled in.
        spatial: Weight of every place of a window, row by row.
        likeness: Difference of tone to the centre at which a weight has fallen to 0.6.
        weight: Filled in, ``place height width``; adds up to 1.
        deviation: Filled in: weight times the difference of the tone to the window's mean.
        power: Filled in: variance of the tone in the window.
    """
    height, width = tone.shape
    num_places = len(spatial)
    side = int(math.sqrt(num_places) + 0.5)
    around, fraction = np.empty(num_places), np.empty(num_places)
    rows, columns = np.empty(num_places, dtype=np.int64), np.empty(num_places, dtype=np.int64)
    for place in range(num_places):
        rows[place], columns[place] = place // side - side // 2, place % side - side // 2
    weight[:] = 0
    deviation[:] = 0
    power[:] = 0
    for y in range(height):
        for x in range(width):
            if not here[y, x]:
                continue
            total = mean = variance = 0.0
            for place in range(num_places):
                row = min(max(y + rows[place], 0), height - 1)
                column = min(max(x + columns[place], 0), width - 1)
                around[place] = tone[row, column]
                away = (around[place] - tone[y, x]) / likeness
                fraction[place] = spatial[place] * math.exp(-away * away / 2) * here[row, column]
                total += fraction[place]
                mean += fraction[place] * around[place]
            mean /= total
            for place in range(num_places):
                weighed = fraction[place] / total
                off = weighed * (around[place] - mean)
                weight[place, y, x], deviation[place, y, x] = weighed, off
                variance += off * (around[place] - mean)
            power[y, x] = variance


# Loops of one written row and few read ones: only those become vector instructions.
@compiled(f"void({_ROW}, {_ROW}, {_ROW}, {_ROW}, float32, float32, float32)")
def _place(
    places: NDArray[np.float32],
    field: NDArray[np.float32],
    ray: NDArray[np.float32],
    depth: NDArray[np.float32],
    offset: float,
    shift: float,
    shift_depth: float,
) -> None:
    """Give one coordinate of the places that a row of pixels has in a source."""
    tiny, near, zero = np.float32(np.finfo(np.float32).tiny), np.float32(1e-6), np.float32(0)
    half, behind = np.float32(0.5), np.float32(-1e9)  # left of every picture
    for x in range(len(places)):
        q = max(field[x] + offset, tiny)
        ratio = depth[x] + shift_depth * q
        at = (ray[x] + shift * q) / max(ratio, near) - half
        places[x] = at if ratio > zero else behind


@compiled(
    f"void({_ROW}, boolean[::1], {_ROW}, {_ROW}, boolean[::1], float32[:,::1], boolean[:,::1])"
)
def _look_up(
    values: NDArray[np.float32],
    there: NDArray[np.bool_],
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    asked: NDArray[np.bool_],
    tone: NDArray[np.float32],
    usable: NDArray[np.bool_],
) -> None:
    """Look a row of places up, bilinearly; say whether the nearest pixel is usable."""
    height, width = tone.shape
    zero, half = np.float32(0), np.float32(0.5)
    right, bottom = np.float32(width - 1), np.float32(height - 1)
    for x in range(len(values)):
        if not asked[x]:
            continue
        u, v = min(max(across[x], zero), right), min(max(down[x], zero), bottom)
        column, line = np.uint32(u), np.uint32(v)
        beside = np.uint32(min(column + 1, width - 1))
        below = np.uint32(min(line + 1, height - 1))
        part_u, part_v = u - np.float32(column), v - np.float32(line)
        upper = tone[line, column]
        upper += part_u * (tone[line, beside] - upper)
        lower = tone[below, column]
        lower += part_u * (tone[below, beside] - lower)
        values[x] = upper + part_v * (lower - upper)
        inside = abs(across[x] - u) <= half and abs(down[x] - v) <= half
        nearest_line = line if part_v < half else below
        nearest_column = column if part_u < half else beside
        there[x] = inside and usable[nearest_line, nearest_column]


@compiled(f"void({_ROW}, {_ROW}, {_ROW}, {_ROW})")
def _add_powers(
    total: NDArray[np.float32],
    square: NDArray[np.float32],
    weight: NDArray[np.float32],
    values: NDArray[np.float32],
) -> None:
    for x in range(len(total)):
        weighed = weight[x] * values[x]
        total[x] += weighed
        square[x] += weighed * values[x]


@compiled(f"void({_ROW}, {_ROW}, {_ROW})")
def _add(total: NDArray[np.float32], one: NDArray[np.float32], other: NDArray[np.float32]) -> None:
    for x in range(len(total)):
        total[x] += one[x] * other[x]


@compiled(f"void({_ROW}, {_ROW}, {_ROW}, {_ROW}, {_ROW}, boolean[::1], float32)")
def _correlate(
    found: NDArray[np.float32],
    mean: NDArray[np.float32],
    square: NDArray[np.float32],
    both: NDArray[np.float32],
    power: NDArray[np.float32],
    told: NDArray[np.bool_],
    floor: float,
) -> None:
    zero = np.float32(0)
    for x in range(len(found)):
        spread = max(square[x] - mean[x] * mean[x], zero)
        likeness = both[x] / np.sqrt((spread + floor) * (power[x] + floor))
        found[x] = likeness if told[x] else zero


@compiled(f"void({_ROW}, {_ROW})")
def _swap(above: NDArray[np.float32], below: NDArray[np.float32]) -> None:
    """Put the larger one of each pair above."""
    for x in range(len(above)):
        one, other = above[x], below[x]
        above[x], below[x] = max(one, other), min(one, other)


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
    here: NDArray[np.bool_],
    floor: float,
    best: int,
    scores: NDArray[np.float32],
) -> None:
    """Fill in the score of every pixel for a field moved by every offset.

    Rows are taken band by band, so that a band's weights are read from the cache for all offsets
    and sources.

    Args:
        field: Inverse depths, ``height width``.
        offsets: That it is moved by; nowhere below the smallest positive number.
        ray: See :class:`~pimper_torch.coarse.matching.Pairing`, ``source 3 height width``.
        shift: Of the same, ``source 3``.
        tone: Of the sources, ``source height width``.
        usable: Where the sources say something.
        weight: Of the pixels of every window, ``place height width``; 0 where ``here`` is false.
        deviation: That weight times the tone's difference to the window's mean.
        power: Variance of the tone in every window.
        here: Where the view says something; 0 is filled in elsewhere.
        floor: Variance below which a window says little.
        best: Sources that are believed.
        scores: Filled in, ``offset height width``.
    """
    num_sources, height, width = tone.shape
    num_places = weight.shape[0]
    side = int(math.sqrt(num_places) + 0.5)
    radius = side // 2
    best = min(best, num_sources)
    band = max(8, _CACHED // (8 * num_places * width))
    seen = np.zeros((num_sources, band + 2 * radius, width + 2 * radius), dtype=np.float32)
    there = np.zeros((num_sources, band + 2 * radius, width), dtype=np.bool_)
    across, down = np.empty(width, dtype=np.float32), np.empty(width, dtype=np.float32)
    sums = np.empty((3, width), dtype=np.float32)
    found = np.empty((num_sources, width), dtype=np.float32)
    # Columns that each row is asked about.
    first, last = np.full(height, width), np.zeros(height, dtype=np.int64)
    for y in range(height):
        for x in range(width):
            if here[y, x]:
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
                    _place(u, moved, ray[s, 0, y, low:high], depth, offset, shift[s, 0], along)
                    _place(v, moved, ray[s, 1, y, low:high], depth, offset, shift[s, 1], along)
                    values = seen[s, row, low + radius : high + radius]
                    asked = here[y, low:high]
                    _look_up(values, there[s, row, low:high], u, v, asked, tone[s], usable[s])
                    seen[s, row, :radius] = seen[s, row, radius]
                    seen[s, row, width + radius :] = seen[s, row, width + radius - 1]
            for y in range(top, end):
                low, high = first[y], last[y]
                if low >= high:
                    continue
                for s in range(num_sources):
                    mean, square, both = sums[0, low:high], sums[1, low:high], sums[2, low:high]
                    sums[:] = 0
                    for place in range(num_places):
                        column = low + place % side
                        values = seen[s, y - top + place // side, column : column + high - low]
                        _add_powers(mean, square, weight[place, y, low:high], values)
                        _add(both, deviation[place, y, low:high], values)
                    told = there[s, y - top + radius, low:high]
                    likeness, varied = found[s, low:high], power[y, low:high]
                    _correlate(likeness, mean, square, both, varied, told, floor)
                for rank in range(best):
                    for s in range(num_sources - 1, rank, -1):
                        _swap(found[s - 1, low:high], found[s, low:high])
                    scores[index, y, low:high] += found[rank, low:high]
                scores[index, y, low:high] /= np.float32(best)
                for x in range(low, high):
                    if not here[y, x]:
                        scores[index, y, x] = 0
