"""Everything that is compared along the rays of one view: shape, normals, albedo."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import InputError
from pimper_torch.evidence.metrics.pits import pitted_percent
from pimper_torch.evidence.metrics.reflectance import AlbedoFigures, compare_albedo
from pimper_torch.evidence.metrics.relative import Meeting, angles_deg, meet_in_view, relative_error
from pimper_torch.evidence.metrics.surroundings import without_surroundings
from pimper_torch.evidence.metrics.visible import joined
from pimper_torch.geometry.frames import rotate
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.geometry.visibility import cast_view
from pimper_torch.records import Capture, Mesh, Record


@dataclass(frozen=True, slots=True, kw_only=True)
class AngleFigures(Record):
    """Angles between normals over the rays that meet both, in degrees.

    Attributes:
        pitted_percent: See :func:`pimper_torch.evidence.metrics.pits.pitted_percent`.
    """

    mean_deg: float
    median_deg: float
    pitted_percent: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewFigures(Record):
    """How a mesh compares with the truth along the rays of one true camera.

    Attributes:
        relative_error: :func:`pimper_torch.evidence.metrics.relative.relative_error`, per cent.
        coverage: Fraction of the true pixels whose ray meets the mesh, and not where it shows
            the surroundings; the other figures are over these.
        transferred_normals: Of the normals that the mesh carries at its vertices; ``None`` if it
            carries none or the true ones are unknown.
        shape_normals: Of the normals of its shape: its faces', averaged at the vertices by
            area and blended between them.
        albedo: ``None`` where either side has none.
    """

    name: str
    relative_error: float
    coverage: float
    pixels: int
    transferred_normals: AngleFigures | None
    shape_normals: AngleFigures | None
    albedo: AlbedoFigures | None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class TrueMaps(Record):
    """What is known along the rays of one view.

    Attributes:
        depth: Along z; infinite where nothing is known.
        normals_world: Unit; zero where nothing is known.
    """

    depth: Float[Tensor, "height width"]
    normals_world: Float[Tensor, "height width 3"] | None
    where: Bool[Tensor, "height width"] | None


def compare_along_rays(
    mesh: Mesh, truth_from_world: Float[Tensor, "4 4"], capture: Capture, view: int
) -> ViewFigures | None:
    """Compare a mesh with the truth in one view, over the rays of :func:`meet_truth`.

    Returns:
        ``None`` where the truth has neither depth maps nor a mesh, or no cameras.

    Raises:
        InputError: No ray meets both.
    """
    met = meet_truth(mesh, truth_from_world, capture, view)
    if met is None:
        return None
    return figures_of(met, mesh, truth_from_world, capture, view)


def meet_truth(
    mesh: Mesh, truth_from_world: Float[Tensor, "4 4"], capture: Capture, view: int
) -> Meeting | None:
    """Cast the rays of a true view on a mesh.

    The truth is what its maps hold; where it has no depth map, its mesh is ray cast. It is
    compared on the object alone where that is known: the truth's foreground, else
    the masks of the photographs. Rays that pass the object and meet the mesh on the truth's
    surroundings are misses.

    Returns:
        ``None`` where the truth has neither depth maps nor a mesh, or no cameras.
    """
    cameras, maps = capture.cameras, true_maps(capture, view)
    if cameras is None or maps is None or len(mesh.faces) == 0:
        return None
    met = meet_in_view(mesh, truth_from_world, cameras, view, maps.depth, maps.where)
    met = without_surroundings(met, capture.truth)
    if not met.both.any():
        raise InputError(
            f"view {capture.views.names[view]}: where rays through the object meet the mesh, it "
            "lies on the surroundings. Check that the mesh holds the object."
        )
    return met


def figures_of(
    met: Meeting,
    mesh: Mesh,
    truth_from_world: Float[Tensor, "4 4"],
    capture: Capture,
    view: int,
) -> ViewFigures:
    """Compare a mesh with the truth over rays that meet both, all or some; at least one."""
    maps = true_maps(capture, view)
    assert maps is not None  # it was met
    shape = vertex_normals(mesh.vertices_world, mesh.faces)
    albedo = None
    if mesh.albedo is not None and capture.truth.albedo is not None:
        albedo = compare_albedo(met.interpolate(mesh.albedo), capture.truth.albedo[view][met.both])
    return ViewFigures(
        name=capture.views.names[view],
        relative_error=float(relative_error(met.points.double(), met.points_true.double())),
        coverage=met.coverage,
        pixels=int(met.valid.sum()),
        transferred_normals=_angles(met, mesh.normals_world, truth_from_world, maps),
        shape_normals=_angles(met, shape, truth_from_world, maps),
        albedo=albedo,
    )


def true_maps(capture: Capture, view: int) -> TrueMaps | None:
    """Return depth and normals of a view, from the truth's maps or by casting its mesh."""
    truth, cameras = capture.truth, capture.cameras
    where = None
    if truth.foreground is not None:
        where = truth.foreground[view]
    elif capture.views.masks is not None:
        where = capture.views.masks[view]
    if truth.depth is not None:
        normals = None if truth.normals_world is None else truth.normals_world[view]
        return TrueMaps(depth=truth.depth[view], normals_world=normals, where=where)
    if truth.mesh is None or len(truth.mesh.faces) == 0 or cameras is None:
        return None
    whole = joined(truth.mesh, truth.surroundings)
    hits = cast_view(whole, cameras, view)
    return TrueMaps(
        depth=hits.distance,
        normals_world=hits.interpolate(
            vertex_normals(whole.vertices_world, whole.faces), whole.faces
        ),
        where=(hits.face >= 0) & (hits.face < len(truth.mesh.faces)),
    )


def _angles(
    met: Meeting,
    normals: Float[Tensor, "vertex 3"] | None,
    truth_from_world: Float[Tensor, "4 4"],
    maps: TrueMaps,
) -> AngleFigures | None:
    if normals is None or maps.normals_world is None:
        return None
    ours = met.interpolate(rotate(truth_from_world.to(normals), normals)).double()
    truth = maps.normals_world[met.both].double()
    known = (truth.norm(dim=1) > 0) & (ours.norm(dim=1) > 0)
    if not bool(known.any()):
        return None
    angles = angles_deg(normalize(ours[known], dim=1), normalize(truth[known], dim=1))
    where = met.both.clone()
    where[met.both] = known
    spread = torch.zeros(where.shape, dtype=angles.dtype, device=angles.device)
    spread[where] = angles
    return AngleFigures(
        mean_deg=float(angles.mean()),
        median_deg=float(angles.median()),
        pitted_percent=pitted_percent(spread, where),
    )
