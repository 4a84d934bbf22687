"""All stages and chains in one namespace: ``pt.stages.Warp``.

``CoarseToFine`` (presets ``default`` and ``fast``) runs ``Reconstruct``, ``FindSilhouettes``,
``TraceContours``, ``CoarseSurface`` and ``DepthFromLight``; for each scale ``Decompose``, ``Warp``,
``FitLight``, ``Factorize``, ``Sweep``, ``FixGauge``, ``Fuse``, ``Repair`` and ``Remesh``; then
``Extract``.
``Chain.finish`` runs ``Simplify``, ``Relight`` and ``Texture``.
"""

from pimper_torch.ground.geometry.contours import Contours as Contours
from pimper_torch.method.chains.chain import Chain as Chain
from pimper_torch.method.chains.chain import Step as Step
from pimper_torch.method.chains.chain_config import CoarseToFineConfig as CoarseToFineConfig
from pimper_torch.method.chains.chain_config import PublishedConfig as PublishedConfig
from pimper_torch.method.chains.chain_config import load_config as load_config
from pimper_torch.method.chains.coarse_to_fine import CoarseToFine as CoarseToFine
from pimper_torch.method.chains.presets import load_chain as load_chain
from pimper_torch.method.chains.presets import make_chain as make_chain
from pimper_torch.method.chains.published import Published as Published
from pimper_torch.method.coarse.remesh import Remesh as Remesh
from pimper_torch.method.coarse.surface import CoarseSurface as CoarseSurface
from pimper_torch.method.coarse.surface import facets_of as facets_of
from pimper_torch.method.fusion.fuse import Fuse as Fuse
from pimper_torch.method.meshing.extract import Extract as Extract
from pimper_torch.method.meshing.repair import Repair as Repair
from pimper_torch.method.patches.decompose import Decompose as Decompose
from pimper_torch.method.patches.warp import Warp as Warp
from pimper_torch.method.photometry.depth_from_light import DepthFromLight as DepthFromLight
from pimper_torch.method.photometry.factorize import Factorize as Factorize
from pimper_torch.method.photometry.fit_light import FitLight as FitLight
from pimper_torch.method.photometry.fit_light import Illumination as Illumination
from pimper_torch.method.photometry.gauge import FixGauge as FixGauge
from pimper_torch.method.photometry.photometry_config import FactorizeConfig as FactorizeConfig
from pimper_torch.method.photometry.photometry_config import FitLightConfig as FitLightConfig
from pimper_torch.method.sfm.reconstruct import Reconstruct as Reconstruct
from pimper_torch.method.silhouettes.find import FindSilhouettes as FindSilhouettes
from pimper_torch.method.silhouettes.trace import TraceContours as TraceContours
from pimper_torch.method.sweep.sweep import Sweep as Sweep
from pimper_torch.published.triangulate import Triangulate as Triangulate
from pimper_torch.result.asset.bake import Texture as Texture
from pimper_torch.result.asset.finish import Simplify as Simplify
from pimper_torch.result.relighting.held_out import Relight as Relight
from pimper_torch.runtime.stage import Given as Given
from pimper_torch.runtime.stage import Stage as Stage
from pimper_torch.runtime.stage import Then as Then
