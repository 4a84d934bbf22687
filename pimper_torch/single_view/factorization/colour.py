r"""Colour: every channel its own light and albedo, all the same normals.

.. math:: J_{fck} = q_{ck}\, l_{fc}^\top n_k

With the chroma ``q`` known, channels are views of one problem more: the data over the chroma,
weighted by its square, cost what they did. Chroma follows in closed form, in turn.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.photometry.bilinear import Bilinear, Factors, Solver
from pimper_torch.records import Convergence, Record

# A channel with less than this fraction of a sample's brightness has nothing to say of its normal.
_MIN_CHROMA = 0.02

# Turns of tints and chroma before the first factorization; each halves what is left at least.
_TINTING = 8


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ColourFactors(Record):
    """The solution in colour.

    Attributes:
        lights: One a view and channel.
        shading: What all channels share, on the manifold.
        chroma: ``q``, its mean square over the channels 1; albedo is that of the shading times
            chroma.
        weight: What each entry counted in the end.
        convergence: Of the last round.
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
        problem: The same patches in gray, the mean of the channels, with its start; what holds
            its lights holds each channel's, tinted as the channel is brighter or darker.
        radiance: In colour; zero where missing.
        solve: One of the solvers.
        max_iterations: Steps at most, each round.
        tolerance: The solver's.
        iterations: Turns of factors and chroma; more matter where the light's colour changes
            between views, which chroma is then taken for at first.

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
    told = chroma > _MIN_CHROMA
    scale = torch.where(told, chroma, 1)[:, None]
    weight = problem.weight[:, :, None] * torch.where(told, chroma, 0)[:, None] ** 2
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
    """Tell the colours of lights and of samples apart, the gray problem's start given."""
    shade = (problem.lights @ problem.shading)[:, :, None]
    heavy = problem.weight[:, :, None] * shade
    product, square = heavy * radiance, heavy * shade
    tint = torch.ones_like(radiance[..., 0])
    chroma = torch.ones_like(radiance[:, 0])
    for _ in range(_TINTING):
        total = (tint[..., None] ** 2 * square).sum(dim=1)
        chroma = (tint[..., None] * product).sum(dim=1) / torch.where(total > 0, total, 1)
        chroma, _ = _scaled(chroma.clamp_min(0))
        total = (chroma[:, None] ** 2 * square).sum(dim=3)
        tint = (chroma[:, None] * product).sum(dim=3) / torch.where(total > 0, total, 1)
        tint = torch.where(total > 0, tint, 1)
        # Colour is told from brightness, which stays with the lights.
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
    """Bring its mean square to 1, and give the factor taken out."""
    size = chroma.square().mean(dim=1).sqrt()
    some = size > 0
    size = torch.where(some, size, 1)
    even = torch.where(some[:, None], chroma / size[:, None], 1)
    return even, size


def _by_channel(found: Factors, channels: int) -> Float[Tensor, "patch view channel rank"]:
    patches, _, rank = found.lights.shape
    return found.lights.reshape(patches, -1, channels, rank)
