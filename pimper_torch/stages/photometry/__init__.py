"""Shape from shading under changing light: harmonics, the cone, lights, factorization.

The factorization can be used alone: build a :class:`Bilinear` problem and call a solver with it.
Other manifolds and solvers are in :mod:`pimper_torch.single_view.factorization`.
"""

import lazy_loader

# Imported lazily: the command line reads the settings of this folder without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
