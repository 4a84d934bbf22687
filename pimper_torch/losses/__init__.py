"""Losses of a surface, as modules: against photographs, a true surface, normals, silhouettes."""

from pimper_torch.losses.consistency import ConsistencyLoss
from pimper_torch.losses.normals import NormalLoss
from pimper_torch.losses.photometric import PhotometricLoss
from pimper_torch.losses.point_to_surface import PointToSurfaceLoss
from pimper_torch.losses.silhouette import SilhouetteLoss
from pimper_torch.losses.visible import well_visible

__all__ = ["ConsistencyLoss", "NormalLoss", "PhotometricLoss", "PointToSurfaceLoss"]
__all__ += ["SilhouetteLoss", "well_visible"]
