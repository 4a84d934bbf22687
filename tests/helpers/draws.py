"""Random numbers in double precision."""

import torch


def normal(generator, *shape):
    """Draw from the standard normal distribution."""
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def uniform(generator, *shape):
    """Draw from 0 to 1."""
    return torch.rand(*shape, generator=generator, dtype=torch.float64)
