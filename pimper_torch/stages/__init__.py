"""Every stage and chain, under one name: ``pt.stages.Warp``.

``CoarseToFine`` (presets ``default`` and ``fast``) runs ``Reconstruct``, ``FindSilhouettes``,
``TraceContours`` and ``CoarseSurface``; for each scale ``Decompose``, ``Warp``, ``FitLight``,
``Factorize``, ``Sweep``, ``FixGauge``, ``Fuse``, ``Repair`` and ``Remesh``; then ``Extract``.
``Chain.finish`` runs ``Simplify``, ``Relight`` and ``Texture``.
"""

from pimper_torch.asset.finish import Simplify as Simplify
from pimper_torch.asset.make import Texture as Texture
from pimper_torch.chains.chain import Chain as Chain
from pimper_torch.chains.chain import Step as Step
from pimper_torch.chains.coarse_to_fine import CoarseToFine as CoarseToFine
from pimper_torch.chains.coarse_to_fine import CoarseToFineConfig as CoarseToFineConfig
from pimper_torch.chains.presets import load_chain as load_chain
from pimper_torch.chains.presets import load_config as load_config
from pimper_torch.chains.presets import make_chain as make_chain
from pimper_torch.chains.published import Published as Published
from pimper_torch.chains.published import PublishedConfig as PublishedConfig
from pimper_torch.coarse.remesh import Remesh as Remesh
from pimper_torch.coarse.surface import CoarseSurface as CoarseSurface
from pimper_torch.coarse.surface import facets_of as facets_of
from pimper_torch.fusion.fuse import Fuse as Fuse
from pimper_torch.geometry.contours import Contours as Contours
from pimper_torch.meshing.extract import Extract as Extract
from pimper_torch.meshing.repair import Repair as Repair
from pimper_torch.paper.triangulate import Triangulate as Triangulate
from pimper_torch.patches.decompose import Decompose as Decompose
from pimper_torch.patches.warp import Warp as Warp
from pimper_torch.photometry.factorize import Factorize as Factorize
from pimper_torch.photometry.factorize import FactorizeConfig as FactorizeConfig
from pimper_torch.photometry.fit_light import FitLight as FitLight
from pimper_torch.photometry.fit_light import FitLightConfig as FitLightConfig
from pimper_torch.photometry.fit_light import Illumination as Illumination
from pimper_torch.photometry.gauge import FixGauge as FixGauge
from pimper_torch.relighting.held_out import Relight as Relight
from pimper_torch.sfm.reconstruct import Reconstruct as Reconstruct
from pimper_torch.silhouettes.find import FindSilhouettes as FindSilhouettes
from pimper_torch.silhouettes.trace import TraceContours as TraceContours
from pimper_torch.stage import Given as Given
from pimper_torch.stage import Stage as Stage
from pimper_torch.stage import Then as Then
from pimper_torch.sweep.sweep import Sweep as Sweep
