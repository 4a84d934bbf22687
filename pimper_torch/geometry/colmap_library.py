"""Loading of pycolmap without side effects on signals, zlib and logs."""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from pimper_torch.runtime.errors import caution


def loaded() -> Any:  # noqa: ANN401 - pycolmap has no types before it is loaded
    """Return pycolmap, without the SIGTERM handler of its log, which aborts with a stack trace.

    Pillow is loaded first: both contain zlib, and with that of pycolmap loaded first, Pillow
    corrupts memory as soon as it writes a PNG.
    """
    first_import = "pycolmap" not in sys.modules
    import PIL.Image  # noqa: F401 - see above
    import pycolmap

    if first_import and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM) or signal.SIG_DFL)
    _warn_of_import_order()
    return pycolmap


@cache
def _warn_of_import_order() -> None:
    """Warn, once, if a script has loaded pycolmap before Pillow."""
    names = list(sys.modules)  # in the order of loading
    if names.index("pycolmap") < names.index("PIL._imaging"):
        caution(
            "pycolmap was imported before Pillow: both contain zlib, and writing a PNG will crash "
            "this process. Put `import PIL.Image` before `import pycolmap`."
        )


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress COLMAP's log on stderr; its results and exceptions remain."""
    pycolmap = loaded()

    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
