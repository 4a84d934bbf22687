"""Result folders: written, read, and converted for other programs."""

import lazy_loader

# Imported lazily: the command line reads names of folders and formats here without torch.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
