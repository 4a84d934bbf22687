"""Names of files that every library can be told."""

import sys
from os import fspath
from pathlib import Path

from pimper_torch.errors import PimperError


def require_name(name: Path | str, error: type[PimperError]) -> None:
    """Refuse, before any work, a name that libraries and files of text cannot hold.

    Args:
        error: What is raised where it is not UTF-8.
    """
    text = fspath(name)
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as cause:
        shown = text.encode("utf-8", "backslashreplace").decode()
        encoding = sys.getfilesystemencoding()
        reason = f" This system takes names for {encoding}: set LC_ALL=C.UTF-8."
        raise error(
            f"{shown}: the name is not UTF-8; needed: one that is. Rename it."
            f"{'' if encoding.lower() == 'utf-8' else reason}"
        ) from cause
