"""Maps of a mesh as a view shows it, pixel by pixel."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import rotate
from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.geometry.visibility import Hits, cast_view
from pimper_torch.ground.shapes import Map, Mask, Vectors, Vertices
from pimper_torch.records import Cameras, Mesh, Record

_GREY = 0.5  # colour of a mesh of unknown albedo


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class ViewMaps(Record):
    """A mesh seen through the pixels of one camera.

    Attributes:
        seen: True where the ray through the pixel's centre meets the mesh.
        depth: Along the camera's z; NaN where nothing is seen.
        normals_cam: Unit, camera frame, as the mesh carries them; zero where nothing is seen.
        albedo: As the mesh carries it; zero where nothing is seen.
        expected_error: The same, scene units; ``None`` where the mesh carries none.
    """

    seen: Mask
    depth: Map
    normals_cam: Float[Tensor, "height width 3"]
    albedo: Float[Tensor, "height width channel"]
    confidence: Map
    expected_error: Map | None = None

    def arrays(self) -> dict[str, np.ndarray]:
        """Return what NPZ files hold: depth, mask, confidence, and expected error where known."""
        maps = {"depth": self.depth, "mask": self.seen, "confidence": self.confidence}
        if self.expected_error is not None:
            maps["expected_error"] = self.expected_error
        return {name: values.detach().cpu().numpy() for name, values in maps.items()}


def view_maps(mesh: Mesh, cameras: Cameras, view: int, hits: Hits | None = None) -> ViewMaps:
    """Look at a mesh through one camera.

    A mesh without normals shows those of its faces, averaged around the vertices; one without
    albedo is grey, one without confidence has full confidence. A constant to autograd.

    Args:
        hits: Of the view's rays on the mesh, if they are known already.
    """
    hits = hits or cast_view(mesh, cameras, view)
    vertices = mesh.vertices_world
    albedo = torch.full_like(vertices, _GREY) if mesh.albedo is None else mesh.albedo
    confidence = torch.ones_like(vertices[:, 0]) if mesh.confidence is None else mesh.confidence
    error = mesh.expected_error
    seen = hits.face >= 0

    def shown(values: Float[Tensor, "vertex channel"]) -> Float[Tensor, "height width channel"]:
        return hits.interpolate(values, mesh.faces)

    normals_world = normalize(shown(carried_normals(mesh)), dim=-1)
    return ViewMaps(
        seen=seen,
        depth=torch.where(seen, hits.distance, torch.nan),
        normals_cam=rotate(cameras.cam_from_world[view], normals_world),
        albedo=shown(albedo),
        confidence=shown(confidence[:, None])[..., 0],
        expected_error=None if error is None else shown(error[:, None])[..., 0],
    )


def carried_normals(mesh: Mesh) -> Vertices:
    """Return a mesh's normals; without, those of its faces, averaged around the vertices."""
    if mesh.normals_world is None:
        return vertex_normals(mesh.vertices_world, mesh.faces)
    return mesh.normals_world


def normal_colors(normals_cam: Vectors) -> Vectors:
    """Colour normals the usual way: red to the right, green up, blue to the viewer.

    Zero, where there is no normal, is black.

    >>> normal_colors(torch.tensor([0.0, 0.0, -1.0]))  # faces the camera
    tensor([0.5000, 0.5000, 1.0000])
    """
    colors = 0.5 + 0.5 * normals_cam * normals_cam.new_tensor([1.0, -1.0, -1.0])
    there = (normals_cam != 0).any(dim=-1, keepdim=True)
    return torch.where(there, colors.clamp(0, 1), 0)


def albedo_scale(mesh: Mesh) -> float:
    """Choose the factor that brings a mesh's albedo, free up to a scale, into [0, 1].

    It takes the brightest vertices but for one in a hundred, which highlights may have
    spoilt, to 0.9.
    """
    if mesh.albedo is None or not len(mesh.albedo):
        return 1.0
    brightest = mesh.albedo.detach().amax(dim=-1).nan_to_num(0)
    known = brightest[brightest > 0]
    if not len(known):
        return 1.0
    rank = max(1, round(0.99 * len(known)))
    return float(0.9 / known.kthvalue(rank).values)


def base_color(mesh: Mesh, scale: float | None = None) -> Float[Tensor, "vertex channel"]:
    """Return a mesh's albedo in [0, 1], linear: glTF's base colour; grey where it has none.

    Args:
        scale: Of the albedo; :func:`albedo_scale` without.
    """
    if mesh.albedo is None:
        return torch.full_like(mesh.vertices_world, _GREY)
    scale = albedo_scale(mesh) if scale is None else scale
    return (scale * mesh.albedo.detach()).nan_to_num(0).clamp(0, 1)
