import torch
from torch.testing import assert_close

from pimper_torch.stages.photometry.quadratics import apply_packed, congruence, outer, solve_packed


def dense(packed, size):
    rows, columns = torch.triu_indices(size, size)
    matrix = packed.new_zeros(*packed.shape[:-2], packed.shape[-1], size, size)
    matrix[..., rows, columns] = packed.mT
    matrix[..., columns, rows] = packed.mT
    return matrix


def test_packed_and_dense_systems_agree(generator):
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
