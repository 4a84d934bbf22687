r"""Factorization in colour: each channel has its own light and albedo, all share the normals.

.. math:: J_{fck} = q_{ck}\, l_{fc}^\top n_k

With the chroma ``q`` fixed, channels are further views of one problem: the data divided by the
chroma, weighted by its square. Chroma is updated in closed form, alternately.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.records import Convergence, Record

# Channels with less than this fraction of a sample's brightness are ignored: a choice.
_MIN_CHROMA = 0.02

# Alternations of tints and chroma before the first factorization: a choice; each at least halves
# the residual.
_TINT_ITERATIONS = 8


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ColourFactors(Record):
    """The solution in colour.

    Attributes:
        lights: Of each view and channel.
        shading: Shared by all channels, on the manifold.
        chroma: ``q``, its mean square over the channels 1; albedo is that of the shading times
            chroma.
        weight: Final weight of each entry.
        convergence: Of the last iteration.
    """

    lights: Float[Tensor, "patch view channel rank"]
    shading: Float[Tensor, "patch rank sample"]
    chroma: Float[Tensor, "patch channel sample"]
    weight: Float[Tensor, "patch view channel sample"]
    convergence: Convergence


def solve_in_colour(
    problem: Bilinear,
    radiance: Float[Tensor, "patch view channel sample"],
    solve: Solver,
    max_iterations: int,
    tolerance: float,
    iterations: int = 3,
) -> ColourFactors:
    """Factorize patches channel by channel with common normals.

    Args:
        problem: The same patches in gray, the mean of the channels, with initial values; the
            prior of its lights, times the channel's tint, is that of each channel's.
        radiance: In colour; zero where missing.
        max_iterations: Steps at most in each iteration.
        iterations: Alternations of factors and chroma; more are needed where the light's colour
            changes between views.

    Constant to autograd.
    """
    with torch.no_grad():
        channels = radiance.shape[2]
        tint, chroma = _tints(problem, radiance)
        found = None
        for _ in range(iterations):
            split = split_colours(problem, radiance, chroma)
            split = split.replace(
                lights=split.lights * tint.flatten(1, 2)[..., None],
                anchor=split.anchor * tint.flatten(1, 2)[..., None],
            )
            if found is not None:
                split = split.replace(lights=found.lights, shading=found.shading)
            found = solve(split, max_iterations, tolerance)
            problem = problem.replace(shading=found.shading)
            chroma, size = _scaled(_chroma(problem, radiance, _by_channel(found, channels)))
            found = found.replace(shading=found.shading * size[:, None])
            problem = problem.replace(shading=found.shading)
        assert found is not None
        weight = found.weight.reshape(radiance.shape)
        return ColourFactors(
            lights=_by_channel(found, channels),
            shading=found.shading,
            chroma=chroma,
            weight=weight,
            convergence=found.convergence,
        )


def split_colours(
    problem: Bilinear,
    radiance: Float[Tensor, "patch view channel sample"],
    chroma: Float[Tensor, "patch channel sample"],
) -> Bilinear:
    """Make every channel of a view a view of its own."""
    channels = radiance.shape[2]
    bright = chroma > _MIN_CHROMA
    scale = torch.where(bright, chroma, 1)[:, None]
    weight = problem.weight[:, :, None] * torch.where(bright, chroma, 0)[:, None] ** 2
    return problem.replace(
        radiance=(radiance / scale).flatten(1, 2),
        weight=weight.flatten(1, 2),
        lights=problem.lights.repeat_interleave(channels, dim=1),
        anchor=problem.anchor.repeat_interleave(channels, dim=1),
        regularization=problem.regularization.repeat_interleave(channels, dim=1),
        prior=None if problem.prior is None else channels * problem.prior,
    )


def _tints(
    problem: Bilinear, radiance: Float[Tensor, "patch view channel sample"]
) -> tuple[Float[Tensor, "patch view channel"], Float[Tensor, "patch channel sample"]]:
    """Separate the colours of lights and samples, from the gray problem's initial values."""
    shade = (problem.lights @ problem.shading)[:, :, None]
    heavy = problem.weight[:, :, None] * shade
    product, square = heavy * radiance, heavy * shade
    tint = torch.ones_like(radiance[..., 0])
    chroma = torch.ones_like(radiance[:, 0])
    for _ in range(_TINT_ITERATIONS):
        total = (tint[..., None] ** 2 * square).sum(dim=1)
        chroma = (tint[..., None] * product).sum(dim=1) / torch.where(total > 0, total, 1)
        chroma, _ = _scaled(chroma.clamp_min(0))
        total = (chroma[:, None] ** 2 * square).sum(dim=3)
        tint = (chroma[:, None] * product).sum(dim=3) / torch.where(total > 0, total, 1)
        tint = torch.where(total > 0, tint, 1)
        # Tints have mean 1: brightness stays with the lights.
        mean = tint.mean(dim=2, keepdim=True)
        tint = torch.where(mean > 0, tint / torch.where(mean > 0, mean, 1), 1)
    return tint, chroma


def _chroma(
    problem: Bilinear,
    radiance: Float[Tensor, "patch view channel sample"],
    lights: Float[Tensor, "patch view channel rank"],
) -> Float[Tensor, "patch channel sample"]:
    """Fit the chroma to each channel, lights and shading given; not negative."""
    total = torch.zeros_like(radiance[:, 0])
    square = torch.zeros_like(total)
    for channel in range(radiance.shape[2]):
        shade = lights[:, :, channel] @ problem.shading
        heavy = problem.weight * shade
        total[:, channel] = (heavy * radiance[:, :, channel]).sum(dim=1)
        square[:, channel] = (heavy * shade).sum(dim=1)
    return (total / torch.where(square > 0, square, 1)).clamp_min(0)


def _scaled(
    chroma: Float[Tensor, "patch channel sample"],
) -> tuple[Float[Tensor, "patch channel sample"], Float[Tensor, "patch sample"]]:
    """Normalize the mean square over the channels to 1; give the factors, too."""
    size = chroma.square().mean(dim=1).sqrt()
    some = size > 0
    size = torch.where(some, size, 1)
    even = torch.where(some[:, None], chroma / size[:, None], 1)
    return even, size


def _by_channel(found: Factors, channels: int) -> Float[Tensor, "patch view channel rank"]:
    patches, _, rank = found.lights.shape
    return found.lights.reshape(patches, -1, channels, rank)
