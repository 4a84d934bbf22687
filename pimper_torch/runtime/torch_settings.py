"""Settings of torch that the caller made, which have no effect inside of the package."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import wraps
from threading import Lock
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")

_former: list[torch.dtype] = []  # default dtype at the start of each running block, in any thread
_lock = Lock()


@contextmanager
def own_settings() -> Iterator[None]:
    """Use default dtype float32, default device CPU and no autocast in the ``with`` block.

    The default dtype is one setting of all threads: others see float32, too, until the last of
    simultaneous blocks ends. The rest is the thread's, and is not touched where it is the same.
    """
    with _lock:
        _former.append(torch.get_default_dtype())
        torch.set_default_dtype(torch.float32)
    try:
        with ExitStack() as stack:
            if torch.get_default_device().type != "cpu":
                stack.enter_context(torch.device("cpu"))
            for device in ("cpu", "cuda", "mps", "xpu"):
                if torch.is_autocast_enabled(device):
                    stack.enter_context(torch.autocast(device, enabled=False))
            yield
    finally:
        with _lock:
            if (former := _former.pop()) != torch.float32:
                torch.set_default_dtype(former)


def isolated(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function run with :func:`own_settings`, and uncompiled within ``torch.compile``."""
    inside = own_settings()(function)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if "torch._dynamo" not in sys.modules:  # its import takes 3 seconds and 70 MB
            return inside(*args, **kwargs)
        uncompiled: Callable[P, R] = torch.compiler.disable(inside)  # type: ignore[no-untyped-call]
        return uncompiled(*args, **kwargs)

    return call
