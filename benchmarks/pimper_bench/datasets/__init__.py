"""Readers of public data sets, and writers of their layouts.

If a folder has a different layout, or a file is missing or damaged, a reader raises
:class:`~pimper_torch.runtime.errors.InputError` with the expected and the found layout.
"""

from pimper_bench.datasets.colmap import write_colmap
from pimper_bench.datasets.diligent import read_diligent_mv
from pimper_bench.datasets.dtu_sets import read_dtu_mvs, read_dtu_points, read_dtu_protocol
from pimper_bench.datasets.formats import (
    read_camera_file,
    read_colmap,
    read_idr,
    read_llff,
    read_transforms,
)
from pimper_bench.datasets.idr import write_idr
from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.datasets.sampling import one_light_per_position
from pimper_torch.export.nerfstudio import write_transforms

__all__ = [
    "one_light_per_position",
    "read_camera_file",
    "read_colmap",
    "read_diligent_mv",
    "read_dtu_mvs",
    "read_dtu_points",
    "read_dtu_protocol",
    "read_idr",
    "read_llff",
    "read_rendered",
    "read_transforms",
    "write_colmap",
    "write_idr",
    "write_transforms",
]
