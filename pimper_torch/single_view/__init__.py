"""One viewpoint, many lights: photometric stereo, normal integration, response curves."""

import lazy_loader

# Imported on first use, so the command line can import this subpackage without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
