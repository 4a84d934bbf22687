"""How much of the silhouettes a surface explains, as each view sees it."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pimper_torch.ground.geometry.contours import Contours
from pimper_torch.ground.geometry.projection import rays_through
from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, SilhouetteCoverage, Surface
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.parallel import side_by_side


@torch.no_grad()
def explain(
    surface: Mesh | Surface, contours: Contours, names: Sequence[str] = (), most: float = 0.1
) -> SilhouetteCoverage:
    """Compare a surface with the silhouettes that it was made from; a constant to autograd.

    Args:
        names: Of the views, to warn of the worst; silent by default.
        most: Fraction of a silhouette's area that is not warned of. Worst views of plain sets lack
            up to 0.08 (potatoes, 12 views along the arc, 320x240, fast) and have 0.05 that sticks
            out (the demo).
    """
    vertices, faces = surface.vertices_world, surface.faces
    caster, normals = RayCaster(vertices, faces), face_normals(vertices, faces)
    cameras, silhouettes = contours.cameras.to(vertices.dtype), contours.silhouettes

    def of_view(view: int) -> Tensor:
        width, height = cameras.sizes_px[view].tolist()
        step = max(1, round(math.sqrt(width * height / 20_000)))
        rows, columns = (torch.arange(step // 2, side, step) for side in (height, width))
        inside = silhouettes.inside[view, rows][:, columns].to(vertices)
        pixels = torch.cartesian_prod(columns, rows).to(vertices) + 0.5
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        face = caster.cast(cameras.centers_world[view], rays).face
        front = (face >= 0) & ((normals[face.clamp_min(0)] * rays).sum(dim=1) < 0)
        shown, own = (one.reshape(len(columns), len(rows)).mT for one in (face >= 0, front))
        area = (inside > 0.5).sum().clamp_min(1)
        beside = (shown * (1 - 2 * inside).clamp_min(0)).sum()
        return torch.stack([((inside > 0.5) & ~own).sum() / area, beside / area])

    views = silhouettes.reliable.nonzero()[:, 0].tolist() if contours.confine else []
    rows = [vertices.new_zeros(0, 2), *(one[None] for one in side_by_side(of_view, views))]
    uncovered, outside = torch.cat(rows).unbind(dim=1)
    for found, what in ((uncovered, "lacks"), (outside, "sticks out by")):
        if names and len(found) and float(found.max()) > most:
            worst = names[views[int(found.argmax())]]
            caution(
                f"{worst}: the surface {what} {float(found.max()):.0%} of the silhouette's area, "
                f"and {int((found > most).sum())} of {len(views)} views see more than "
                f"{most:.0%}. Look at its silhouette in overview.png; `--masks` replaces it.",
                stacklevel=2,
            )
    return SilhouetteCoverage(uncovered=uncovered, outside=outside)
