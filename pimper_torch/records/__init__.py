"""Frozen data that travels between stages; no algorithms."""

from pimper_torch.records.outlines import Outlines
from pimper_torch.records.patches import (
    AlignVerdict,
    Convergence,
    DepthPatches,
    Depths,
    Heights,
    PatchSet,
    PatchVerdict,
    PatchViews,
    PhotometricPatches,
    Photometry,
    Registered,
    StopCause,
    Surface,
    SweptPatches,
    Templates,
)
from pimper_torch.records.reconstruction import Reconstruction, StageReport
from pimper_torch.records.record import Record
from pimper_torch.records.rims import RimPoints, RimRays
from pimper_torch.records.scene import (
    CoarseMesh,
    FacetPoints,
    Lens,
    Mesh,
    SparseScene,
    Support,
    pairs_table,
)
from pimper_torch.records.truth import Capture, DtuProtocol, Estimate, Truth
from pimper_torch.records.views import Cameras, Views

__all__ = [
    "AlignVerdict",
    "Cameras",
    "Capture",
    "CoarseMesh",
    "Convergence",
    "DepthPatches",
    "Depths",
    "DtuProtocol",
    "Estimate",
    "FacetPoints",
    "Heights",
    "Lens",
    "Mesh",
    "Outlines",
    "PatchSet",
    "PatchVerdict",
    "PatchViews",
    "PhotometricPatches",
    "Photometry",
    "Reconstruction",
    "Record",
    "Registered",
    "RimPoints",
    "RimRays",
    "SparseScene",
    "StageReport",
    "StopCause",
    "Support",
    "Surface",
    "SweptPatches",
    "Templates",
    "Truth",
    "Views",
    "pairs_table",
]
