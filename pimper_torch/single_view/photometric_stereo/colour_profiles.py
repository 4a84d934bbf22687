r"""Bas-relief resolved by pixels of one albedo, and by pixels of one normal.

Pixels of one paint, found by their chromaticity, have one albedo whatever their
normal: :math:`b_i^\top M b_i = b_j^\top M b_j`, linear in the metric ``M``. Pixels of one normal,
found by brightness that is proportional across the photographs, do not constrain ``M``, but their
ratio is that of their paints' albedos; it joins groups of different paint.

Source: Shi, Matsushita, Wei, Xu & Tan, Self-calibrating photometric stereo, CVPR 2010.
"""

import warnings

import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from pimper_torch.errors import InputError, PimperWarning
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.chromaticity import chromaticity_groups
from pimper_torch.single_view.photometric_stereo.factors import (
    cast,
    require_matching,
    require_standard,
    usable_pixels,
)
from pimper_torch.single_view.photometric_stereo.relief_metric import metric_row, relief_of_metric

# Pixels of a group that are compared with other groups' normals: a choice.
_COMPARED = 1000
# Minimum number of pairs of pixels with one normal that join two groups: a choice.
_LINKING = 20
_JOININGS = 3
# Deviation of albedo within groups above which a warning comes: a choice, well above shading noise.
_UNEVEN = 0.1
_STEPS = 50


def resolve_by_colour_profiles(
    images: Float[Tensor, "view channel height width"],
    mask: Bool[Tensor, "height width"],
    shading: Float[Tensor, "3 pixel"],
    lights: Float[Tensor, "view 3"],
    *,
    colour_radius: float = 0.05,
    same_normal: float = 0.02,
) -> BasRelief:
    r"""Find the bas-relief transformation under which pixels of one paint have one albedo.

    Groups come from :func:`.chromaticity_groups`, and are joined where enough pixels of two have
    the same normal. The initial metric minimizes the variance of squared albedo within groups,
    relative to its mean: an eigenvalue problem. From there, and from the standard form,
    Gauss-Newton steps minimize Cauchy's loss of

    .. math:: \log \lVert G b_i \rVert - \log \rho_{k(i)}

    over the transformation and the groups' albedos; the better minimum is taken.

    Args:
        images: Linear radiance, of two channels or more. Point lights may have different colours.
        shading: Albedo times normal of the pixels inside the mask, right up to a bas-relief
            transformation. Vectors that are zero or not finite are left out.
        lights: Of the same factorization; its views must be those of the images.
        colour_radius: Within which pixels have one paint, in logarithm of colour.
        same_normal: Distance of brightness profiles of norm one within which normals are the
            same; about their angle.

    Returns:
        The transformation with lambda above zero: convex stays convex. Constant to autograd.

    Fails where paints of one colour differ in brightness, as greys do, which it warns of, or
    where each paint covers normals on a cone: those have one albedo under several
    transformations.

    Raises:
        InputError: Grey images, sizes that do not fit, or no group that holds 10 pixels.

    Source: Shi, Matsushita, Wei, Xu & Tan, CVPR 2010, for the two cues. How groups are found
    and joined, the eigenvalue problem and the robust loss are ours.
    """
    require_matching(images, mask, shading, lights)
    with torch.no_grad():
        groups = chromaticity_groups(images, mask, radius=colour_radius)
        groups = torch.where(usable_pixels(shading), groups, -1)
        profiles = images[:, :, mask].double().sum(dim=1)
        kept = groups >= 0
        if int(kept.sum()) < 10:
            raise InputError(
                f"{int(kept.sum())} pixels with shading are in groups of one colour; needed: 10 "
                "at least. Raise `colour_radius`, or use a method that needs no paints."
            )
        b, labels = shading[:, kept].double(), groups[kept]
        relief = require_standard(b)
        pairs = same_normals(profiles[:, kept], labels, same_normal)
        # Normals of a pair are only similar: once a transformation is known, the ratio of its
        # albedos is more accurate than that of brightness.
        log_albedo = profiles[:, kept].norm(dim=0).clamp_min(1e-30).log()
        for _ in range(_JOININGS):
            joined, log_ratio = join_groups(pairs, log_albedo, labels)
            found = _resolved(relief.on_shading(b / log_ratio.exp()), joined).after(relief)
            log_albedo = _log_albedo(b, found)
        off = _residual(b / log_ratio.exp(), joined, found)
        left = float(robust_deviation(off, torch.ones_like(joined, dtype=torch.bool)))
        if left > _UNEVEN:
            warnings.warn(
                f"within groups of one colour albedo still varies by {100 * left:.0f} %; the "
                "transformation is unreliable. For paints of one colour but different brightness "
                "use `resolve_by_albedo_entropy`.",
                PimperWarning,
                stacklevel=2,
            )
        return cast(found, shading)


def same_normals(
    profiles: Float[Tensor, "view pixel"], groups: Int[Tensor, " pixel"], closeness: float
) -> Int[Tensor, "2 pair"]:
    """Pair pixels of different groups whose brightness is proportional across the views.

    Args:
        profiles: Brightness of each pixel in all views.
        groups: Labels from 0.
        closeness: Distance of profiles of norm one.

    Returns:
        Pixels; the first is of the group with the higher label.
    """
    size = profiles.norm(dim=0)
    unit = (profiles / size.clamp_min(torch.finfo(size.dtype).tiny)).mT.cpu()
    members = []
    for label in range(int(groups.max()) + 1):
        inside = ((groups == label) & (size > 0)).nonzero()[:, 0].cpu()
        members.append(inside[:: max(1, -(-len(inside) // _COMPARED))])
    pairs = [torch.zeros(2, 0, dtype=torch.int64)]
    for one, own in enumerate(members):
        if len(own) == 0:
            continue
        tree = cKDTree(unit[own].numpy())
        for others in members[:one]:
            if len(others) == 0:
                continue
            distance, index = tree.query(unit[others].numpy(), distance_upper_bound=closeness)
            same = torch.from_numpy(distance).isfinite()
            pairs.append(torch.stack([own[torch.from_numpy(index)[same]], others[same]]))
    return torch.cat(pairs, dim=1).to(groups)


def join_groups(
    pairs: Int[Tensor, "2 pair"],
    log_albedo: Float[Tensor, " pixel"],
    groups: Int[Tensor, " pixel"],
) -> tuple[Int[Tensor, " pixel"], Float[Tensor, " pixel"]]:
    """Join the groups whose albedos can be compared because they share normals.

    Args:
        pairs: Pixels of different groups with one normal.
        log_albedo: Logarithm of albedo, up to a term that is the same for the pixels of a pair.
        groups: Labels from 0.

    Returns:
        Labels of joined groups, from 0, and the logarithm of each pixel's albedo over that of
        its joined group.
    """
    count = int(groups.max()) + 1
    one, other = groups[pairs]
    ratio = log_albedo[pairs[0]] - log_albedo[pairs[1]]
    links = []
    for link in torch.unique(one * count + other).tolist():
        among = one * count + other == link
        if int(among.sum()) >= _LINKING:
            links.append(
                (link // count, link % count, float(ratio[among].median()), float(among.sum()))
            )
    names, offsets = _offsets(links, count)
    labels = torch.unique(names.to(groups)[groups], return_inverse=True)[1]
    return labels, offsets.to(log_albedo)[groups]


def _offsets(
    links: list[tuple[int, int, float, float]], count: int
) -> tuple[Int[Tensor, " group"], Float[Tensor, " group"]]:
    """Label connected components of groups; give each group's least-squares log-albedo."""
    normal = 1e-9 * torch.eye(count, dtype=torch.float64)
    rhs = torch.zeros(count, dtype=torch.float64)
    for one, other, ratio, pairs in links:
        normal[one, one] += pairs
        normal[other, other] += pairs
        normal[one, other] -= pairs
        normal[other, one] -= pairs
        rhs[one] += pairs * ratio
        rhs[other] -= pairs * ratio
    pairs_from = [link[0] for link in links], [link[1] for link in links]
    graph = coo_array(([1.0] * len(links), pairs_from), shape=(count, count))
    _, names = connected_components(graph, directed=False)
    return torch.from_numpy(names).long(), torch.linalg.solve(normal, rhs)


def _resolved(b: Float[Tensor, "3 pixel"], labels: Int[Tensor, " pixel"]) -> BasRelief:
    """Return the better of the minima from the linear solution and from the identity."""
    one, none = torch.ones_like(b[0, 0]), torch.zeros_like(b[0, 0])
    starts = [BasRelief(mu=none, nu=none, lam=one)]
    linear = _linear(b, labels)
    if bool(linear.lam.isfinite()):
        starts.append(linear)
    minima = [_descended(b, labels, start) for start in starts]
    # Compared by one scale, the smaller of the two.
    spreads = [float(_residual(b, labels, found).abs().median()) for found in minima]
    scale = b.new_tensor(max(CAUCHY_TUNING * 1.4826 * min(spreads), 1e-9))
    losses = [
        float((_residual(b, labels, found) / scale).square().log1p().sum()) for found in minima
    ]
    return minima[losses.index(min(losses))]


def _linear(b: Float[Tensor, "3 pixel"], labels: Int[Tensor, " pixel"]) -> BasRelief:
    """Minimize the variance of squared albedo within groups over its squared mean."""
    rows = metric_row(b)
    size = torch.bincount(labels).to(b)
    level = torch.zeros_like(size).index_add(0, labels, (b * b).sum(dim=0)) / size
    rows = rows / level[labels][:, None]
    mean = b.new_zeros(len(size), 4).index_add(0, labels, rows) / size[:, None]
    within = rows - mean[labels]
    variance = within.mT @ within
    square = (size[:, None] * mean).mT @ mean + variance
    # Of unit square (mean and variance together), the metric of least variance.
    root = torch.linalg.cholesky(square + 1e-12 * square.trace() * torch.eye(4).to(b))
    left = torch.linalg.solve_triangular(root, variance, upper=False)
    whitened = torch.linalg.solve_triangular(root, left.mT, upper=False)
    leading = torch.linalg.eigh((whitened + whitened.mT) / 2).eigenvectors[:, :1]
    return relief_of_metric(torch.linalg.solve_triangular(root.mT, leading, upper=True)[:, 0])


def _descended(
    b: Float[Tensor, "3 pixel"], labels: Int[Tensor, " pixel"], start: BasRelief
) -> BasRelief:
    """Minimize Cauchy's loss by Levenberg-Marquardt, its scale re-estimated at every step."""
    relief, damping = start, 1e-3
    everywhere = torch.ones_like(labels, dtype=torch.bool)
    for _ in range(_STEPS):
        residual = _residual(b, labels, relief)
        scale = CAUCHY_TUNING * robust_deviation(residual, everywhere)
        weight = cauchy_weights(residual, scale)
        slope = _slope(b, labels, relief, weight)
        normal = (weight[:, None] * slope).mT @ slope
        rhs = slope.mT @ (weight * residual)
        ridge = damping * normal.diagonal() + 1e-12 * normal.trace() + 1e-30
        step = torch.linalg.solve(normal + torch.diag(ridge), rhs)
        tried = BasRelief(
            mu=relief.mu - step[0],
            nu=relief.nu - step[1],
            lam=relief.lam * (-step[2]).clamp(-1, 1).exp(),
        )
        after = _residual(b, labels, tried)
        if bool(_loss(after, scale) < _loss(residual, scale)):
            relief, damping = tried, max(damping / 5, 1e-9)
            if float(step.norm()) < 1e-10:
                break
        else:
            damping *= 10
            if damping > 1e9:
                break
    return relief


def _loss(residual: Float[Tensor, " pixel"], scale: Float[Tensor, ""]) -> Float[Tensor, ""]:
    return (residual / scale.clamp_min(1e-12)).square().log1p().sum()


def _log_albedo(b: Float[Tensor, "3 pixel"], relief: BasRelief) -> Float[Tensor, " pixel"]:
    square = relief.on_shading(b).square().sum(dim=0)
    return square.clamp_min(torch.finfo(b.dtype).tiny).log() / 2


def _residual(
    b: Float[Tensor, "3 pixel"], labels: Int[Tensor, " pixel"], relief: BasRelief
) -> Float[Tensor, " pixel"]:
    """Return log-albedo less the group's median."""
    log = _log_albedo(b, relief)
    median = torch.stack([log[labels == label].median() for label in range(int(labels.max()) + 1)])
    return log - median[labels]


def _slope(
    b: Float[Tensor, "3 pixel"],
    labels: Int[Tensor, " pixel"],
    relief: BasRelief,
    weight: Float[Tensor, " pixel"],
) -> Float[Tensor, "pixel 3"]:
    """Return the residual's derivative by mu, nu and log lambda, group means by weight removed."""
    x, y, z = relief.on_shading(b)
    square = (x * x + y * y + z * z).clamp_min(torch.finfo(b.dtype).tiny)
    lam = relief.lam
    slope = torch.stack([-x * b[2], -y * b[2], lam * (x * b[0] + y * b[1])], dim=1)
    slope = slope / square[:, None]
    total = torch.zeros_like(weight[: int(labels.max()) + 1]).index_add(0, labels, weight)
    mean = slope.new_zeros(len(total), 3).index_add(0, labels, weight[:, None] * slope)
    return slope - (mean / total[:, None])[labels]
