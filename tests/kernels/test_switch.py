import torch

from pimper_torch.kernels.switch import compiled_for


def test_kernels_are_used_only_without_gradients_and_on_the_cpu():
    values, asked = torch.ones(2), torch.ones(2, requires_grad=True)
    assert compiled_for(values)
    assert not compiled_for(values, asked)
    with torch.no_grad():
        assert compiled_for(values, asked)
    assert not compiled_for(torch.ones(2, device="meta"))
