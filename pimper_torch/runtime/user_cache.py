"""Where records are kept that belong to no single result."""

import os
from pathlib import Path


def user_cache() -> Path:
    """Return the folder for caches of this package: ``pimper_torch`` in ``$XDG_CACHE_HOME``.

    Where that is not set, in ``~/.cache``. Source: XDG Base Directory Specification 0.8.
    """
    home = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(home) if Path(home).is_absolute() else Path.home() / ".cache"
    return base / "pimper_torch"
