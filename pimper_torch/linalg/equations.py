"""Least squares of any sparse equations, such as those that join overlapping rasters."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError


def normal_equations(
    unknowns: Int[Tensor, "equation term"],
    coefficients: Float[Tensor, "equation term"],
    targets: Float[Tensor, " equation"],
    weights: Float[Tensor, " equation"],
    size: int,
) -> tuple[
    Int[Tensor, " entry"],
    Int[Tensor, " entry"],
    Float[Tensor, " entry"],
    Float[Tensor, " unknown"],
]:
    r"""Give :math:`J^T W J` and :math:`J^T W t` of equations :math:`\sum_k c_k x_{u_k} = t`.

    Args:
        unknowns: Which unknowns each equation ties together.
        coefficients: Of these. Fill up shorter equations with 0 of any unknown.
        targets: Right-hand side of each equation.
        weights: Of each equation, not negative.
        size: Number of unknowns.

    Returns:
        Rows, columns and values of the matrix, entries named twice add up, and the
        right-hand side. Entries of several sets of equations are joined by concatenating
        them, right-hand sides by adding. Differentiable in all that is not an index.
    """
    scaled = weights[:, None] * coefficients
    blocks = scaled[:, :, None] * coefficients[:, None, :]
    rows = unknowns[:, :, None].expand_as(blocks)
    cols = unknowns[:, None, :].expand_as(blocks)
    rhs = scaled.new_zeros(size).index_add(
        0, unknowns.flatten(), (scaled * targets[:, None]).flatten()
    )
    return rows.flatten(), cols.flatten(), blocks.flatten(), rhs


def raster_equations(
    right: Float[Tensor, "height steps_right"], down: Float[Tensor, "steps_down width"]
) -> tuple[Int[Tensor, "equation 2"], Float[Tensor, "equation 2"], Float[Tensor, " equation"]]:
    """Write the steps of a raster as equations: unknowns, coefficients and targets.

    Unknowns are the pixels, row by row; steps to the right come first. A system of one raster
    alone is solved quicker by :class:`~pimper_torch.linalg.rasters.RasterSystem`.
    """
    height, width = right.shape[0], down.shape[1]
    pixel = torch.arange(height * width, device=right.device).reshape(height, width)
    one = torch.cat([pixel[:, :-1].flatten(), pixel[:-1].flatten()])
    other = torch.cat([pixel[:, 1:].flatten(), pixel[1:].flatten()])
    targets = torch.cat([right.flatten(), down.flatten()])
    signs = targets.new_tensor([-1.0, 1.0]).expand(len(one), 2)
    return torch.stack([one, other], dim=1), signs, targets


def bilinear_terms(
    places: Float[Tensor, "sample 2"], height: int, width: int
) -> tuple[Int[Tensor, "sample 4"], Float[Tensor, "sample 4"]]:
    """Write heights between the pixels of a raster as sums over four pixels.

    The terms of one raster beside those of another, negated and counted on, make equations
    that hold overlapping rasters together.

    Args:
        places: ``(u, v)`` right and down in pixels, the first centre at (0.5, 0.5).
        height: Of the raster, at least 2.
        width: Likewise.

    Returns:
        Which pixels, and their shares; differentiable in the places.

    Raises:
        InputError: Places beyond the centres of the outermost pixels.
    """
    centred = places - 0.5
    last = centred.new_tensor([width - 1, height - 1])
    outside = ((centred < 0) | (centred > last)).any(dim=1) | ~centred.isfinite().all(dim=1)
    if bool(outside.any()):
        first = int(outside.nonzero()[0])
        raise InputError(
            f"{int(outside.sum())} of {len(places)} samples lie outside the centres of a raster "
            f"of {width} x {height} pixels (the first, number {first}, at "
            f"{places[first].tolist()}). Leave them out."
        )
    corner = torch.minimum(centred.detach().floor(), last - 1).clamp_min(0)
    share = centred - corner
    col, row = corner.long().unbind(dim=1)
    first_pixel = row * width + col
    pixels = first_pixel[:, None] + first_pixel.new_tensor([0, 1, width, width + 1])
    u, v = share.unbind(dim=1)
    return pixels, torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], dim=1)
