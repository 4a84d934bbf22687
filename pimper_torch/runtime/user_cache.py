"""Folder for cached data that is shared by all results."""

import os
from pathlib import Path


def user_cache() -> Path:
    """Return the cache folder: ``pimper_torch`` in ``$XDG_CACHE_HOME``, by default ``~/.cache``.

    Source: XDG Base Directory Specification 0.8.
    """
    home = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(home) if Path(home).is_absolute() else Path.home() / ".cache"
    return base / "pimper_torch"
