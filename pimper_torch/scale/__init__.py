"""Metric scale of a result, from known lengths and printed markers."""

import lazy_loader

# Imported lazily, so that the command line reads settings of this subpackage without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
