"""One viewpoint, many lights: photometric stereo, normal integration, response curves."""

import lazy_loader

# When they are asked for, so that the command line reads settings of this room without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
