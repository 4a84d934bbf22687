"""Folders of results: written, read back, and written for other programs."""

from pimper_torch.asset.finish import MeshFiles
from pimper_torch.exchange.layouts import write_formats
from pimper_torch.exchange.result import Result, read_result
from pimper_torch.io.results import write_result

__all__ = ["MeshFiles", "Result", "read_result", "write_formats", "write_result"]
