"""Figures that compare a result with ground truth, each by a named convention."""

from pimper_bench.metrics.camera_errors import (
    CameraFigures,
    LightFigures,
    compare_cameras,
    compare_lights,
)
from pimper_bench.metrics.dtu_protocol import DtuFigures, dtu_figures, thin
from pimper_bench.metrics.estimates import estimate_of
from pimper_bench.metrics.evaluation import EvaluateConfig, Evaluation, evaluate
from pimper_bench.metrics.figure_rows import FigureRow, report, rows
from pimper_bench.metrics.in_view import (
    AlbedoFigures,
    ViewFigures,
    angles_deg,
    compare_albedo,
    compare_along_rays,
    relative_error,
)
from pimper_bench.metrics.similarity import (
    Alignment,
    align_estimate,
    pair_views,
    similarity_between_cameras,
    similarity_between_points,
    transfer,
    trimmed_icp,
)
from pimper_bench.metrics.surface_distances import (
    SurfaceComparison,
    SurfaceSamples,
    TrueSurface,
    sample_surface,
)

__all__ = [
    "AlbedoFigures",
    "Alignment",
    "CameraFigures",
    "DtuFigures",
    "EvaluateConfig",
    "Evaluation",
    "FigureRow",
    "LightFigures",
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
    "estimate_of",
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
