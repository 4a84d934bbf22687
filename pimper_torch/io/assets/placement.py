"""Placement of an asset in its file: upright on the origin, in metres."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn.functional import normalize

from pimper_torch.geometry.local_frame import NO_OFFSET, Offset
from pimper_torch.geometry.rigid import invert_rigid, rigid
from pimper_torch.records import Cameras, Mesh
from pimper_torch.records.shapes import Pose, Vector, Vertices


@dataclass(frozen=True, slots=True, kw_only=True)
class Placement:
    """Name of an asset, and the transformation from its file's frame back to the scene.

    Attributes:
        scene_from_asset: A similarity in float64: the asset has y up, z towards the reference
            camera, and the middle of its base at the origin.
        offset_world: Of the scene; see ``SparseScene.offset_world``.
        metric: Whether the asset is in metres; otherwise its longest side is 1.
        cameras: Cameras written to the file, and the names of their photographs.
    """

    name: str
    scene_from_asset: Pose
    offset_world: Offset = NO_OFFSET
    metric: bool = False
    cameras: tuple[tuple[str, ...], Cameras] | None = None

    @property
    def extras(self) -> dict[str, object]:
        """Values that undo the placement, for glTF's ``extras``; the matrix is in column order."""
        return {
            "scene_from_asset": self.scene_from_asset.mT.flatten().tolist(),
            "offset_world": list(self.offset_world),
            "metric": self.metric,
        }

    def placed(self, vertices: Vertices, normals: Vertices) -> tuple[Vertices, Vertices]:
        """Transform vertices and their directions from the scene to the asset."""
        matrix = self.scene_from_asset
        rotation = normalize(matrix[:3, :3], dim=0)
        points = (vertices.double() - matrix[:3, 3]) @ rotation / matrix[:3, 0].norm()
        return points.float(), (normals.double() @ rotation).float()

    def gltf_cameras(self) -> list[dict[str, Any]]:
        """Return the cameras as glTF nodes with their ``camera``, without distortion."""
        if self.cameras is None:
            return []
        names, cameras = self.cameras
        nodes = []
        for view, name in enumerate(names):
            eye = invert_rigid(cameras.cam_from_world[view].detach().cpu().double())
            position, axes = self.placed(eye[None, :3, 3], eye[:3, :3].mT)
            back = axes.mT.double() * torch.tensor([1.0, -1.0, -1.0])  # y up, z backward
            width, height = cameras.sizes_px[view].tolist()
            yfov = 2 * math.atan(height / 2 / float(cameras.intrinsics[view, 1, 1]))
            perspective = {"yfov": yfov, "aspectRatio": width / height, "znear": 0.01}
            matrix = rigid(back, position[0].double()).mT.flatten().tolist()
            camera = {"type": "perspective", "name": name, "perspective": perspective}
            nodes.append({"name": name, "matrix": matrix, "camera": camera})
        return nodes


def standing(mesh: Mesh, cameras: Cameras, reference: int, up: Vector, metre: float | None) -> Pose:
    """Return ``scene_from_asset`` of a mesh placed on its base; see :class:`Placement`.

    Args:
        up: Unit, scene frame.
        metre: In scene units; ``None`` if the scale is unknown.
    """
    up, pose = up.detach().cpu().double(), cameras.cam_from_world[reference].detach().cpu().double()
    # Seen from straight above, the front is at the image's lower edge.
    towards = 1e-3 * pose[1, :3] - pose[2, :3]
    front = normalize(towards - (towards @ up) * up, dim=0)
    rotation = torch.stack([torch.linalg.cross(up, front), up, front], dim=1)
    low, high = (mesh.vertices_world.double() @ rotation).aminmax(dim=0)
    base = torch.stack([(low + high)[0] / 2, low[1], (low + high)[2] / 2])
    scale = float((high - low).max()) if metre is None else metre
    return rigid(scale * rotation, rotation @ base)
