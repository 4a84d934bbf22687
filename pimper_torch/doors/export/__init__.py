"""Result folders: written, read, and converted for other programs."""

from pimper_torch.doors.export.layouts import write_formats
from pimper_torch.doors.export.result import Result, WrittenResult, read_result, read_written
from pimper_torch.doors.io.results import write_result
from pimper_torch.result.asset.mesh_files import MeshFiles

__all__ = [
    *("MeshFiles", "Result", "WrittenResult", "read_result", "read_written"),
    *("write_formats", "write_result"),
]
