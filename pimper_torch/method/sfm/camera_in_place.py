r"""The motion of the room before a camera that stays in its place.

A camera that turns about its centre, zooms, or has its pictures cropped sees a room at rest move by
one homography from photograph to photograph, and by the same one all round the sequence:
:math:`H_{ij} = A_j^{-1} A_i`, where :math:`A_i` maps the pixels of photograph i to those of a
reference. Of a point that turns, no such maps hold for long. With small turns :math:`A` is a
similarity with a perspective row, to the second order of the angle (2.7 px at the corner of 800
after a turn by 6.7 degrees, or 150 px; a full homography, fitted last, has that, too):

.. math:: A \propto \begin{pmatrix} a & -b & t_u \\ b & a & t_v \\ p & q & 1 \end{pmatrix}

A plane that turns with the object, such as a table, moves by homographies that are consistent, too,
but are no such ones: by :math:`I + t n^T / d`, which shears and does not preserve angles.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Bool, Complex, Float
from torch import Tensor

from pimper_torch.ground.geometry.pixels import homogeneous
from pimper_torch.method.sfm.matching import Keypoints, Matches, pixels_of

# Fraction of the photographs that must be tied to the reference. Before rooms that shift all of 20
# are (6 rendered turntables); of the skull's 24, round which a camera moves, 8 at most.
_MIN_TIED = 0.5
# Zoom, and roll in radians, of a touched tripod or of a cropped picture: a choice.
_MAX_ZOOM, _MAX_ROLL = 1.3, 0.35
Ends = tuple[Float[Tensor, "match 2"], Float[Tensor, "match 2"]]


def reference_from_photographs(
    keypoints: Keypoints,
    pairs: Matches,
    *,
    max_error_px: float,
    fewest: int,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "3 3"], ...] | None:
    """Find the maps that bring a room at rest to the same pixels in all photographs; float64.

    Photographs are tied to a reference by the similarity that most of the matches of a pair
    follow. That may be part of the object's in some: each is then tied again, to all others
    together, of which only the room's agree.

    Returns:
        ``A`` of each photograph, the identity where one cannot be tied; ``None`` where most
        cannot, or where nothing shifts by a pixel.
    """
    matched = both_ways(keypoints, pairs)
    identity, centre = torch.eye(3, dtype=torch.float64), picture_centre(keypoints)
    count = len(keypoints)
    best: dict[int, Tensor] = {}
    for reference in references(count):
        tied = tied_to(matched[reference], centre, max_error_px, fewest, generator)
        maps = {reference: identity} | {view: found[0] for view, found in tied.items()}
        best = max(best, maps, key=len)
    if len(best) < _MIN_TIED * count or shift_px(tuple(best.values()), keypoints) < 1:
        return None
    for _ in range(2):  # the second sees all maps that the first corrected
        for view in range(count):
            others = [other for other in matched[view] if other in best]
            if not others:
                continue
            ends = (
                torch.cat([matched[view][other][0] for other in others]),
                torch.cat([mapped(best[other], matched[view][other][1]) for other in others]),
            )
            some = torch.randperm(len(ends[0]), generator=generator)[:4000]
            found = fit_map(ends[0][some], ends[1][some], centre, max_error_px, generator)
            if found is not None and found[1].sum() >= fewest:
                best[view] = found[0]
    return tuple(best.get(view, identity) for view in range(count))


def still_length_px(keypoints: Keypoints, pairs: Matches, least_px: float) -> float:
    """Return the length up to which a match is still, between photographs mapped to one of them.

    A tripod that was touched has moved by a little, too, and things at other depths than most of
    the room are then brought back less exactly. Three times the median length of the matches
    that are short: simulated with 0.2 px of noise and a camera that moves by 2 % of its distance
    before a room of that depth and twice as far, 5.7 px, with which 96 % of its features are
    found; with 2 px 69 %.
    """
    lengths = torch.cat(
        [torch.sub(*pixels_of(keypoints, pair, rows)).norm(dim=1) for pair, rows in pairs.items()]
    )
    short = lengths[lengths < 10]
    if len(short) == 0:
        return least_px
    return min(max(least_px, 3 * float(short.median())), 10.0)


def references(count: int) -> list[int]:
    """List three photographs, evenly over a sequence: one alone may be blurred or covered."""
    return sorted({(2 * slot + 1) * count // 6 for slot in range(3)})


def tied_to(
    matched: Mapping[int, Ends],
    centre: Float[Tensor, " 2"],
    max_error_px: float,
    fewest: int,
    generator: torch.Generator,
    *,
    any_homography: bool = True,
) -> dict[int, tuple[Float[Tensor, "3 3"], Bool[Tensor, " match"]]]:
    """Find the map to a reference of each photograph that can be tied, and the matches that follow.

    Args:
        matched: Pixels in the reference and in each other photograph.
    """
    tied = {}
    for view, (here, there) in matched.items():
        found = fit_map(there, here, centre, max_error_px, generator, any_homography=any_homography)
        if found is not None and found[1].sum() >= fewest:
            tied[view] = found
    return tied


def shift_px(maps: Sequence[Float[Tensor, "3 3"]], keypoints: Keypoints) -> float:
    """Return the largest shift of the pictures' middle among maps to a reference."""
    middle = picture_centre(keypoints)[None]
    return max(float((mapped(one, middle) - middle).norm()) for one in maps)


def picture_centre(keypoints: Keypoints) -> Float[Tensor, " 2"]:
    """Return the middle of what features cover in all photographs; float64."""
    everywhere = torch.cat(list(keypoints)).double()
    return (everywhere.amin(dim=0) + everywhere.amax(dim=0)) / 2


def fit_map(
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
    centre: Float[Tensor, " 2"],
    max_error_px: float,
    generator: torch.Generator,
    *,
    any_homography: bool = True,
) -> tuple[Float[Tensor, "3 3"], Bool[Tensor, " match"]] | None:
    """Find the map of a camera in its place that most matches follow, and which do.

    Similarities through two matches each are hypotheses (RANSAC); the best is refined with the
    perspective row, then as a homography, by least squares of the matches that follow.

    Args:
        first: Pixels, also of matches that are wrong or of what turns.
        any_homography: Whether the last fits are of all homographies, which large turns need: a
            plane seen from round it follows them, too, and no similarity with a perspective row.

    Returns:
        ``None`` where no hypothesis is a small zoom and roll.
    """
    if len(first) < 2:
        return None
    first, second = first.double(), second.double()
    x, y = (torch.view_as_complex(end.contiguous()) for end in (first, second))
    # Enough to hit two of the room once at 0.99 where it has 15 % of the matches.
    one, other = torch.randint(len(x), (2, 200), generator=generator)
    scale = (y[other] - y[one]) / (x[other] - x[one])  # not finite where both are one match
    small = (scale.abs().log().abs() < math.log(_MAX_ZOOM)) & (scale.angle().abs() < _MAX_ROLL)
    scale, shift = scale[small], (y[one] - scale * x[one])[small]
    if len(scale) == 0:
        return None
    some = torch.randperm(len(x), generator=generator)[:2000]
    # Without perspective, a map is right in a part of the picture only.
    error = (scale[:, None] * x[some] + shift[:, None] - y[some]).abs()
    most = int((error < 2 * max_error_px).sum(dim=1).argmax())
    follows = (scale[most] * x + shift[most] - y).abs() < 2 * max_error_px
    matrix = _similarity(scale[most], shift[most])
    for step in range(10):
        if follows.sum() < 8:
            break
        free = any_homography and step >= 5
        matrix = least_squares_map(first[follows], second[follows], None if free else centre)
        follows = (mapped(matrix, first) - second).norm(dim=1) < max_error_px
    return matrix, follows


def least_squares_map(
    first: Float[Tensor, "match 2"],
    second: Float[Tensor, "match 2"],
    centre: Float[Tensor, " 2"] | None = None,
) -> Float[Tensor, "3 3"]:
    """Fit any homography or, about a centre, a similarity with a perspective row.

    The residuals are multiplied by the denominators, which are about 1 for small turns.
    """
    similar = centre is not None
    centre = first.mean(dim=0) if centre is None else centre
    size = first.std().clamp_min(1e-9)
    x, y = (first - centre) / size, (second - centre) / size
    one, zero = torch.ones_like(x[:, :1]), torch.zeros_like(x[:, :1])
    u, v = x[:, :1], x[:, 1:]
    if similar:
        linear = [torch.cat([u, -v, one, zero], dim=1), torch.cat([v, u, zero, one], dim=1)]
    else:
        gap = torch.cat([zero, zero, zero], dim=1)
        linear = [torch.cat([x, one, gap], dim=1), torch.cat([gap, x, one], dim=1)]
    rows = torch.cat(
        [torch.cat([part, -y[:, side, None] * x], dim=1) for side, part in enumerate(linear)]
    )
    found = torch.linalg.lstsq(rows, y.mT.reshape(-1, 1), driver="gelsd").solution[:, 0]
    if similar:
        a, b, right, down, p, q = found
        elements = torch.stack([a, -b, right, b, a, down, p, q, torch.ones_like(a)])
    else:
        elements = torch.cat([found, found.new_ones(1)])
    between = torch.diag(torch.stack([1 / size, 1 / size, torch.ones_like(size)]))
    between[:2, 2] = -centre / size
    return torch.linalg.solve(between, elements.reshape(3, 3) @ between)


def mapped(
    matrix: Float[Tensor, "3 3"], pixels: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 2"]:
    """Map pixels by a homography; float64."""
    found = homogeneous(pixels.double()) @ matrix.mT
    return found[:, :2] / found[:, 2:]


def _similarity(scale: Complex[Tensor, ""], shift: Complex[Tensor, ""]) -> Float[Tensor, "3 3"]:
    a, b, right, down = scale.real, scale.imag, shift.real, shift.imag
    none = torch.zeros_like(a)
    return torch.stack([a, -b, right, b, a, down, none, none, none + 1]).reshape(3, 3)


def both_ways(keypoints: Keypoints, pairs: Matches) -> list[dict[int, Ends]]:
    """List, for each photograph, the matches with each other one: pixels here and there."""
    found: list[dict[int, Ends]] = [{} for _ in keypoints]
    for (first, second), rows in pairs.items():
        if len(rows):
            ends = pixels_of(keypoints, (first, second), rows)
            found[first][second], found[second][first] = ends, ends[::-1]
    return found
