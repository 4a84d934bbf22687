"""Temporary folders of a process and of its forks, with a common random prefix."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PREFIX = f"pimper_{os.urandom(4).hex()}_"


@contextmanager
def scratch() -> Iterator[Path]:
    """Create a temporary folder, deleted at the end of the block."""
    with tempfile.TemporaryDirectory(prefix=_PREFIX) as folder:
        yield Path(folder)


def remove_scratch() -> None:
    """Delete the temporary folders of a killed fork of this process."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        shutil.rmtree(folder, ignore_errors=True)
