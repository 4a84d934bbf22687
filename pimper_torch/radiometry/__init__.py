"""Radiance and its encoding in files: responses, saturation, sRGB."""

import lazy_loader

# Names are loaded on access, so that the command line reads the settings here without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
