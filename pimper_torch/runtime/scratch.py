"""Temporary folders of a process and of those that it forks, under a prefix of their own."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PREFIX = f"pimper_{os.urandom(4).hex()}_"


@contextmanager
def scratch() -> Iterator[Path]:
    """Make a temporary folder, which goes when the block ends."""
    with tempfile.TemporaryDirectory(prefix=_PREFIX) as folder:
        yield Path(folder)


def remove_scratch() -> None:
    """Remove the temporary folders that a killed fork of this process left."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_PREFIX}*"):
        shutil.rmtree(folder, ignore_errors=True)
