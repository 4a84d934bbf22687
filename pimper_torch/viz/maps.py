"""Maps of a mesh in a view, one value per pixel."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.rigid import rotate
from pimper_torch.geometry.surfaces import carried_normals
from pimper_torch.geometry.visibility import Hits, cast_view
from pimper_torch.radiometry.base_color import GREY
from pimper_torch.records import Cameras, Mesh, Record
from pimper_torch.records.shapes import Map, Mask, Vectors


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewMaps(Record):
    """A mesh rendered to the pixels of one camera.

    Attributes:
        seen: True where the ray through the pixel's centre meets the mesh.
        depth: Along the camera's z; NaN off the mesh.
        normals_cam: Unit, camera frame, interpolated from the mesh; zero off the mesh.
        albedo: Interpolated from the mesh; zero off the mesh.
        expected_error: Likewise, scene units; ``None`` if the mesh has none.
    """

    seen: Mask
    depth: Map
    normals_cam: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    confidence: Map
    expected_error: Map | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays of NPZ files: depth, mask, confidence, and expected error if known."""
        maps = {"depth": self.depth, "mask": self.seen, "confidence": self.confidence}
        if self.expected_error is not None:
            maps["expected_error"] = self.expected_error
        return {name: values.detach().cpu().numpy() for name, values in maps.items()}


def view_maps(mesh: Mesh, cameras: Cameras, view: int, hits: Hits | None = None) -> ViewMaps:
    """Render the maps of a mesh in one camera. Not differentiable.

    A mesh without normals gets vertex normals; one without albedo is grey, and one without
    confidence has full confidence.

    Args:
        hits: Of the view's rays on the mesh, if already computed.
    """
    hits = hits or cast_view(mesh, cameras, view)
    vertices = mesh.vertices_world
    albedo = torch.full_like(vertices, GREY) if mesh.albedo is None else mesh.albedo
    confidence = torch.ones_like(vertices[:, 0]) if mesh.confidence is None else mesh.confidence
    error = mesh.expected_error
    seen = hits.face >= 0

    def rendered(values: Float[Tensor, "vertex channel"]) -> Float[Tensor, "height width channel"]:
        return hits.interpolate(values, mesh.faces)

    normals_world = normalize(rendered(carried_normals(mesh)), dim=-1)
    return ViewMaps(
        seen=seen,
        depth=torch.where(seen, hits.distance, torch.nan),
        normals_cam=rotate(cameras.cam_from_world[view], normals_world),
        albedo=rendered(albedo),
        confidence=rendered(confidence[:, None])[..., 0],
        expected_error=None if error is None else rendered(error[:, None])[..., 0],
    )


def normal_colors(normals_cam: Vectors) -> Vectors:
    """Return the usual colours of normals: red to the right, green up, blue to the viewer.

    A zero vector, for a missing normal, is black.

    >>> normal_colors(torch.tensor([0.0, 0.0, -1.0]))  # faces the camera
    tensor([0.5000, 0.5000, 1.0000])
    """
    colors = 0.5 + 0.5 * normals_cam * normals_cam.new_tensor([1.0, -1.0, -1.0])
    present = (normals_cam != 0).any(dim=-1, keepdim=True)
    return torch.where(present, colors.clamp(0, 1), 0)
