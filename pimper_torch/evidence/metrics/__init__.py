"""Figures that compare a result with the truth, each under its own named convention."""

from pimper_torch.evidence.metrics.alignment import Alignment, align_estimate, transfer
from pimper_torch.evidence.metrics.distances import SurfaceComparison, TrueSurface
from pimper_torch.evidence.metrics.dtu import DtuFigures, dtu_figures
from pimper_torch.evidence.metrics.evaluate import EvaluateConfig, Evaluation, evaluate
from pimper_torch.evidence.metrics.icp import IcpConfig, IcpResult, trimmed_icp
from pimper_torch.evidence.metrics.in_view import ViewFigures, compare_along_rays
from pimper_torch.evidence.metrics.lights import LightFigures, compare_lights
from pimper_torch.evidence.metrics.poses import CameraFigures, compare_cameras
from pimper_torch.evidence.metrics.reflectance import AlbedoFigures, compare_albedo
from pimper_torch.evidence.metrics.relative import angles_deg, relative_error
from pimper_torch.evidence.metrics.report import Row, report, rows
from pimper_torch.evidence.metrics.sampling import SurfaceSamples, sample_surface
from pimper_torch.evidence.metrics.similarity import (
    pair_views,
    similarity_between_cameras,
    similarity_between_points,
)
from pimper_torch.evidence.metrics.thinning import thin
from pimper_torch.geometry.nearest import Nearest, NearestSurface

__all__ = [
    "AlbedoFigures",
    "Alignment",
    "CameraFigures",
    "DtuFigures",
    "EvaluateConfig",
    "Evaluation",
    "IcpConfig",
    "IcpResult",
    "LightFigures",
    "Nearest",
    "NearestSurface",
    "Row",
    "SurfaceComparison",
    "SurfaceSamples",
    "ViewFigures",
    "align_estimate",
    "angles_deg",
    "compare_albedo",
    "compare_along_rays",
    "compare_cameras",
    "compare_lights",
    "dtu_figures",
    "evaluate",
    "pair_views",
    "relative_error",
    "report",
    "rows",
    "sample_surface",
    "similarity_between_cameras",
    "similarity_between_points",
    "thin",
    "transfer",
    "trimmed_icp",
]
