"""Where the extra ``test`` takes ``pimper-bench`` from: this folder, or an index.

An index takes no package that refers to a place: build for one with ``PIMPER_INDEX=1``.
"""

import os
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface


class Index(MetadataHookInterface):
    """Leaves the name alone where a package is built for an index."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Change the declared dependencies."""
        if os.environ.get("PIMPER_INDEX"):
            extra = metadata["optional-dependencies"]["test"]
            extra[:] = [one.partition(" @ ")[0] for one in extra]
