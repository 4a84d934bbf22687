# Public names, imported on first use (`__init__.py`).
__all__: list[str]
from .coarse.remesh import Remesh as Remesh
from .coarse.surface import CoarseSurface as CoarseSurface
from .coarse.surface import facets_of as facets_of
from .fusion.fuse import Fuse as Fuse
from .light_depth.depth_from_light import DepthFromLight as DepthFromLight
from .meshing.extract import Extract as Extract
from .meshing.finish import Simplify as Simplify
from .meshing.repair import Repair as Repair
from .patches.decompose import Decompose as Decompose
from .patches.warp import Warp as Warp
from .photometry.factorize import Factorize as Factorize
from .photometry.fit_light import FitLight as FitLight
from .photometry.fit_light import Illumination as Illumination
from .photometry.gauge import FixGauge as FixGauge
from .photometry.photometry_config import FactorizeConfig as FactorizeConfig
from .photometry.photometry_config import FitLightConfig as FitLightConfig
from .relighting.held_out import Relight as Relight
from .sfm.reconstruct import Reconstruct as Reconstruct
from .silhouettes.find import FindSilhouettes as FindSilhouettes
from .silhouettes.trace import TraceContours as TraceContours
from .stage import Given as Given
from .stage import Stage as Stage
from .stage import Then as Then
from .sweep.sweep import Sweep as Sweep
from .texturing.bake import Texture as Texture
