"""Gradients of solutions, by one more solve with what was prepared for the first."""

from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class Prepared(Protocol):
    """A symmetric matrix, made ready for any number of right-hand sides.

    Attributes:
        rows: Of the entries that make up the matrix; those named twice add up.
        cols: Likewise.
    """

    rows: Int[Tensor, " entry"]
    cols: Int[Tensor, " entry"]

    def solve_values(self, rhs: Float[Tensor, "unknown ..."]) -> Float[Tensor, "unknown ..."]:
        """Solve without a trace for autograd; in the device and dtype of ``rhs``."""


def solve_adjointly(
    prepared: Prepared, values: Float[Tensor, " entry"], rhs: Float[Tensor, "unknown ..."]
) -> Float[Tensor, "unknown ..."]:
    """Solve so that gradients reach ``values`` and ``rhs``, any number of times.

    The gradient with respect to ``values`` treats the entries as free; used through a
    symmetric assembly it is exact.
    """
    solution: Tensor = _Solve.apply(prepared, values, rhs)  # type: ignore[no-untyped-call]
    return solution


class _Solve(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401 - torch gives contexts no usable type
        prepared: Prepared,
        values: Float[Tensor, " entry"],
        rhs: Float[Tensor, "unknown ..."],
    ) -> Float[Tensor, "unknown ..."]:
        solution = prepared.solve_values(rhs.detach())
        ctx.prepared = prepared
        ctx.save_for_backward(values, solution)
        return solution

    @staticmethod
    def backward(
        ctx: Any,  # noqa: ANN401
        upstream: Float[Tensor, "unknown ..."],
    ) -> tuple[None, Float[Tensor, " entry"] | None, Float[Tensor, "unknown ..."]]:
        values, solution = ctx.saved_tensors
        prepared: Prepared = ctx.prepared
        adjoint = solve_adjointly(prepared, values, upstream)
        into_values = None
        if ctx.needs_input_grad[1]:
            products = adjoint[prepared.rows] * solution[prepared.cols]
            into_values = -products.reshape(len(values), -1).sum(dim=1).to(values)
        return None, into_values, adjoint
