r"""Resolution of bas-relief by minimum entropy of albedo, within groups of equal chromaticity.

A wrong transformation makes the albedo of a region of one paint vary with its normals. The right
one minimizes the entropy of the histogram of albedo. A Lambertian pixel's channels only differ by
albedo and the point light's colour: :math:`\log J_{vci} = s_{vi} + e_{vc} + a_{ci}`, with the
logarithms ``e`` of the light's colour in view v and ``a`` of the colour of pixel i.

Source: Alldrin, Mallick & Kriegman, Resolving the generalized bas-relief ambiguity by entropy
minimization, CVPR 2007.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import BasRelief, standard_relief

Shading = Float[Tensor, "3 pixel"]
Labels = Int[Tensor, " pixel"]
Candidates = Float[Tensor, "candidate 3"]


def chromaticity_groups(radiance: Float[Tensor, "view channel pixel"]) -> Labels:
    """Return clusters of pixels of similar chromaticity, without the lights' colours.

    The logarithms ``e`` and ``a`` are estimated alternately by least squares, weighted by squared
    brightness. Repeatedly, the colour with the most neighbours becomes a cluster, and these are
    removed. Then every pixel is assigned to the nearest cluster within the radius.

    Args:
        radiance: Linear radiance of at least two channels; with one, all pixels are one cluster.

    Returns:
        Labels of pixels, 0 for the largest group; -1 without a group, or too dark in every view.
    """
    values = radiance.double()
    brightest = values.flatten(1).amax(dim=1)[:, None]
    bright = values.amin(dim=1) > 0.02 * brightest
    values = torch.where(bright[:, None], values, 1)
    log = values.log() - values.log().mean(dim=1, keepdim=True)
    # Harmonic: the darkest channel has the noisiest logarithm.
    weight = (bright / values.pow(-2).sum(dim=1))[:, None]
    total_view = weight.sum(dim=2).clamp_min(1e-30)
    total_pixel = weight.sum(dim=0).clamp_min(1e-30)
    point_light = torch.zeros_like(log[:, :, 0])
    # Each iteration at least halves the residual if point lights overlap.
    for _ in range(20):
        pixel = (weight * (log - point_light[..., None])).sum(dim=0) / total_pixel
        point_light = (weight * (log - pixel)).sum(dim=2) / total_view
    usable = bright.any(dim=0)
    colour = pixel[:, usable].to(radiance).mT.double().contiguous()
    sample = colour[:: max(1, -(-len(colour) // 2000))]  # all pixels are assigned later
    # In logarithm of colour: a few times the noise, and less than half the distance of paints.
    radius = 0.05
    neighbours = torch.cdist(sample, sample) < radius
    remaining = torch.ones(len(sample), dtype=torch.bool, device=sample.device)
    leaders = []
    while bool(remaining.any()):
        votes = (neighbours & remaining).sum(dim=1) * remaining
        best = int(votes.argmax())
        if int(votes[best]) < max(2, 0.01 * len(sample)):
            break
        leaders.append(sample[neighbours[best] & remaining].mean(dim=0))
        remaining = remaining & ((sample - leaders[-1]).norm(dim=1) > 2 * radius)
    labels = torch.full_like(usable, -1, dtype=torch.int64)
    if leaders:
        distance, nearest = torch.cdist(colour, torch.stack(leaders)).min(dim=1)
        labels[usable] = torch.where(distance < radius, nearest, -1)
    return labels


# Range and size of the grid of lambda and of tilts. In the standard form, lambda is 0.9 for a ball
# cut at 75 degrees and 0.15 for a surface with slopes of 0.15; mean slopes rarely exceed 1.
_MIN_LAMBDA, _MAX_LAMBDA, _LAMBDAS = 0.125, 4.0, 23
_MAX_TILT, _TILTS = 1.0, 17

# Widths of the kernel in logarithm of albedo. A wider first kernel removes the right minimum if
# albedos are close; a narrower one needs a finer grid. The last width is the noise of shading.
_FIRST_WIDTH, _LAST_WIDTH = 0.03, 0.015
# Half the range of the histogram, in logarithm of albedo: a factor of 20, chosen by hand.
_REACH = 3.0
# Number of refined grid points, halved with every kernel, and of pixels used there; chosen by hand.
_CANDIDATES, _FEW_PIXELS = 200, 1000


def resolve_by_albedo_entropy(shading: Shading, groups: Labels | None = None) -> BasRelief:
    r"""Return the bas-relief transformation of minimum albedo entropy; constant to autograd.

    Minimizes the entropy of :math:`\log \lVert G b \rVert`, smoothed by a kernel: first on a grid
    in the standard form of the surface (:func:`.standard_relief`), then, from its best points, by a
    local search with decreasing steps and kernel widths.

    Args:
        shading: Albedo times normal, up to bas-relief; zero and non-finite vectors are ignored.
        groups: Labels of pixels of equal chromaticity (:func:`.chromaticity_groups`), within which
            the entropy of brightness is minimized; by default all pixels are one group.

    Fails for surfaces with as many albedos as pixels, or few normals. Convex ones stay convex.

    Source: Alldrin, Mallick & Kriegman, CVPR 2007. The logarithm, which replaces their fixed
    scale, the standard form and the use of colour are ours.
    """
    with torch.no_grad():
        usable = shading.isfinite().all(dim=0) & (shading != 0).any(dim=0)
        count = int(usable.sum())
        if count < 50:
            raise InputError(
                f"{count} of {shading.shape[1]} shading vectors are finite and not zero; needed: "
                "at least 50, for a histogram of albedo. Enlarge the mask."
            )
        start = standard_relief(shading[:, usable])
        if not bool(start.lam.isfinite()):
            raise InputError(
                f"the normals of {count} pixels are parallel; needed: a curved surface, because a "
                "plane does not determine a bas-relief transformation. Enlarge the mask."
            )
        b = start.on_shading(shading[:, usable].double())
        labels = torch.zeros_like(b[0]).long() if groups is None else groups[usable]
        labels = torch.unique(labels, return_inverse=True)[1]
        mu, nu, log_lam = _minimized(b, labels)
        relief = BasRelief(mu=mu, nu=nu, lam=log_lam.exp()).after(start)
        return relief.to(shading.dtype)


def albedo_entropy(
    shading: Shading, labels: Labels, candidates: Candidates, width: float
) -> Float[Tensor, " candidate"]:
    """Return the entropy of log-albedo within groups after each transformation.

    Args:
        candidates: mu, nu and the logarithm of lambda.
        width: Standard deviation of the kernel, in logarithm of albedo.
    """
    # A cubic B-spline is nearly a Gaussian of width 1 / sqrt(3) bins, and the entropy of its
    # samples hardly depends on their position within a bin.
    bins_per_unit = 1 / (3**0.5 * width)
    bins = int(2 * _REACH * bins_per_unit) + 4
    x, y, z = shading
    entropies = []
    # Batches of products fit into the cache.
    for batch in torch.split(candidates, max(1, 250_000 // shading.shape[1])):
        mu, nu, log_lam = batch.mT[..., None]
        lam = log_lam.exp()
        square = (lam * x - mu * z).square() + (lam * y - nu * z).square() + z * z
        log = square.clamp_min(torch.finfo(shading.dtype).tiny).log() / 2
        position = (log - log.mean(dim=1, keepdim=True)).clamp(-_REACH, _REACH) + _REACH
        position = position * bins_per_unit
        below = position.long()
        t = position - below
        index = labels * bins + below
        histogram = shading.new_zeros(len(batch), (int(labels.max()) + 1) * bins)
        u, double = 1 - t, t * t
        last = double * t / 6
        first, second = u * u * u / 6, 2 / 3 - double + 3 * last
        for shift, fraction in enumerate((first, second, 1 - first - second - last, last)):
            histogram.scatter_add_(1, index + shift, fraction)
        probability = histogram / shading.shape[1]
        entropies.append(-torch.special.xlogy(probability, probability).sum(dim=1))
    return torch.cat(entropies)


def _minimized(b: Shading, labels: Labels) -> Float[Tensor, " 3"]:
    coarse, fine = (slice(None, None, -(-len(labels) // limit)) for limit in (_FEW_PIXELS, 20_000))
    tilts = torch.linspace(-_MAX_TILT, _MAX_TILT, _TILTS).to(b)
    flat, steep = (torch.tensor(value).to(b).log() for value in (_MIN_LAMBDA, _MAX_LAMBDA))
    lambdas = torch.linspace(float(flat), float(steep), _LAMBDAS).to(b)
    grid = torch.cartesian_prod(tilts, tilts, lambdas)
    entropy = albedo_entropy(b[:, coarse], labels[coarse], grid, _FIRST_WIDTH)
    best = grid[entropy.argsort()[:_CANDIDATES]]
    step = torch.stack([tilts[1] - tilts[0], tilts[1] - tilts[0], lambdas[1] - lambdas[0]]) / 2
    width = _FIRST_WIDTH
    while width > _LAST_WIDTH:
        best, entropy = _local_search(b[:, coarse], labels[coarse], best, step, width)
        best = torch.unique(best[entropy.argsort()[: -(-len(best) // 2)]], dim=0)
        step, width = step / 2, width / 1.4142
    final = albedo_entropy(b[:, coarse], labels[coarse], best, _LAST_WIDTH).argmin()
    best = best[final][None]
    # Until a step changes albedo by a tenth of the kernel.
    while float(step.max()) > _LAST_WIDTH / 10:
        best, _ = _local_search(b[:, fine], labels[fine], best, step, _LAST_WIDTH)
        step = step / 2
    return best[0]


def _local_search(
    b: Shading, labels: Labels, best: Candidates, step: Float[Tensor, " 3"], width: float
) -> tuple[Candidates, Float[Tensor, " candidate"]]:
    """Move each candidate to its best neighbour, at most four times, and return the entropies."""
    around = torch.cartesian_prod(*[torch.arange(-1, 2).to(b)] * 3) * step
    best = best.clone()
    least = torch.full_like(best[:, 0], torch.inf)
    moving = torch.arange(len(best), device=b.device)
    for _ in range(4):
        neighbours = (best[moving, None] + around).flatten(0, 1)
        entropy = albedo_entropy(b, labels, neighbours, width).view(-1, len(around))
        least[moving], chosen = entropy.min(dim=1)
        best[moving] += around[chosen]
        moving = moving[(around[chosen] != 0).any(dim=1)]
    return best, least
