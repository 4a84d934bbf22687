"""Consistency of a capture: whether cameras and mesh follow this package's conventions.

The cameras as given, and put right for every usual mistake of
:func:`~pimper_torch.camera_files.conventions.camera_mistakes`, have one score: the agreement of
true points with masks, or else of matched features with epipolar lines.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pimper_torch.camera_files.conventions import camera_mistakes, far_better
from pimper_torch.doctor.overlap import match_copies
from pimper_torch.doctor.photograph import SMALL_PX
from pimper_torch.evidence.metrics.sampling import sample_surface
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import project, rays_through
from pimper_torch.geometry.surfaces import unit_face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.io.radiance import resized
from pimper_torch.records import Cameras, Capture, Mesh, Record, Truth, Views
from pimper_torch.sfm.matching import VerifiedPair
from pimper_torch.sfm.photograph_agreement import explained

_MAX_VIEWS = 8
_MAX_POINTS = 20_000
_CELLS = 40  # along a photograph's longer side, for coverage
_GRID_PX = 120  # pixels that are looked at, along a map's longer side
# A mistake is reported where undoing it removes 40 % of the misfit and raises the score by 0.05:
# the right cameras of a solid of revolution may be a little worse than mirrored ones.
_LEFT, _MARGIN = 0.6, 0.05
_TIE = 0.02
_HOPELESS = 0.1
_NOT_RIGID = 1e-3
_WHOLE = 0.98  # a mask that covers more of the photograph is ignored
_MATCH_ERROR = 0.004  # distance from the epipolar line, a fraction of the longer side: a choice
_FACING = 0.75  # fraction of normals, a choice


@dataclass(frozen=True, slots=True, repr=False)
class Finding(Record):
    """A mistake.

    Attributes:
        name: Short, for programs.
        remedy: What to do about it.
        evidence: Scores, 1 is perfect.
        alternatives: Other mistakes with about the same scores.
    """

    name: str
    meaning: str
    remedy: str
    evidence: dict[str, float]
    alternatives: tuple[str, ...] = ()

    def __str__(self) -> str:
        figures = ", ".join(f"{what} {value:.2g}" for what, value in self.evidence.items())
        alternatives = f" Or else: {', '.join(self.alternatives)}." if self.alternatives else ""
        return f"{self.name}: {self.meaning} ({figures}). To do: {self.remedy}.{alternatives}"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CheckReport(Record):
    """The outcome of a check.

    Attributes:
        findings: Mistakes; none if all is consistent.
        tested: What was compared. A capture with nothing here could not be tested at all.
    """

    findings: tuple[Finding, ...]
    tested: tuple[str, ...]

    def __str__(self) -> str:
        if not self.findings:
            return f"no mistake found; tested: {', '.join(self.tested) or 'nothing: no data'}."
        return "the capture contradicts itself. " + " ".join(str(one) for one in self.findings)


def check_capture(capture: Capture) -> CheckReport:
    """Find mistakes in the conventions of a capture's cameras and mesh.

    Args:
        capture: Read from a data set or rendered. Up to eight positions are checked.

    Returns:
        No findings if all is consistent.
    """
    truth, given = capture.truth, capture.cameras
    if given is None:
        return CheckReport(findings=(), tested=())
    if not bool(given.intrinsics.isfinite().all() & given.cam_from_world.isfinite().all()):
        return CheckReport(findings=(_NOT_FINITE,), tested=())
    chosen = _spread(capture)
    foreground = None if truth.foreground is None else truth.foreground[chosen]
    cameras = given.take(chosen)
    name, score = _camera_score(capture.views.take(chosen), cameras, truth, foreground)
    findings = list(_not_rigid(given))
    if score is not None and not findings:
        of_cameras, cameras = _put_right(cameras, name, score)
        findings += of_cameras
    findings += _inward_mesh(truth.mesh, cameras)
    return CheckReport(findings=tuple(findings), tested=() if score is None else (name,))


_NOT_FINITE = Finding(
    "cameras_not_finite",
    "some cameras are not finite",
    "leave out the photographs without a camera",
    {},
)


def _not_rigid(cameras: Cameras) -> Iterator[Finding]:
    rotation = cameras.cam_from_world[:, :3, :3].double()
    off = float((rotation @ rotation.mT - torch.eye(3).to(rotation)).abs().max())
    if off > _NOT_RIGID:
        yield Finding(
            "not_rigid",
            "rotations are not orthogonal: scale or shear is mixed in, or the matrix is K [R | t]",
            "split the projection into K and a rotation, or divide by the scale",
            {"largest entry of R R^T - I": off},
        )
    elif bool((torch.linalg.det(rotation) < 0).any()):
        yield Finding(
            "mirrored",
            "rotations are reflections: one axis of the cameras runs the other way",
            "negate the row of cam_from_world whose axis is not x right, y down, z forward, or "
            "mirror the photographs",
            {"least determinant": float(torch.linalg.det(rotation).min())},
        )


def _camera_score(
    views: Views,
    cameras: Cameras,
    truth: Truth,
    foreground: Bool[Tensor, "view height width"] | None,
) -> tuple[str, Callable[[Cameras], float] | None]:
    """Return the score of cameras that the data allow, between 0 and 1, and its name."""
    masks = views.masks if views.masks is not None else foreground
    points = _surface_points(truth)
    if masks is not None and points is not None:
        masks = masks & views.inside
        if 0 < float(masks[views.inside].float().mean()) < _WHOLE:
            placed = points.to(cameras.intrinsics)
            return "points", lambda cameras: _points_on_masks(cameras, placed, masks)
    matches = _matches(views)
    return "features", (lambda cameras: _on_lines(cameras, matches)) if matches else None


def _put_right(
    cameras: Cameras, test: str, score: Callable[[Cameras], float]
) -> tuple[list[Finding], Cameras]:
    """Find the mistake whose undoing scores far higher; return corrected cameras."""
    mistakes = camera_mistakes(cameras)
    given = score(cameras)
    values = [score(mistake.undo(cameras)) for mistake in mistakes]
    best = far_better(given, values, _LEFT, _MARGIN)
    evidence = {f"{test}, as given": given}
    if best is not None:
        found, evidence = mistakes[best], {**evidence, f"{test}, set right": values[best]}
        close = [
            one.name
            for one, value in zip(mistakes, values, strict=True)
            if value > values[best] - _TIE and one is not found
        ]
        finding = Finding(found.name, found.meaning, found.remedy, evidence, tuple(close))
        return [finding], found.undo(cameras)
    if given >= _HOPELESS:
        return [], cameras
    finding = Finding(
        "cameras_unexplained",
        "cameras and photographs do not belong together, and no common mistake explains it",
        "check that names, order, units and the world frame are those of this set",
        evidence,
    )
    return [finding], cameras


def _points_on_masks(
    cameras: Cameras,
    points_world: Float[Tensor, "point 3"],
    masks: Bool[Tensor, "view height width"],
) -> float:
    """Return the fraction of points on the masks times that of mask cells that hold a point."""
    fractions = []
    for view, (mask, size) in enumerate(zip(masks, cameras.sizes_px, strict=True)):
        pixels, depth = project(
            points_world, cameras.cam_from_world[view], cameras.intrinsics[view]
        )
        inside = (depth > 0) & (pixels >= 0).all(dim=1) & (pixels < size).all(dim=1)
        pixels, cell = pixels[inside], ceil(int(size.max()) / _CELLS)
        on = pixels[_at(mask, pixels)]
        drawn = mask[cell // 2 :: cell, cell // 2 :: cell]
        holds = torch.zeros(_CELLS + 1, _CELLS + 1, dtype=torch.bool)
        holds[*(on.long().flip(1) // cell).T] = True
        covered = holds[: drawn.shape[0], : drawn.shape[1]] & drawn
        fractions.append(
            len(on) / len(points_world) * float(covered.sum()) / max(1, int(drawn.sum()))
        )
    return float(np.mean(fractions))


def _matches(views: Views) -> list[VerifiedPair]:
    """Match features of small copies; pixels of the photographs."""
    copies, scales = [], []
    for image, (width, height) in zip(views.images, views.sizes_px.tolist(), strict=True):
        factor = min(1.0, SMALL_PX / max(width, height))
        wide, high = max(1, round(width * factor)), max(1, round(height * factor))
        copies.append(resized(image[:, :height, :width], wide, high).mean(dim=0).cpu())
        scales.append(torch.tensor([width / wide, height / high], dtype=torch.float64))
    return [
        pair.replace(
            first=pair.first * scales[pair.views[0]], second=pair.second * scales[pair.views[1]]
        )
        for pair in match_copies(copies)
    ]


def _on_lines(cameras: Cameras, matches: list[VerifiedPair]) -> float:
    """Return the fraction of matches near their epipolar lines and in front of both cameras."""
    precise = cameras.to(torch.float64)
    error_px = _MATCH_ERROR * float(cameras.sizes_px.max())
    agree = sum(int(explained(precise, pair, error_px).sum()) for pair in matches)
    return agree / sum(pair.num_matches for pair in matches)


def _inward_mesh(mesh: Mesh | None, cameras: Cameras) -> Iterator[Finding]:
    """Find a mesh whose faces or vertex normals point away from the cameras that see it."""
    if mesh is None or len(mesh.faces) == 0:
        return
    caster, faces, vertices = RayCaster(mesh.vertices_world, mesh.faces), [], []
    normals = unit_face_normals(mesh.vertices_world, mesh.faces)
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        step = ceil(max(width, height) / _GRID_PX)
        centers = pixel_centers(width, height, like=cameras.intrinsics)
        pixels = centers[step // 2 :: step, step // 2 :: step].reshape(-1, 2)
        rays = rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])
        hits = caster.cast(cameras.centers_world[view], rays)
        hit = hits.face >= 0
        faces.append((normals[hits.face[hit]].to(rays) * rays[hit]).sum(dim=1) < 0)
        if mesh.normals_world is not None:
            smooth = hits.interpolate(mesh.normals_world.to(rays), mesh.faces)[hit]
            vertices.append((smooth * rays[hit]).sum(dim=1) < 0)
    of_faces = (
        "mesh_inside_out",
        "the mesh's faces are clockwise seen from outside",
        "exchange two corners of every face",
    )
    of_vertices = "mesh_normals_inward", "the mesh's vertex normals point inward", "negate them"
    for facing, mistake in ((faces, of_faces), (vertices, of_vertices)):
        fraction = float(torch.cat(facing).float().mean()) if facing else 1.0
        if fraction < 1 - _FACING:
            yield Finding(*mistake, {"fraction facing": fraction})


def _at(
    values: Shaped[Tensor, "height width *channel"], pixels: Float[Tensor, "pixel 2"]
) -> Shaped[Tensor, "..."]:
    column, row = pixels.long().unbind(dim=1)
    return values[row, column]


def _spread(capture: Capture) -> list[int]:
    """Choose views of different positions, in pairs of successive ones that share most."""
    positions = capture.position.tolist()
    views = sorted(positions.index(position) for position in set(positions))
    if len(views) <= _MAX_VIEWS:
        return views
    starts = np.linspace(0, len(views) - 2, _MAX_VIEWS // 2).round().astype(int)
    return [views[index] for start in starts for index in (start, start + 1)]


def _surface_points(truth: Truth) -> Float[Tensor, "point 3"] | None:
    """Draw points of the true mesh or cloud; ``None`` without either."""
    mesh = truth.mesh
    if mesh is None and truth.points_world is not None:
        mesh = Mesh(vertices_world=truth.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    if mesh is None or len(mesh.vertices_world) == 0:
        return None
    return sample_surface(mesh, _MAX_POINTS, torch.Generator().manual_seed(0)).points
