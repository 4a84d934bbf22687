"""Frozen data that travels between stages; no algorithms."""

from pimper_torch.records.finished import ClosedMesh as ClosedMesh
from pimper_torch.records.finished import FinishedMesh as FinishedMesh
from pimper_torch.records.finished import Materials as Materials
from pimper_torch.records.finished import Relighting as Relighting
from pimper_torch.records.finished import TexturedMesh as TexturedMesh
from pimper_torch.records.finished import ViewErrors as ViewErrors
from pimper_torch.records.finished import ViewLights as ViewLights
from pimper_torch.records.heights import AlignStatus as AlignStatus
from pimper_torch.records.heights import DepthPatches as DepthPatches
from pimper_torch.records.heights import Depths as Depths
from pimper_torch.records.heights import Heights as Heights
from pimper_torch.records.heights import Surface as Surface
from pimper_torch.records.heights import SweptPatches as SweptPatches
from pimper_torch.records.patches import Convergence as Convergence
from pimper_torch.records.patches import Observations as Observations
from pimper_torch.records.patches import PatchPriors as PatchPriors
from pimper_torch.records.patches import PatchSet as PatchSet
from pimper_torch.records.patches import PatchStatus as PatchStatus
from pimper_torch.records.patches import PatchViews as PatchViews
from pimper_torch.records.patches import PhotometricPatches as PhotometricPatches
from pimper_torch.records.patches import Photometry as Photometry
from pimper_torch.records.patches import StopCause as StopCause
from pimper_torch.records.patches import Templates as Templates
from pimper_torch.records.priors import AlbedoPrior as AlbedoPrior
from pimper_torch.records.priors import DepthPrior as DepthPrior
from pimper_torch.records.priors import InlierPrior as InlierPrior
from pimper_torch.records.priors import LightPrior as LightPrior
from pimper_torch.records.priors import MapPrior as MapPrior
from pimper_torch.records.priors import NormalPrior as NormalPrior
from pimper_torch.records.priors import Prior as Prior
from pimper_torch.records.priors import SilhouettePrior as SilhouettePrior
from pimper_torch.records.reconstruction import Estimate as Estimate
from pimper_torch.records.reconstruction import Reconstruction as Reconstruction
from pimper_torch.records.record import Record as Record
from pimper_torch.records.scene import CameraModel as CameraModel
from pimper_torch.records.scene import CoarseMesh as CoarseMesh
from pimper_torch.records.scene import FacetPoints as FacetPoints
from pimper_torch.records.scene import Mesh as Mesh
from pimper_torch.records.scene import SparseScene as SparseScene
from pimper_torch.records.scene import Support as Support
from pimper_torch.records.scene import pairs_table as pairs_table
from pimper_torch.records.silhouettes import ContourPoints as ContourPoints
from pimper_torch.records.silhouettes import ContourRays as ContourRays
from pimper_torch.records.silhouettes import OrientedPoints as OrientedPoints
from pimper_torch.records.silhouettes import SilhouetteCoverage as SilhouetteCoverage
from pimper_torch.records.silhouettes import Silhouettes as Silhouettes
from pimper_torch.records.stored import load_record as load_record
from pimper_torch.records.stored import save_record as save_record
from pimper_torch.records.views import Cameras as Cameras
from pimper_torch.records.views import Views as Views
from pimper_torch.runtime.events import Failure as Failure
from pimper_torch.runtime.events import Removal as Removal
from pimper_torch.runtime.events import StageReport as StageReport
from pimper_torch.runtime.renamed import renamed_names

__getattr__ = renamed_names(__name__, {"LeftOut": "Removal", "Lens": "CameraModel"})
