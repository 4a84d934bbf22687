"""Frozen data that travels between stages; no algorithms."""

from pimper_torch.records.contour_rays import ContourPoints, ContourRays
from pimper_torch.records.failure import Failure, LeftOut
from pimper_torch.records.patches import (
    AlignStatus,
    Convergence,
    DepthPatches,
    Depths,
    Heights,
    Observations,
    PatchPriors,
    PatchSet,
    PatchStatus,
    PatchViews,
    PhotometricPatches,
    Photometry,
    StopCause,
    Surface,
    SweptPatches,
    Templates,
)
from pimper_torch.records.priors import (
    AlbedoPrior,
    DepthPrior,
    InlierPrior,
    LightPrior,
    MapPrior,
    NormalPrior,
    Prior,
    SilhouettePrior,
)
from pimper_torch.records.reconstruction import Reconstruction, StageReport
from pimper_torch.records.record import Record
from pimper_torch.records.scene import (
    CoarseMesh,
    FacetPoints,
    Lens,
    Mesh,
    SparseScene,
    Support,
    pairs_table,
)
from pimper_torch.records.silhouettes import Silhouettes
from pimper_torch.records.truth import Capture, DtuProtocol, Estimate, Truth
from pimper_torch.records.views import Cameras, Views

__all__ = [
    "AlbedoPrior",
    "AlignStatus",
    "Cameras",
    "Capture",
    "CoarseMesh",
    "ContourPoints",
    "ContourRays",
    "Convergence",
    "DepthPatches",
    "DepthPrior",
    "Depths",
    "DtuProtocol",
    "Estimate",
    "FacetPoints",
    "Failure",
    "Heights",
    "InlierPrior",
    "LeftOut",
    "Lens",
    "LightPrior",
    "MapPrior",
    "Mesh",
    "NormalPrior",
    "Observations",
    "PatchPriors",
    "PatchSet",
    "PatchStatus",
    "PatchViews",
    "PhotometricPatches",
    "Photometry",
    "Prior",
    "Reconstruction",
    "Record",
    "SilhouettePrior",
    "Silhouettes",
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
