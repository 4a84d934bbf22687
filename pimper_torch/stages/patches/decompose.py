"""Decomposition of the coarse mesh into patches, one template per facet."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import rigid, transform
from pimper_torch.geometry.surfaces import barycentric_2d, face_normals, unit_face_normals
from pimper_torch.records import Cameras, CoarseMesh, Mesh, PatchSet, Surface, Templates
from pimper_torch.records.shapes import Faces, Pose, Scalar, Vertices, ViewMask
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.failures import skipped_patches
from pimper_torch.runtime.memory import recomputed
from pimper_torch.stages.patches.patches_config import DecomposeConfig
from pimper_torch.stages.patches.transfer import transfer
from pimper_torch.stages.patches.view_choice import view_blocks
from pimper_torch.stages.stage import Stage

Indices = Int[Tensor, " bucket"]


class Decompose(Stage):
    """Compute a template for every facet: a frame, an enlarged triangle and a raster."""

    def __init__(self, config: DecomposeConfig | None = None) -> None:
        super().__init__()
        self.config = config or DecomposeConfig()

    def forward(
        self,
        coarse: CoarseMesh,
        cameras: Cameras,
        surface: Surface | None = None,
        scale: float = 1.0,
    ) -> PatchSet:
        """Return the patches of a coarse mesh.

        All templates have the same sample spacing, ``1 / (samples_per_pixel * scale)`` pixels of
        the reference view at the median depth of the mesh, or more if ``max_samples`` requires it.

        Args:
            surface: Transferred to the templates; without it, they are flat.
            scale: Scale of the photographs; 1 is full size.

        Raises:
            ReconstructionError: The mesh has no facets.
        """
        coarse = with_area(coarse)
        vertices, faces = coarse.mesh.vertices_world, coarse.mesh.faces
        if len(faces) == 0:
            raise ReconstructionError(
                "decompose: the coarse mesh has 0 facets with an area; needed: at least one. Check "
                "the points, or give a mesh."
            )
        patch_from_world = facet_frames(vertices, faces, cameras.cam_from_world[coarse.reference])
        corners = transform(patch_from_world, vertices[faces])[..., :2]
        faced = views_facing(vertices, faces, cameras)
        spacing = self._spacing(coarse, cameras, faced, scale)
        overlap = self.config.overlap_samples * spacing
        enlarged = enlarge(corners, overlap)
        low, high = _extents(corners, enlarged, overlap)
        sides = ((high - low) / spacing).ceil().long() + 1

        def templates(facets: Indices, raster: tuple[int, int], views: ViewMask) -> Templates:
            height, width = raster
            grid = spacing * (pixel_centers(width, height, like=low) - 0.5)
            positions = low[facets, None, None] + grid
            barycentric = recomputed(barycentric_2d, positions, corners[facets, None, None])
            within = barycentric_2d(positions.detach(), enlarged.detach()[facets, None, None])
            return Templates(
                facet=facets,
                patch_from_world=patch_from_world[facets],
                origin=low[facets],
                spacing=spacing.expand(len(facets)),
                depth=torch.zeros_like(barycentric[..., 0]),
                barycentric=barycentric,
                inside=(within >= 0).all(dim=-1),
                views=None if bool(views.all()) else views,
            )

        most = self.config.bucket_entries
        buckets = tuple(
            templates(block[facets], raster, views)
            for block, views in self._blocks(coarse.mesh, cameras, faced, spacing)
            for facets, raster in group_by_size(sides[block], most // int(views.sum()))
        )
        patches = PatchSet(coarse=coarse, buckets=buckets)
        return patches if surface is None else transfer(patches, surface.mesh)

    def _spacing(
        self, coarse: CoarseMesh, cameras: Cameras, faced: Int[Tensor, " face"], scale: float
    ) -> Scalar:
        """Return the sample spacing with which views have at most the permitted samples."""
        vertices, faces = coarse.mesh.vertices_world, coarse.mesh.faces
        density = self.config.samples_per_pixel * scale
        spacing = sample_spacing(vertices, cameras, coarse.reference, density)
        area = face_normals(vertices, faces).norm(dim=-1) / 2
        warped = (area * faced.clamp_max(self.config.num_views)).sum()
        return torch.maximum(spacing, (warped / self.config.max_samples).sqrt())

    def _blocks(
        self, mesh: Mesh, cameras: Cameras, faced: Int[Tensor, " face"], spacing: Scalar
    ) -> list[tuple[Indices, ViewMask]]:
        """Return blocks of facets with their views, which are all if no facet has too many."""
        if bool((faced > self.config.num_views).any()):
            return view_blocks(mesh, cameras, spacing, self.config.num_views)
        every = torch.arange(len(mesh.faces), device=faced.device)
        return [(every, faced.new_ones(cameras.num_views, dtype=torch.bool))]


def with_area(coarse: CoarseMesh) -> CoarseMesh:
    """Return the coarse mesh without facets of zero area, which have no template."""
    mesh, points = coarse.mesh, coarse.points
    kept = (face_normals(mesh.vertices_world.detach(), mesh.faces) != 0).any(dim=1)
    if bool(kept.all()):
        return coarse
    reason, done = "its facet has no area", "These facets are removed from the coarse mesh"
    skipped_patches("decompose", (~kept).nonzero()[:, 0], reason, done)
    if points is not None:
        points = points.take(kept[points.facet].nonzero()[:, 0])
        points = points.replace(facet=(kept.long().cumsum(dim=0) - 1)[points.facet])
    return coarse.replace(
        mesh=mesh.replace(faces=mesh.faces[kept]),
        points=points,
        support=None if coarse.support is None else coarse.support[kept],
    )


def facet_frames(
    vertices: Vertices, faces: Faces, cam_from_world: Pose
) -> Float[Tensor, "face 4 4"]:
    """Return ``patch_from_world`` of every facet: the paper's R_mu, with the centroid as origin.

    z is the inward normal; x is the reference camera's x made orthogonal to it, so a facet that
    faces the camera appears in its template as in the image.
    """
    z = -unit_face_normals(vertices, faces)
    x_cam, y_cam = cam_from_world[0, :3].expand_as(z), cam_from_world[1, :3].expand_as(z)
    # Near the camera's x axis the projection degenerates, and y is used instead.
    side = torch.where(((x_cam * z).sum(-1).abs() < 0.99)[:, None], x_cam, y_cam)
    x = normalize(side - (side * z).sum(-1, keepdim=True) * z, dim=-1)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z], dim=-2)
    centroid = vertices[faces].mean(dim=1)
    return rigid(rotation, -(rotation @ centroid[..., None])[..., 0])


def sample_spacing(
    vertices: Vertices, cameras: Cameras, reference: int, samples_per_pixel: float
) -> Scalar:
    """Return the sample spacing in scene units: 1/zeta."""
    intrinsics = cameras.intrinsics[reference]
    _, depth = project(vertices, cameras.cam_from_world[reference], intrinsics)
    focal = (intrinsics[0, 0] * intrinsics[1, 1]).sqrt()
    return depth.median() / focal / samples_per_pixel


def views_facing(vertices: Vertices, faces: Faces, cameras: Cameras) -> Int[Tensor, " face"]:
    """Return, for each facet, the number of views that it faces and that frame its centre."""
    centre, normals = vertices[faces].mean(dim=1), face_normals(vertices, faces)
    pixels, depth = project(centre[None], cameras.cam_from_world, cameras.intrinsics)
    towards = cameras.centers_world[:, None] - centre
    framed = ((pixels >= 0) & (pixels <= cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
    return (framed & ((towards * normals).sum(dim=-1) > 0)).sum(dim=0)


def enlarge(corners: Float[Tensor, "patch 3 2"], distance: Scalar) -> Float[Tensor, "patch 3 2"]:
    """Return triangles with every edge moved outward by ``distance``, parallel to itself.

    This scales the triangle about its incentre by ``1 + distance / inradius``.

    >>> enlarge(torch.tensor([[[0.0, 0], [1, 0], [0, 1]]]), torch.tensor(0.1))[0, 0]
    tensor([-0.1000, -0.1000])
    """
    opposite = (corners.roll(-1, dims=1) - corners.roll(-2, dims=1)).norm(dim=-1)
    perimeter = opposite.sum(dim=1)
    incenter = (opposite[..., None] * corners).sum(dim=1) / perimeter[:, None]
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    inradius = (ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).abs() / perimeter
    scale = 1 + distance / inradius
    return incenter[:, None] + scale[:, None, None] * (corners - incenter[:, None])


def _extents(
    corners: Float[Tensor, "patch 3 2"], enlarged: Float[Tensor, "patch 3 2"], overlap: Scalar
) -> tuple[Float[Tensor, "patch 2"], Float[Tensor, "patch 2"]]:
    """Return the lowest and highest coordinates of enlarged triangles."""
    # The enlarged corner of a sliver is far away; no patch needs more than twice the overlap.
    low = torch.maximum(enlarged.amin(dim=1), corners.amin(dim=1) - 2 * overlap)
    high = torch.minimum(enlarged.amax(dim=1), corners.amax(dim=1) + 2 * overlap)
    return low, high


def group_by_size(
    sides: Int[Tensor, "patch 2"], bucket_samples: int
) -> list[tuple[Indices, tuple[int, int]]]:
    """Batch templates of similar size.

    Args:
        sides: Width and height of each template.
        bucket_samples: Largest number of samples in a bucket of several templates.

    Returns:
        Facets and (height, width) of each bucket.
    """
    # Sizes in steps of a third of an octave: little padding, and few buckets.
    keys = (2 ** ((sides.double().log2() * 3).ceil() / 3)).ceil().long()
    groups: dict[tuple[int, int], list[int]] = {}
    for facet, (width, height) in enumerate(keys.tolist()):
        groups.setdefault((height, width), []).append(facet)
    buckets: list[tuple[Indices, tuple[int, int]]] = []
    for members in (groups[key] for key in sorted(groups)):
        facets = torch.tensor(members, device=sides.device)
        width, height = (int(side) for side in sides[facets].amax(dim=0))
        count = max(1, bucket_samples // (width * height))
        starts = range(0, len(facets), count)
        buckets += [(facets[start : start + count], (height, width)) for start in starts]
    return buckets
