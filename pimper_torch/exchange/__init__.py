"""Folders of results: read back, and written for other programs."""

from pimper_torch.exchange.layouts import write_formats
from pimper_torch.exchange.result import Result, read_result

__all__ = ["Result", "read_result", "write_formats"]
