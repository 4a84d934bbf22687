r"""Bas-relief resolved by minimum entropy of albedo, within groups of one chromaticity.

A wrong transformation makes the albedo of a region of one paint vary with its normals. The right
one minimizes the entropy of the histogram of albedo. A Lambertian pixel's channels differ by albedo
and by the point light's colour alone: in logarithm :math:`\log J_{vci} = s_{vi} + e_{vc} + a_{ci}`,
with ``e`` the colour of the light of view v and ``a`` that of pixel i.

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
    """Cluster pixels of similar chromaticity, the lights' colours removed.

    The logarithms ``e`` and ``a`` are estimated in turn by weighted least squares, weights the
    square of brightness. The colour with the most neighbours becomes the first cluster, its
    neighbours are removed, and so on; then every pixel is assigned to the nearest cluster within
    the radius.

    Args:
        radiance: Linear, of two channels or more; all pixels of one channel are one cluster.

    Returns:
        Labels of the pixels, the largest group's 0; -1 for pixels in no group, and for those that
        are not bright enough in all channels of some view.
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
    # Each at least halves the residual where point lights overlap.
    for _ in range(20):
        pixel = (weight * (log - point_light[..., None])).sum(dim=0) / total_pixel
        point_light = (weight * (log - pixel)).sum(dim=2) / total_view
    known = bright.any(dim=0)
    colour = pixel[:, known].to(radiance).mT.double().contiguous()
    sample = colour[:: max(1, -(-len(colour) // 2000))]  # all are then assigned
    # In logarithm of colour: a few times its noise, less than half the distance of paints.
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
    labels = torch.full_like(known, -1, dtype=torch.int64)
    if leaders:
        distance, nearest = torch.cdist(colour, torch.stack(leaders)).min(dim=1)
        labels[known] = torch.where(distance < radius, nearest, -1)
    return labels


# Range and size of the grid of lambda and of tilts. In the standard form a ball cut at 75 degrees
# has lambda 0.9 and a surface with slopes of 0.15 has 0.15; mean slopes are rarely above one.
_MIN_LAMBDA, _MAX_LAMBDA, _LAMBDAS = 0.125, 4.0, 23
_MAX_TILT, _TILTS = 1.0, 17

# Widths of the kernel in logarithm of albedo. A wider first one smooths the right minimum away
# where albedos are close, a narrower one needs a finer grid; the last is the noise of shading.
_FIRST_WIDTH, _LAST_WIDTH = 0.03, 0.015
# Half the range of the histogram, in logarithm of albedo: a choice, a factor of 20.
_REACH = 3.0
# Grid points that are refined, halved with every kernel, and pixels used meanwhile: choices.
_CANDIDATES, _FEW_PIXELS = 200, 1000


def resolve_by_albedo_entropy(shading: Shading, groups: Labels | None = None) -> BasRelief:
    r"""Find the bas-relief transformation of minimum albedo entropy; constant to autograd.

    Minimizes the entropy of :math:`\log \lVert G b \rVert`, smoothed by a kernel: first on a grid
    in the standard form of the surface (:func:`.standard_relief`), then, from its best points, by a
    local search whose steps are halved as the kernel narrows.

    Args:
        shading: Albedo times normal, right up to a bas-relief transformation; vectors that are
            zero or not finite are left out.
        groups: Pixels of equal chromaticity (:func:`.chromaticity_groups`), within which the
            entropy of brightness is minimized; by default all are one group.

    Fails where the surface has as many albedos as pixels, or few different normals. Convex stays
    convex.

    Source: Alldrin, Mallick & Kriegman, CVPR 2007. The logarithm, which replaces their fixed
    scale, the standard form and the use of colour are ours.
    """
    with torch.no_grad():
        usable = shading.isfinite().all(dim=0) & (shading != 0).any(dim=0)
        count = int(usable.sum())
        if count < 50:
            raise InputError(
                f"{count} of {shading.shape[1]} shading vectors are finite and not zero; needed: "
                "50 at least for a histogram of albedo. Enlarge the mask."
            )
        start = standard_relief(shading[:, usable])
        if not bool(start.lam.isfinite()):
            raise InputError(
                f"the normals of {count} pixels are parallel; needed: a curved surface, as a plane "
                "does not determine a bas-relief transformation. Enlarge the mask."
            )
        b = start.on_shading(shading[:, usable].double())
        labels = torch.zeros_like(b[0]).long() if groups is None else groups[usable]
        labels = torch.unique(labels, return_inverse=True)[1]
        found = _minimized(b, labels)
        whole = BasRelief(mu=found[0], nu=found[1], lam=found[2].exp()).after(start)
        return whole.to(shading.dtype)


def albedo_entropy(
    shading: Shading, labels: Labels, candidates: Candidates, width: float
) -> Float[Tensor, " candidate"]:
    """Return the entropy of log-albedo within groups after each transformation.

    Args:
        candidates: mu, nu and the logarithm of lambda.
        width: Standard deviation of the kernel, in logarithm of albedo.
    """
    # A cubic B-spline is a Gaussian of width 1 / sqrt(3) bins, and its samples' entropy hardly
    # depends on where in a bin they are taken.
    bins_per_unit = 1 / (3**0.5 * width)
    bins = int(2 * _REACH * bins_per_unit) + 4
    x, y, z = shading
    found = []
    # Products at a time fit a cache.
    for some in torch.split(candidates, max(1, 250_000 // shading.shape[1])):
        mu, nu, log_lam = some.mT[..., None]
        lam = log_lam.exp()
        square = (lam * x - mu * z).square() + (lam * y - nu * z).square() + z * z
        log = square.clamp_min(torch.finfo(shading.dtype).tiny).log() / 2
        position = (log - log.mean(dim=1, keepdim=True)).clamp(-_REACH, _REACH) + _REACH
        position = position * bins_per_unit
        below = position.long()
        t = position - below
        index = labels * bins + below
        histogram = shading.new_zeros(len(some), (int(labels.max()) + 1) * bins)
        u, double = 1 - t, t * t
        last = double * t / 6
        first, second = u * u * u / 6, 2 / 3 - double + 3 * last
        for shift, fraction in enumerate((first, second, 1 - first - second - last, last)):
            histogram.scatter_add_(1, index + shift, fraction)
        probability = histogram / shading.shape[1]
        found.append(-torch.special.xlogy(probability, probability).sum(dim=1))
    return torch.cat(found)


def _minimized(b: Shading, labels: Labels) -> Float[Tensor, " 3"]:
    few, many = (slice(None, None, -(-len(labels) // limit)) for limit in (_FEW_PIXELS, 20_000))
    tilts = torch.linspace(-_MAX_TILT, _MAX_TILT, _TILTS).to(b)
    flat, steep = (torch.tensor(value).to(b).log() for value in (_MIN_LAMBDA, _MAX_LAMBDA))
    lambdas = torch.linspace(float(flat), float(steep), _LAMBDAS).to(b)
    grid = torch.cartesian_prod(tilts, tilts, lambdas)
    best = grid[albedo_entropy(b[:, few], labels[few], grid, _FIRST_WIDTH).argsort()[:_CANDIDATES]]
    step = torch.stack([tilts[1] - tilts[0], tilts[1] - tilts[0], lambdas[1] - lambdas[0]]) / 2
    narrow = _FIRST_WIDTH
    while narrow > _LAST_WIDTH:
        best, entropy = _local_search(b[:, few], labels[few], best, step, narrow)
        best = torch.unique(best[entropy.argsort()[: -(-len(best) // 2)]], dim=0)
        step, narrow = step / 2, narrow / 1.4142
    final = albedo_entropy(b[:, few], labels[few], best, _LAST_WIDTH).argmin()
    best = best[final][None]
    # Down to a step that changes albedo by a tenth of the kernel.
    while float(step.max()) > _LAST_WIDTH / 10:
        best, _ = _local_search(b[:, many], labels[many], best, step, _LAST_WIDTH)
        step = step / 2
    return best[0]


def _local_search(
    b: Shading, labels: Labels, best: Candidates, step: Float[Tensor, " 3"], width: float
) -> tuple[Candidates, Float[Tensor, " candidate"]]:
    """Move each candidate to its best neighbour a step away until none is better."""
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
