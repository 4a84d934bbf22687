"""Radiance and the encoded values that files hold: responses, saturation, sRGB."""

import lazy_loader

# When they are asked for, so that the command line reads settings of this room without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
