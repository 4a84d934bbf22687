import torch
from derivatives import check_derivatives


def test_a_part_that_autograd_does_not_see_shows():
    check = check_derivatives(
        lambda x: {"square": x["x"] ** 2 + x["x"].detach()},
        {"x": torch.linspace(1, 2, 5, dtype=torch.float64)},
        torch.Generator().manual_seed(0),
    )["x", "square"]
    assert 0.5 < check.median < 0.9  # 2 x in place of 2 x + 1
