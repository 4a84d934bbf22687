"""Coverage of the silhouettes by a surface, per view."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.pixels import pixels_from_indices
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, SilhouetteCoverage, Surface
from pimper_torch.runtime.errors import caution
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.stage import Stage


class Explain(Stage):
    """Compare a surface with the silhouettes that it was made from. Not differentiable."""

    @torch.no_grad()
    def forward(
        self,
        surface: Mesh | Surface,
        contours: Contours,
        names: Sequence[str] = (),
        most: float = 0.1,
    ) -> SilhouetteCoverage:
        """Return the fractions of every silhouette that the surface lacks or exceeds.

        Args:
            names: Of the views, to warn about the worst; no warning by default.
            most: Fraction of a silhouette's area without a warning. The worst views of plain sets
                lack up to 0.08 (potatoes, 12 views along the arc, 320x240, fast), and 0.05 sticks
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
            pixels = pixels_from_indices(torch.cartesian_prod(columns, rows).to(vertices))
            rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
            face = caster.cast(cameras.centers_world[view], rays).face
            front = (face >= 0) & ((normals[face.clamp_min(0)] * rays).sum(dim=1) < 0)
            hit, covered = (x.reshape(len(columns), len(rows)).mT for x in (face >= 0, front))
            area = (inside > 0.5).sum().clamp_min(1)
            outside = (hit * (1 - 2 * inside).clamp_min(0)).sum()
            return torch.stack([((inside > 0.5) & ~covered).sum() / area, outside / area])

        views = silhouettes.reliable.nonzero()[:, 0].tolist() if contours.confine else []
        rows = [vertices.new_zeros(0, 2), *(row[None] for row in side_by_side(of_view, views))]
        uncovered, outside = torch.cat(rows).unbind(dim=1)
        for values, verb in ((uncovered, "lacks"), (outside, "sticks out by")):
            if names and len(values) and float(values.max()) > most:
                worst = names[views[int(values.argmax())]]
                caution(
                    f"{worst}: the surface {verb} {float(values.max()):.0%} of the silhouette's "
                    f"area; more than {most:.0%} in {int((values > most).sum())} of {len(views)} "
                    "views. Check it in overview.png; `--masks` replaces it.",
                    stacklevel=2,
                )
        return SilhouetteCoverage(uncovered=uncovered, outside=outside)
