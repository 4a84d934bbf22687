"""Readers of public data sets, and their layouts as formats to write."""

from pimper_torch.evidence.datasets.colmap import read_colmap
from pimper_torch.evidence.datasets.diligent import read_diligent
from pimper_torch.evidence.datasets.diligent_mv import read_diligent_mv
from pimper_torch.evidence.datasets.dtu_mvs import read_dtu_mvs, read_dtu_protocol
from pimper_torch.evidence.datasets.dtu_points import read_dtu_points
from pimper_torch.evidence.datasets.idr import read_idr, write_idr
from pimper_torch.evidence.datasets.llff import read_llff
from pimper_torch.evidence.datasets.programs import read_meshroom, read_metashape, read_transforms
from pimper_torch.evidence.datasets.rendered import read_rendered
from pimper_torch.evidence.datasets.sampling import one_light_per_position
from pimper_torch.exchange.colmap_workspace import write_colmap
from pimper_torch.exchange.nerfstudio import write_transforms

__all__ = [
    "one_light_per_position",
    "read_colmap",
    "read_diligent",
    "read_diligent_mv",
    "read_dtu_mvs",
    "read_dtu_points",
    "read_dtu_protocol",
    "read_idr",
    "read_llff",
    "read_meshroom",
    "read_metashape",
    "read_rendered",
    "read_transforms",
    "write_colmap",
    "write_idr",
    "write_transforms",
]
