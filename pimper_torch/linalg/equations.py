"""Least squares of any sparse equations, such as those that join overlapping rasters."""

from jaxtyping import Float, Int
from torch import Tensor


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
