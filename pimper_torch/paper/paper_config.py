"""Settings of the published chain, and of the stages that only it has."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from pimper_torch.radiometry import Encoding
from pimper_torch.runtime.config import Range, require_ranges
from pimper_torch.runtime.errors import OnFailure
from pimper_torch.stages.coarse.coarse_config import CoarseSurfaceConfig
from pimper_torch.stages.meshing.meshing_config import ExtractConfig
from pimper_torch.stages.patches.patches_config import DecomposeConfig, WarpConfig
from pimper_torch.stages.photometry.photometry_config import FactorizeConfig, FitLightConfig
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class TriangulateConfig:
    """Settings of the triangulation.

    Attributes:
        reference: Name or stem of the frontal photograph; empty selects it automatically.
        num_points: Approximate number of vertices, spread over the visible side.
    """

    reference: str = ""
    num_points: Annotated[int, Range(least=4, most=1_000_000)] = 250  # the largest clouds

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignConfig:
    """Settings of the alignment.

    Attributes:
        iterations: Number of rounds of intersecting the transformed overlaps and solving.
        anchor: Weight of a facet's vertex relative to the agreement of a seam; reduced for points
            with an uncertainty above the disagreement at the seams.
        prior: Weight of the identity for each transform. If neighbours differ only in scale, 1e-3
            corrects three quarters of a wrong scale, and 1e-4 all but 4 %; if they do not agree at
            all, 1e-4 allows flattening.
        scale_limit: Largest factor by which a height field is flattened or stretched.
    """

    iterations: Annotated[int, Range(least=1, most=1000)] = 3  # a solve each
    anchor: Annotated[float, Range(least=0, most=1e12)] = 1.0
    prior: Annotated[float, Range(above=0, most=1e12)] = 3e-4
    scale_limit: Annotated[float, Range(above=1)] = 4.0

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineConfig:
    """Settings of the refinement.

    Attributes:
        smoothing_radius_samples: ``r``, in vertices of the surface: lambda is
            ``1 / (r * spacing)^2``. For constant G, a wave of length ``w`` keeps
            ``1 / (1 + (2 pi R / w)^2)`` of its height, with ``R = r sqrt(G / (1 - G))`` vertices.
    """

    smoothing_radius_samples: Annotated[float, Range(above=0, most=65_535)] = 2.0

    def __post_init__(self) -> None:
        require_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class PublishedConfig:
    """Settings of every stage of the published chain, in the order in which they run.

    Attributes:
        chain: Name of the chain.
        on_failure: If a patch, view or solver fails, omit it and continue (skip), or stop (fail).
        photographs: ``encoding`` of :func:`~pimper_torch.io.photographs.load_views`.
    """

    chain: ClassVar[str] = "published"
    on_failure: OnFailure = "skip"
    photographs: Encoding = field(default_factory=Encoding)
    reconstruct: ReconstructConfig = field(default_factory=ReconstructConfig)
    silhouettes: SilhouetteConfig = field(default_factory=SilhouetteConfig)
    triangulate: TriangulateConfig = field(default_factory=TriangulateConfig)
    coarse_surface: CoarseSurfaceConfig = field(default_factory=CoarseSurfaceConfig)
    decompose: DecomposeConfig = field(default_factory=DecomposeConfig)
    warp: WarpConfig = field(default_factory=WarpConfig)
    light: FitLightConfig = field(default_factory=FitLightConfig)
    factorize: FactorizeConfig = field(default_factory=FactorizeConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    refine: RefineConfig = field(default_factory=RefineConfig)
    extract: ExtractConfig = field(default_factory=ExtractConfig)
