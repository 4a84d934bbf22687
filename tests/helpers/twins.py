"""Choice between compiled kernels and their torch equivalents."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Literal
from unittest.mock import patch

_MODULES = (
    "patches.warp",
    "photometry.variable_projection",
    "photometry.factor_gradients",
    "sweep.costs",
    "fusion.estimate",
)


@contextmanager
def using(kernels: Literal["numba", "torch"]) -> Iterator[None]:
    """Choose compiled kernels or torch inside the ``with`` block."""
    with ExitStack() as stack:
        for module in _MODULES if kernels == "torch" else ():
            stack.enter_context(
                patch(f"pimper_torch.stages.{module}.compiled_for", lambda *_: False)
            )
        yield
