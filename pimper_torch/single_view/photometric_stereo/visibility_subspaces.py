r"""Visibility of point lights at pixels, by subspace clustering.

Pixels lit by the same point lights have brightness :math:`V L b`, with V the diagonal matrix of
their visibility: they lie in one subspace of three dimensions, which is zero for the point lights
in shadow. Each set of point lights has its own; random samples find those of many pixels.

Source: Sunkavalli, Zickler & Pfister, Visibility subspaces: uncalibrated photometric stereo with
shadows, ECCV 2010.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.photometry.quadratics import outer, solve_packed
from pimper_torch.records import Record

# Triples of pixels tried for each subspace, and the distance of their pixels: choices.
_TRIALS, _NEIGHBOURHOOD = 300, 4
# Pixels on which triples are compared: a choice.
_COMPARED = 3000
# Maximum distance of a pixel from its subspace, in that of noise: a choice.
_TOLERANCE = 1.5
# Standard deviations from its prediction, or from zero, that are significant: a choice.
_DEVIATIONS = 3.0
_REFITS, _RECLASSIFICATIONS = 4, 8


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class VisibilitySubspaces(Record):
    """Visibility and lights from the subspaces of a scene.

    Attributes:
        lit: Whether a point light lights a pixel.
        lights: Up to an invertible 3 x 3 matrix, orthonormal columns: initial values for a
            factorization with shadows masked. Zero for point lights that no subspace sees.
        subspace: Index of each pixel's subspace, largest first; -1 for none.
        visibility: Point lights by subspaces.
    """

    lit: Bool[Tensor, "view pixel"]
    lights: Float[Tensor, "view 3"]
    subspace: Int[Tensor, " pixel"]
    visibility: Bool[Tensor, "view subspace"]


def visibility_subspaces(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    generator: torch.Generator,
    *,
    noise: float = 0.01,
) -> Bool[Tensor, "view pixel"]:
    """Find which views light each pixel; see :func:`find_subspaces`."""
    return find_subspaces(images, mask, generator, noise=noise).lit


def find_subspaces(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    generator: torch.Generator,
    *,
    noise: float = 0.01,
    smallest: float = 0.01,
    most: int = 30,
) -> VisibilitySubspaces:
    r"""Find the subspaces of pixels lit by the same point lights, and the visibility of all pixels.

    Triples of neighbouring pixels, which mostly have the same visibility, propose subspaces; the
    one with the most inliers is refitted to them and removed, and the search goes on. Bases
    :math:`Q_k`, orthonormal and zero at point lights in shadow, are :math:`V_k L` up to a matrix
    each. The common lights are the three least eigenvectors of

    .. math:: \sum_k m_k (V_k - Q_k Q_k^\top)

    for :math:`m_k` pixels. With them each pixel is fitted to the views of its subspace, or to its
    brightest ones if it has none; then inliers and lights are updated in turn.

    Args:
        images: Linear radiance without ambient light; channels are added.
        mask: Pixels to use, in raster order.
        generator: On the CPU.
        noise: Standard deviation of a value, as a fraction of the brightest.
        smallest: Fraction of the pixels that a subspace must hold.
        most: Subspaces.

    Returns:
        Visibility, subspaces and lights. An outlier, too dark, too bright or near zero, counts as
        not lit, and so do all values of a pixel with fewer than four inliers. Constant to
        autograd.

    Fails where every pixel has its own set of point lights, where point lights have no subspace in
    common, and where indirect light keeps shadows brighter than noise: all of a subspace then
    counts as lit.

    Raises:
        InputError: Fewer than four views, noise that is not above zero, or no subspace found.

    Source: Sunkavalli, Zickler & Pfister, ECCV 2010, for subspaces and their search; the
    eigenvalue problem for the lights, and the classification of single values, are ours.
    """
    if len(images) < 4 or noise <= 0:
        raise InputError(
            f"{len(images)} views and noise of {noise}; needed: four views at least, as three "
            "always lie in a subspace of three dimensions, and noise above zero."
        )
    with torch.no_grad():
        values = images.double().sum(dim=1)[:, mask]
        deviation = noise * float(values.max())
        row, column = mask.nonzero().mT
        position = torch.full_like(mask, -1, dtype=torch.int64)
        position[mask] = torch.arange(values.shape[1], device=mask.device)
        subspace = torch.full_like(row, -1)
        bases, visible, counts = list[Tensor](), list[Tensor](), list[float]()
        fewest = max(8, int(smallest * values.shape[1]))
        bright = values.norm(dim=0) > _DEVIATIONS * deviation * len(values) ** 0.5
        while len(bases) < most:
            free = bright & (subspace < 0)
            triples = _triples(free, row, column, position, generator)
            found = _largest(values, free, triples, deviation)
            if found is None or int(found[1].sum()) < fewest:
                break
            basis, inside = found
            lit = values[:, inside].square().mean(dim=1).sqrt() > _DEVIATIONS * deviation
            subspace[inside] = len(bases)
            if int(lit.sum()) >= 4:
                bases.append(torch.linalg.qr(basis * lit[:, None]).Q)
                visible.append(lit)
                counts.append(float(inside.sum()))
            else:
                subspace[inside] = -2  # found, but lit by fewer than four point lights
        if not bases:
            raise InputError(
                f"no {fewest} of {values.shape[1]} pixels lie in one subspace; needed: a matt "
                "surface and distant point lights. Raise `noise`, or lower `smallest`."
            )
        visibility = torch.stack(visible, dim=1)
        lights, covered = _common_lights(bases, visibility, values.new_tensor(counts))
        half = max(4, -(-len(values) // 2))
        lit = values.argsort(dim=0, descending=True).argsort(dim=0) < half
        inside = subspace >= 0
        lit[:, inside] = visibility[:, subspace[inside]]
        lit, lights = _explained(values, lights, covered, lit, deviation)
        return VisibilitySubspaces(
            lit=lit,
            lights=lights.to(images),
            subspace=subspace.clamp_min(-1),
            visibility=visibility,
        )


def _triples(
    free: Bool[Tensor, " pixel"],
    row: Int[Tensor, " pixel"],
    column: Int[Tensor, " pixel"],
    position: Int[Tensor, "height width"],
    generator: torch.Generator,
) -> Int[Tensor, "triple 3"]:
    """Draw neighbouring pixels that are in no subspace yet."""
    pool = free.nonzero()[:, 0]
    if len(pool) == 0:
        return pool.new_zeros(0, 3)
    draws = 4 * _TRIALS
    first = pool[torch.randint(len(pool), (draws,), generator=generator).to(pool.device)]
    side = 2 * _NEIGHBOURHOOD + 1
    offset = torch.randint(side, (2, 2, draws), generator=generator) - _NEIGHBOURHOOD
    offset = offset.to(pool.device)
    height, width = position.shape
    y = (row[first] + offset[0]).clamp(0, height - 1)
    x = (column[first] + offset[1]).clamp(0, width - 1)
    other = position[y, x]
    usable = (other >= 0).all(dim=0) & free[other.clamp_min(0)].all(dim=0)
    return torch.cat([first[None], other])[:, usable][:, :_TRIALS].mT


def _largest(
    values: Float[Tensor, "view pixel"],
    free: Bool[Tensor, " pixel"],
    triples: Int[Tensor, "triple 3"],
    deviation: float,
) -> tuple[Float[Tensor, "view 3"], Bool[Tensor, " pixel"]] | None:
    """Return the triple's subspace with the most inliers among free pixels, refitted to them."""
    if len(triples) == 0:
        return None
    views = len(values)
    proposed = values[:, triples].permute(1, 0, 2)
    basis, triangle = torch.linalg.qr(proposed)
    # Nearly parallel pixels span a subspace of noise.
    sound = triangle.diagonal(dim1=1, dim2=2).abs().amin(dim=1) > 4 * deviation
    basis = basis[sound]
    if len(basis) == 0:
        return None
    pool = values[:, free]
    some = pool[:, :: max(1, -(-pool.shape[1] // _COMPARED))]
    limit = (_TOLERANCE * deviation) ** 2 * (views - 3)
    off = some.square().sum(dim=0) - (basis.mT @ some).square().sum(dim=1)
    # The triple's noise adds to that of the pixel.
    votes = (off < 4 * limit).sum(dim=1)
    best = basis[int(votes.argmax())]
    inside = free.clone()
    factor = 4.0
    for _ in range(_REFITS):
        off = values.square().sum(dim=0) - (best.mT @ values).square().sum(dim=0)
        inside = free & (off < factor * limit)
        if int(inside.sum()) < 3:
            return None
        members = values[:, inside]
        best = torch.linalg.eigh(members @ members.mT).eigenvectors[:, -3:]
        factor = 1.0
    off = values.square().sum(dim=0) - (best.mT @ values).square().sum(dim=0)
    return best, free & (off < limit)


def _common_lights(
    bases: list[Float[Tensor, "view 3"]],
    visibility: Bool[Tensor, "view subspace"],
    counts: Float[Tensor, " subspace"],
) -> tuple[Float[Tensor, "view 3"], Bool[Tensor, " view"]]:
    """Find the lights common to all subspaces, and which views have one."""
    total = bases[0].new_zeros(len(visibility), len(visibility))
    for basis, lit, count in zip(bases, visibility.mT, counts, strict=True):
        total = total + count * (torch.diag(lit.to(basis)) - basis @ basis.mT)
    covered = visibility.any(dim=1)
    inner = total[covered][:, covered]
    lights = torch.zeros_like(bases[0])
    lights[covered] = torch.linalg.eigh(inner).eigenvectors[:, :3]
    return lights, covered


def _explained(
    values: Float[Tensor, "view pixel"],
    lights: Float[Tensor, "view 3"],
    covered: Bool[Tensor, " view"],
    start: Bool[Tensor, "view pixel"],
    deviation: float,
) -> tuple[Bool[Tensor, "view pixel"], Float[Tensor, "view 3"]]:
    """Return the inliers of each pixel's fit, updating the lights in turn.

    Views that no subspace covers have no lights; there values that are not dark count as lit.
    """
    known, L = values[covered], lights[covered]
    lit = start[covered] & (known > _DEVIATIONS * deviation)
    for _ in range(_RECLASSIFICATIONS):
        vectors = _fitted(L, known, lit)
        predicted = L @ vectors
        fits = (known - predicted).abs() < _DEVIATIONS * deviation
        lit = fits & (predicted > _DEVIATIONS * deviation)
        # Three values always fit.
        lit = lit & (lit.sum(dim=0) >= 4)
        L = torch.linalg.qr(_fitted(vectors.mT, known.mT, lit.mT).mT).Q
    found = values > _DEVIATIONS * deviation
    found[covered] = lit
    lights = torch.zeros_like(lights)
    lights[covered] = L
    return found, lights


def _fitted(
    left: Float[Tensor, "row 3"], values: Float[Tensor, "row item"], used: Bool[Tensor, "row item"]
) -> Float[Tensor, "3 item"]:
    """Solve each column for its three coefficients by the values that are used."""
    weight = used.to(values)
    return solve_packed(outer(left.mT) @ weight, left.mT @ (weight * values))
