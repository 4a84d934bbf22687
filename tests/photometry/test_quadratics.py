import torch
from torch.testing import assert_close

from pimper_torch.photometry.quadratics import (
    PackedCholesky,
    apply_packed,
    congruence,
    diagonal,
    outer,
    solve_packed,
    unpacked,
)


def dense(packed, size):
    rows, columns = torch.triu_indices(size, size)
    matrix = packed.new_zeros(*packed.shape[:-2], packed.shape[-1], size, size)
    matrix[..., rows, columns] = packed.mT
    matrix[..., columns, rows] = packed.mT
    return matrix


def test_packed_systems_are_solved_as_dense_ones_are(generator):
    for size in (3, 4):
        rows = torch.randn(2, 5, 9, size, generator=generator, dtype=torch.float64)
        packed = outer(rows.mT).sum(dim=-1).mT  # 2, packed, 5
        matrix = dense(packed, size)
        assert_close(matrix, rows.mT @ rows)
        rhs = torch.randn(2, size, 5, generator=generator, dtype=torch.float64)
        assert_close(solve_packed(packed, rhs), torch.linalg.solve(matrix, rhs.mT).mT)
        assert_close(apply_packed(packed, rhs), (matrix @ rhs.mT[..., None])[..., 0].mT)
        columns = [torch.randn(2, size, 5, generator=generator, dtype=torch.float64) for _ in "12"]
        B = torch.stack(columns, dim=-1).transpose(1, 2)
        assert_close(dense(congruence(packed, columns), 2), B.mT @ matrix @ B)


def test_systems_that_say_nothing_answer_zero(generator):
    assert (solve_packed(torch.zeros(1, 10, 3), torch.zeros(1, 4, 3)) == 0).all()


def test_solving_is_differentiable(generator):
    rows = torch.randn(1, 2, 9, 4, generator=generator, dtype=torch.float64)
    packed = outer(rows.mT).sum(dim=-1).mT.requires_grad_()
    rhs = torch.randn(1, 4, 2, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(solve_packed, (packed, rhs))


def test_whitened_vectors_have_the_inner_products_of_the_inverse(generator):
    rows = torch.randn(1, 5, 9, 4, generator=generator, dtype=torch.float64)
    packed = outer(rows.mT).sum(dim=-1).mT
    one, two = torch.randn(2, 1, 4, 5, generator=generator, dtype=torch.float64)
    factor = PackedCholesky(packed, 4)
    white = [torch.stack(factor.whiten(each.unbind(dim=-2)), dim=-2) for each in (one, two)]
    expected = torch.einsum("bik,bkij,bjk->bk", one, torch.linalg.inv(dense(packed, 4)), two)
    assert_close((white[0] * white[1]).sum(dim=-2), expected)


def test_unpacked_matrices_are_the_dense_ones_and_the_diagonal_is_theirs(generator):
    packed = torch.randn(2, 10, 5, generator=generator, dtype=torch.float64)
    assert_close(unpacked(packed, 4), dense(packed, 4))
    assert_close(
        packed[:, diagonal(4)].mT, dense(packed, 4).diagonal(dim1=-2, dim2=-1), rtol=0, atol=0
    )
