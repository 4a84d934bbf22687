"""One template for the whole surface: a raster over all that the reference view sees.

The baselines that factorize the whole object as one matrix need one raster instead of one a
facet. It is orthographic and faces the reference camera: x and y as in its image, z along the
line from the camera to the centre of the mesh, so that slopes, integration and registration
are those of the facets' templates. Samples that one another hide are not there twice: each
ray along z keeps its first hit, as in a z-buffer.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import ReconstructionError
from pimper_torch.geometry.frames import invert_rigid, rigid, rotate, transform
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.meshing.extract import large_components
from pimper_torch.paper.filling import fill_smoothly
from pimper_torch.patches.decompose import sample_spacing
from pimper_torch.patches.warp import Warp, WarpConfig
from pimper_torch.progress import track
from pimper_torch.records import Cameras, CoarseMesh, Mesh, PatchSet, Record, Templates, Views

# Samples a side of the pieces that are looked up at a time: bounds memory, and pieces beside
# the object cost nothing.
TILE = 256

# A step of depth between neighbouring samples steeper than this (85 degrees) is a cliff.
CLIFF_SLOPE = 11.4


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Template(Record):
    """The raster, in its own frame: x right, y down, z away from the viewer.

    Attributes:
        template_from_world: Rigid.
        origin: x and y of the first sample's centre.
        spacing: Scene units between neighbouring samples.
        depth: z of the mesh under every sample; filled in smoothly beside the mesh.
        normals: Of the mesh, blended between its vertices, unit; zero beside the mesh.
        inside: True where the ray along z meets the mesh.
    """

    template_from_world: Float[Tensor, "4 4"]
    origin: Float[Tensor, " 2"]
    spacing: Float[Tensor, ""]
    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]
    inside: Bool[Tensor, "height width"]

    def points(self, depth: Float[Tensor, "height width"]) -> Float[Tensor, "height width 3"]:
        """Return the samples' positions at some depth, template frame."""
        height, width = depth.shape
        xy = self.origin + self.spacing * (pixel_centers(width, height, like=depth) - 0.5)
        return torch.cat([xy, depth[..., None]], dim=-1)

    def to_world(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Transform points from the template's frame to the world."""
        rows = transform(invert_rigid(self.template_from_world), points.reshape(-1, 3))
        return rows.reshape(points.shape)


def lay_template(
    mesh: Mesh, cameras: Cameras, reference: int, samples_per_pixel: float
) -> Template:
    """Lay a raster over what the reference view sees of a mesh.

    Args:
        mesh: Its own vertex normals are blended if it has some.
        reference: The one that the raster faces.
        samples_per_pixel: Samples per pixel of the reference view, at the median depth of
            the mesh.

    Raises:
        ReconstructionError: The mesh shows the reference camera no face.
    """
    vertices, faces = mesh.vertices_world, mesh.faces
    template_from_world = _frame(vertices, cameras, reference)
    spacing = sample_spacing(vertices, cameras, reference, samples_per_pixel)
    placed = transform(template_from_world, vertices)
    low, high = placed.amin(dim=0), placed.amax(dim=0)
    width, height = (((high - low)[:2] / spacing).ceil().long() + 2).tolist()
    start = (low[2] - (high - low).norm()).expand(height, width)
    blank = Template(
        template_from_world=template_from_world,
        origin=low[:2] - spacing / 2,
        spacing=spacing,
        depth=start,
        normals=start.new_zeros(height, width, 3),
        inside=torch.zeros_like(start, dtype=torch.bool),
    )
    caster = RayCaster(placed, faces)
    along = torch.zeros_like(blank.normals)
    along[..., 2] = 1
    hits = caster.cast(blank.points(start), along)
    own = mesh.normals_world
    if own is None:
        own = vertex_normals(vertices, faces)
    normals = normalize(hits.interpolate(rotate(template_from_world, own), faces), dim=-1)
    inside = (hits.face >= 0) & (normals[..., 2] < 0)
    if not inside.any():
        raise ReconstructionError(
            f"the mesh of {len(faces)} faces shows none of them to its reference view; at least "
            "one is needed. Turn the mesh's faces outward, or choose another "
            "`triangulate.reference`."
        )
    depth = torch.where(inside, start + hits.distance, 0)
    filled = fill_smoothly(depth[None, None], inside[None].to(depth))[0, 0]
    return blank.replace(
        depth=torch.where(inside, depth, filled),
        normals=torch.where(inside[..., None], normals, 0),
        inside=inside,
    )


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Matrix(Record):
    """All views, registered on the template: J and D of the whole object at once.

    A sample of the template that is ``inside`` is a column, in the raster's order.

    Attributes:
        radiance: ``J``, gray; zero where missing.
        seen: ``D``.
        normals: Of the mesh, template frame.
    """

    radiance: Float[Tensor, "view sample"]
    seen: Bool[Tensor, "view sample"]
    normals: Float[Tensor, "sample 3"]

    @property
    def missing_fraction(self) -> float:
        """How much of J is missing."""
        return 1 - float(self.seen.sum(dtype=torch.int64)) / self.seen.numel()

    def columns(self, samples: slice | Int[Tensor, " chosen"]) -> "Matrix":
        """Keep some samples."""
        return Matrix(
            radiance=self.radiance[:, samples],
            seen=self.seen[:, samples],
            normals=self.normals[samples],
        )


def register(
    template: Template, views: Views, cameras: Cameras, occluder: Mesh, config: WarpConfig
) -> Matrix:
    """Resample all views on the template, one at a time.

    Args:
        occluder: What may hide samples from a view; the template's mesh, or a coarser one.
        config: Which samples a view may contribute; the tilt is that of the mesh's normals.

    Raises:
        ReconstructionError: No view has any sample.
    """
    radiance, seen = [], []
    for colours, visible in registered_views(template, views, cameras, occluder, config):
        radiance.append(colours.mean(dim=0))
        seen.append(visible)
    matrix = Matrix(
        radiance=torch.stack(radiance),
        seen=torch.stack(seen),
        normals=template.normals[template.inside],
    )
    if not matrix.seen.any():
        raise ReconstructionError(
            f"none of the {views.num_views} views has any of the template's "
            f"{matrix.seen.shape[1]} samples, inside its frame and mask, lit and not saturated. "
            "Check that cameras, photographs and masks belong together."
        )
    return matrix


def registered_views(
    template: Template, views: Views, cameras: Cameras, occluder: Mesh, config: WarpConfig
) -> Iterator[tuple[Float[Tensor, "channel sample"], Bool[Tensor, " sample"]]]:
    """Return the radiance of the template's samples in every view in turn, and which are seen."""
    # The raster's plane is independent of the tilt of the surface.
    warp = Warp(dataclasses.replace(config, max_tilt_deg=89.9))
    tiles = _tiles(template)
    coarse = CoarseMesh(
        mesh=occluder, reference=0, is_point=occluder.vertices_world.new_zeros(0) > 0
    )
    patches = PatchSet(coarse=coarse, buckets=tuple(tile for tile, _, _ in tiles))
    points = template.to_world(template.points(template.depth)[template.inside])
    normals = template.normals[template.inside] @ template.template_from_world[:3, :3]
    steepest = torch.deg2rad(points.new_tensor(config.max_tilt_deg)).cos()
    for view in track(range(views.num_views)):
        found = warp(views.take([view]), cameras.take([view]), patches)
        channels = views.images.shape[1]
        radiance = points.new_zeros(channels, *template.depth.shape)
        valid = torch.zeros_like(template.inside)
        for (_, rows, columns), seen in zip(tiles, found.buckets, strict=True):
            radiance[:, rows, columns] = seen.radiance[0, 0].to(radiance)
            valid[rows, columns] = seen.valid[0, 0]
        facing = (normalize(cameras.centers_world[view] - points, dim=-1) * normals).sum(dim=-1)
        visible = valid[template.inside] & (facing > steepest)
        yield torch.where(visible, radiance[:, template.inside], 0), visible


def fit_colours(
    seen: Iterator[tuple[Float[Tensor, "channel sample"], Bool[Tensor, " sample"]]],
    lights: Float[Tensor, "view light"],
    basis: Float[Tensor, "sample light"],
) -> Float[Tensor, "sample channel"]:
    """Fit every channel's albedo to all views, shading given; zero where nothing is lit.

    Args:
        seen: See :func:`registered_views`; one view is in memory at a time.
        basis: What the lights are linear in, ``(1, n)`` or ``n``; shading below zero is none.
    """
    product: Tensor | None = None
    square = torch.zeros_like(basis[:, 0])
    for light, (colours, visible) in zip(lights, seen, strict=True):
        shading = (basis @ light).clamp_min(0) * visible
        square = square + shading**2
        term = shading * colours
        product = term if product is None else product + term
    assert product is not None, "a scene without views"
    some = square > torch.finfo(square.dtype).tiny ** 0.5
    return torch.where(some, product / torch.where(some, square, 1), 0).clamp_min(0).mT


def on_template(
    rows: Shaped[Tensor, "sample ..."],
    inside: Bool[Tensor, "height width"],
) -> Shaped[Tensor, "height width ..."]:
    """Scatter samples to the raster, zero beside the mesh."""
    raster = rows.new_zeros(*inside.shape, *rows.shape[1:])
    raster[inside] = rows
    return raster


def surface_of(
    template: Template,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "sample 3"],
    albedo: Float[Tensor, "sample channel"] | None = None,
    confidence: Float[Tensor, " sample"] | None = None,
) -> Mesh:
    """Triangulate the raster at a depth, one vertex a sample inside.

    Cliffs are left open, and the largest connected piece is kept.

    Args:
        template: Whose samples the vertices are.
        depth: Template frame.
        normals: Unit, template frame, of the samples inside.
        albedo: Of the samples inside.

    Raises:
        ReconstructionError: No triangle is left.
    """
    faces = raster_faces(template.inside, depth, float(CLIFF_SLOPE * template.spacing))
    if len(faces) == 0:
        raise ReconstructionError(
            f"of {int(template.inside.sum())} samples no three neighbours lie on one surface; "
            "at least one triangle is needed. Look at the coarse mesh, or sample more finely."
        )
    rows = template.points(depth)[template.inside]
    faces = faces[large_components(rows, faces, 1.0)]
    used, faces = torch.unique(faces, return_inverse=True)
    return Mesh(
        vertices_world=template.to_world(rows[used]),
        faces=faces,
        normals_world=normals[used] @ template.template_from_world[:3, :3],
        albedo=None if albedo is None else albedo[used],
        confidence=None if confidence is None else confidence[used],
    )


def raster_faces(
    inside: Bool[Tensor, "height width"], depth: Float[Tensor, "height width"], cliff: float
) -> Int[Tensor, "face 3"]:
    """Split the cells of a raster into triangles that face the viewer.

    Args:
        inside: Samples that are vertices; a triangle needs three.
        cliff: Greatest difference of depth between two corners.

    Returns:
        Indices that count samples ``inside`` row by row.
    """
    number = (inside.flatten().cumsum(dim=0) - 1).reshape(inside.shape)
    corners = [(slice(None, -1), slice(None, -1)), (slice(None, -1), slice(1, None))]
    corners += [(slice(1, None), slice(None, -1)), (slice(1, None), slice(1, None))]
    # y points down and z away: right before down would face away from the viewer.
    faces = []
    for three in ((0, 2, 1), (1, 2, 3)):
        positions = [corners[position] for position in three]
        deep = torch.stack([depth[position] for position in positions])
        whole = torch.stack([inside[position] for position in positions]).all(dim=0)
        keep = whole & (deep.amax(dim=0) - deep.amin(dim=0) <= cliff)
        faces.append(torch.stack([number[position][keep] for position in positions], dim=1))
    return torch.cat(faces)


def _frame(
    vertices: Float[Tensor, "vertex 3"], cameras: Cameras, reference: int
) -> Float[Tensor, "4 4"]:
    centre = (vertices.amax(dim=0) + vertices.amin(dim=0)) / 2
    z = normalize(centre - cameras.centers_world[reference], dim=0)
    x_cam = cameras.cam_from_world[reference, 0, :3]
    x = normalize(x_cam - (x_cam @ z) * z, dim=0)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    return rigid(rotation, -(rotation @ centre))


def _tiles(template: Template) -> list[tuple[Templates, slice, slice]]:
    """Split the raster into small templates of one patch each, without empty ones.

    Their facet and barycentric coordinates mean nothing.
    """
    height, width = template.depth.shape
    tiles = []
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            # A tile one sample wide has no spacing of samples in a view.
            rows = slice(max(min(top, height - 2), 0), min(top + TILE, height))
            columns = slice(max(min(left, width - 2), 0), min(left + TILE, width))
            inside = template.inside[rows, columns]
            if not inside.any():
                continue
            depth = template.depth[rows, columns]
            first = template.origin.new_tensor([columns.start, rows.start])
            tile = Templates(
                facet=torch.zeros(1, dtype=torch.long, device=depth.device),
                patch_from_world=template.template_from_world[None],
                origin=(template.origin + template.spacing * first)[None],
                spacing=template.spacing[None],
                depth=depth[None],
                barycentric=depth.new_zeros(1, *depth.shape, 3),
                inside=inside[None],
            )
            tiles.append((tile, rows, columns))
    return tiles
