"""COLMAP's library, loaded so that it harms nothing else."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from pimper_torch.runtime.errors import caution


def loaded() -> Any:  # noqa: ANN401 - pycolmap has no types before it is loaded
    """Load pycolmap, and take SIGTERM back from its log, which would abort with a stack trace.

    Pillow is loaded before it: both carry zlib, and where pycolmap's comes first, Pillow damages
    its memory as soon as it writes a PNG.
    """
    fresh = "pycolmap" not in sys.modules
    import PIL.Image  # noqa: F401 - see above
    import pycolmap

    if fresh and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    _warn_of_import_order()
    return pycolmap


@cache
def _warn_of_import_order() -> None:
    """Warn, once, where a script has loaded pycolmap before Pillow."""
    names = list(sys.modules)  # in the order of loading
    if names.index("pycolmap") < names.index("PIL._imaging"):
        caution(
            "pycolmap was imported before Pillow: both carry zlib, and writing a PNG will end this "
            "process. Put `import PIL.Image` before `import pycolmap`."
        )


@contextmanager
def quiet() -> Iterator[None]:
    """Keep COLMAP's log off stderr; what matters comes back as results or exceptions."""
    pycolmap = loaded()

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
