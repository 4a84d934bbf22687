"""Shape from shading under changing light: harmonics, the cone, lights, factorization.

The factorization works alone: pose a :class:`Bilinear` problem and hand it to a solver. Other
manifolds and solvers are in :mod:`pimper_torch.single_view.factorization`.
"""

import lazy_loader

# When they are asked for, so that the command line reads settings of this room without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
