"""Consistency of a capture: whether cameras, normals and mesh follow this package's conventions.

The cameras as given, and put right for every usual mistake of
:func:`~pimper_torch.camera_files.conventions.camera_mistakes`, have one score: the mean agreement
with true points on the masks, with depth maps of neighbouring views and with matched features, as
far as the capture has them. Normals are compared with the mesh, or have to face the camera.
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations
from math import ceil

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from pimper_torch.camera_files.conventions import camera_mistakes
from pimper_torch.doctor.overlap import match_copies
from pimper_torch.doctor.photograph import SMALL_PX
from pimper_torch.errors import InputError, PimperWarning
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
# A mistake is reported where undoing it removes 40 % of the misfit and raises the mean score
# by 0.05: the right cameras of a solid of revolution may be a little worse than mirrored ones.
_LEFT, _MARGIN = 0.6, 0.05
_TIE = 0.02
_HOPELESS = 0.1
_NOT_RIGID = 1e-3
_WHOLE = 0.98  # a mask that covers more of the photograph is ignored
_MATCH_ERROR = 0.004  # distance from the epipolar line, a fraction of the longer side: a choice
# Right normals agree with those of a mesh to a mean cosine above 0.95, and no hypothesis halves the
# rest; mirrored ones reach 0.9 where a surface is rather flat.
_LEFT_OF_NORMALS, _BETTER_COSINE = 0.5, 0.03
_FACING, _ALL_FACING = 0.75, 0.95  # fractions of normals, choices


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Finding(Record):
    """A mistake.

    Attributes:
        name: Short, for programs.
        meaning: What is wrong.
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
    """Find mistakes in the conventions of a capture's cameras, normals and mesh.

    Args:
        capture: Read from a data set or rendered. Up to eight positions are checked.

    Returns:
        No findings if all is consistent.
    """
    chosen = _spread(capture)
    views, truth = capture.views.take(chosen), _taken(capture.truth, chosen)
    if capture.cameras is None:
        normals = list(_normals(truth, None))
        return CheckReport(findings=tuple(normals), tested=_tested_normals(truth))
    cameras = capture.cameras.take(chosen)
    if not bool(cameras.intrinsics.isfinite().all() & cameras.cam_from_world.isfinite().all()):
        return CheckReport(findings=(_NOT_FINITE,), tested=())
    scores = _camera_scores(views, cameras, truth)
    of_cameras, cameras = _put_right(cameras, scores)
    findings = [*_not_rigid(capture.cameras), *of_cameras]
    findings += [*_inward_mesh(truth.mesh, cameras), *_normals(truth, cameras)]
    return CheckReport(findings=tuple(findings), tested=(*scores, *_tested_normals(truth)))


def require_consistent(capture: Capture, *, warn: bool = False) -> None:
    """Refuse a capture in which :func:`check_capture` finds a mistake.

    Args:
        capture: To check.
        warn: Give a :class:`~pimper_torch.errors.PimperWarning` instead.

    Raises:
        InputError: Names the mistakes with their scores and what to do.
    """
    report = check_capture(capture)
    if not report.findings:
        return
    if not warn:
        raise InputError(str(report))
    warnings.warn(PimperWarning(str(report)), stacklevel=2)


_NOT_FINITE = Finding(
    name="cameras_not_finite",
    meaning="some cameras are not finite",
    remedy="leave out the photographs without a camera",
    evidence={},
)


def _not_rigid(cameras: Cameras) -> Iterator[Finding]:
    rotation = cameras.cam_from_world[:, :3, :3].double()
    off = float((rotation @ rotation.mT - torch.eye(3).to(rotation)).abs().max())
    if off > _NOT_RIGID:
        yield Finding(
            name="not_rigid",
            meaning="rotations are not orthogonal: scale or shear is mixed in, or the matrix is "
            "K [R | t]",
            remedy="split the projection into K and a rotation, or divide by the scale",
            evidence={"largest entry of R R^T - I": off},
        )


def _camera_scores(
    views: Views, cameras: Cameras, truth: Truth
) -> dict[str, Callable[[Cameras], float]]:
    """List the scores of cameras that the data allow, each between 0 and 1."""
    scores: dict[str, Callable[[Cameras], float]] = {}
    masks = views.masks if views.masks is not None else truth.foreground
    if masks is not None:
        drawn = float(masks[views.inside].float().mean())
        masks = masks & views.inside if 0 < drawn < _WHOLE else None
    points, depth = _surface_points(truth), truth.depth
    if points is not None:
        points = points.to(cameras.intrinsics)
        scores["points"] = lambda cameras: _points_in_sight(cameras, points, masks)
    if depth is not None and cameras.num_views > 1:
        scores["depth"] = lambda cameras: _depth_agreement(cameras, depth)
    elif cameras.num_views > 1 and (masks is None or not scores):
        matches = _matches(views)
        if matches:
            scores["features"] = lambda cameras: _epipolar_agreement(cameras, matches)
    return scores


def _put_right(
    cameras: Cameras, scores: dict[str, Callable[[Cameras], float]]
) -> tuple[list[Finding], Cameras]:
    """Find the mistake whose undoing scores significantly higher; return corrected cameras."""
    if not scores:
        return [], cameras
    mistakes = camera_mistakes(cameras)
    candidates = [cameras, *(mistake.undo(cameras) for mistake in mistakes)]
    values = {test: [score(one) for one in candidates] for test, score in scores.items()}
    total = np.mean(list(values.values()), axis=0)
    best, given = int(total.argmax()), float(total[0])
    if 1 - total[best] < _LEFT * (1 - given) and total[best] > given + _MARGIN:
        mistake = mistakes[best - 1]
        evidence = {f"{test}, as given": each[0] for test, each in values.items()}
        evidence |= {f"{test}, set right": each[best] for test, each in values.items()}
        close = [
            one.name
            for one, value in zip(mistakes, total[1:], strict=True)
            if value > total[best] - _TIE and one is not mistake
        ]
        finding = Finding(
            name=mistake.name,
            meaning=mistake.meaning,
            remedy=mistake.remedy,
            evidence=evidence,
            alternatives=tuple(close),
        )
        return [finding], candidates[best]
    if max(each[0] for each in values.values()) >= _HOPELESS:
        return [], cameras
    finding = Finding(
        name="cameras_unexplained",
        meaning="cameras and photographs do not belong together, and no common mistake explains it",
        remedy="check that names, order, units and the world frame are those of this set",
        evidence={test: each[0] for test, each in values.items()},
    )
    return [finding], cameras


def _points_in_sight(
    cameras: Cameras,
    points_world: Float[Tensor, "point 3"],
    masks: Bool[Tensor, "view height width"] | None,
) -> float:
    """Return the fraction of surface points inside the photographs, or on the masks.

    With masks it is multiplied by the fraction of the masks' cells that contain a point. The mean
    of the views.
    """
    fractions = []
    for view in range(cameras.num_views):
        inside, pixels, _ = _inside(cameras, view, points_world)
        if masks is None:
            fractions.append(float(inside.float().mean()))
            continue
        mask, cell = masks[view], ceil(int(cameras.sizes_px[view].max()) / _CELLS)
        on = pixels[_at(mask, pixels)]
        drawn = mask[cell // 2 :: cell, cell // 2 :: cell]
        holds = torch.zeros(_CELLS + 1, _CELLS + 1, dtype=torch.bool)
        holds[*(on.long().flip(1) // cell).T] = True
        covered = holds[: drawn.shape[0], : drawn.shape[1]] & drawn
        fractions.append(
            len(on) / len(points_world) * float(covered.sum()) / max(1, int(drawn.sum()))
        )
    return float(np.mean(fractions))


def _depth_agreement(cameras: Cameras, depth: Float[Tensor, "view height width"]) -> float:
    """Return the fraction of a view's depth map that agrees with its neighbour's.

    A point agrees when its depth in the other camera differs from the map's there by less than
    3 % of the map's range; points outside the image, on the background or occluded do not.
    """
    fractions = []
    for one, other in _neighbours(cameras.num_views):
        pixels = _grid(cameras, one)
        reach, far = _at(depth[one], pixels), depth[other][depth[other].isfinite()]
        known = reach.isfinite()
        if not bool(known.any()) or len(far) == 0:
            continue
        rays = _rays(cameras, one, pixels[known])
        points = cameras.centers_world[one] + reach[known, None].to(rays) * rays
        _, pixels, z = _inside(cameras, other, points)
        tolerance = 0.03 * float(far.max() - far.min()) + 1e-3 * float(far.mean())
        agree = (_at(depth[other], pixels) - z).abs() < tolerance
        fractions.append(float(agree.sum()) / len(points))
    return float(np.mean(fractions)) if fractions else 0.0


def _matches(views: Views) -> list[VerifiedPair]:
    """Match features of small copies; pixels of the photographs."""
    copies, scales = [], []
    for image, (width, height) in zip(views.images, views.sizes_px.tolist(), strict=True):
        factor = min(1.0, SMALL_PX / max(width, height))
        wide, high = max(1, round(width * factor)), max(1, round(height * factor))
        copies.append(resized(image[:, :height, :width], wide, high).mean(dim=0).cpu())
        scales.append(torch.tensor([width / wide, height / high], dtype=torch.float64))
    return [
        VerifiedPair(
            views=(one, other), first=match.first * scales[one], second=match.second * scales[other]
        )
        for match in match_copies(copies)
        for one, other in [match.pair.tolist()]
    ]


def _epipolar_agreement(cameras: Cameras, matches: list[VerifiedPair]) -> float:
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
        rays = _rays(cameras, view, _grid(cameras, view))
        hits = caster.cast(cameras.centers_world[view], rays)
        hit = hits.face >= 0
        faces.append((normals[hits.face[hit]].to(rays) * rays[hit]).sum(dim=1) < 0)
        if mesh.normals_world is not None:
            smooth = hits.interpolate(mesh.normals_world.to(rays), mesh.faces)[hit]
            vertices.append((smooth * rays[hit]).sum(dim=1) < 0)
    for facing, name, meaning, remedy in (
        (
            faces,
            "mesh_inside_out",
            "the mesh's faces are clockwise seen from outside",
            "exchange two corners of every face",
        ),
        (vertices, "mesh_normals_inward", "the mesh's vertex normals point inward", "negate them"),
    ):
        fraction = float(torch.cat(facing).float().mean()) if facing else 1.0
        if fraction < 1 - _FACING:
            evidence = {"fraction facing": fraction}
            yield Finding(name=name, meaning=meaning, remedy=remedy, evidence=evidence)


# Mistakes of normal maps: name, meaning, remedy, signs of the axes in the camera's frame, and
# whether the vectors are in it.
_NORMAL_MISTAKES = (
    ("negated", "they point the other way", "negate them", (-1, -1, -1), False),
    (
        "in_camera_frame",
        "they are in each camera's frame",
        "turn them into the world: R^T n for cam_from_world's rotation R",
        (1, 1, 1),
        True,
    ),
    (
        "in_camera_frame_y_up",
        "they are in each camera's frame with y up and z towards the viewer",
        "negate y and z, then turn them into the world: R^T diag(1, -1, -1) n",
        (1, -1, -1),
        True,
    ),
    (
        "y_flipped",
        "their y component is up in the camera's frame, where ours is down",
        "negate y in the camera's frame before turning them into the world",
        (1, -1, 1),
        False,
    ),
    (
        "x_flipped",
        "their x component is negated in the camera's frame",
        "negate x in the camera's frame before turning them into the world",
        (-1, 1, 1),
        False,
    ),
)


def _tested_normals(truth: Truth) -> tuple[str, ...]:
    return () if truth.normals_world is None else ("normals",)


def _normals(truth: Truth, cameras: Cameras | None) -> Iterator[Finding]:
    """Find normal maps that contradict the mesh, or without one do not face the camera.

    Facing alone does not distinguish mirrored normals, and the first of equal mistakes is named.
    """
    maps, mesh, caster, flat = truth.normals_world, truth.mesh, None, None
    if maps is None:
        return
    if cameras is not None and mesh is not None and len(mesh.faces):
        caster = RayCaster(mesh.vertices_world, mesh.faces)
        flat = unit_face_normals(mesh.vertices_world, mesh.faces)
    samples = [_normal_samples(maps, caster, flat, cameras, view) for view in range(len(maps))]

    def score(signs: tuple[int, int, int], in_camera_frame: bool) -> float:
        cosines = []
        for normals, expected, rotation in samples:
            vectors = normals if in_camera_frame else normals @ rotation.mT
            vectors = (vectors * vectors.new_tensor(signs)) @ rotation
            cosine = (vectors * expected).sum(dim=1)
            cosines.append(cosine.clamp_min(0) if caster else (cosine > 0).to(cosine))
        every = torch.cat(cosines)
        return float(every.mean()) if len(every) else 1.0

    given = score((1, 1, 1), False)
    mistakes = _NORMAL_MISTAKES if caster else _NORMAL_MISTAKES[:3]
    values = [score(signs, in_camera) for *_, signs, in_camera in mistakes]
    best = int(np.argmax(values))
    if caster:
        halved = 1 - values[best] < _LEFT_OF_NORMALS * (1 - given)
        wrong = halved and values[best] > given + _BETTER_COSINE
    else:
        wrong = given < _FACING and values[best] > _ALL_FACING
    if not wrong:
        return
    name, meaning, remedy, *_ = mistakes[best]
    close = [
        one[0]
        for one, value in zip(mistakes, values, strict=True)
        if value > values[best] - _TIE and one[0] != name
    ]
    yield Finding(
        name=f"normals_{name}",
        meaning=f"the normals: {meaning}",
        remedy=remedy,
        evidence={"agreement, as given": given, "agreement, set right": values[best]},
        alternatives=tuple(f"normals_{one}" for one in close),
    )


def _normal_samples(
    maps: Float[Tensor, "view height width 3"],
    caster: RayCaster | None,
    face_normals: Float[Tensor, "face 3"] | None,
    cameras: Cameras | None,
    view: int,
) -> tuple[Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"], Float[Tensor, "3 3"]]:
    """Sample a view's normals, those expected (mesh or direction to the eye), and the rotation."""
    if cameras is None:
        step = ceil(max(maps.shape[1:3]) / _GRID_PX)
        normals = maps[view, ::step, ::step].reshape(-1, 3)
        normals = normals[normals.norm(dim=1) > 0]
        return normals, normals.new_tensor([0, 0, -1]).expand_as(normals), torch.eye(3).to(normals)
    pixels = _grid(cameras, view)
    rays, normals = _rays(cameras, view, pixels), _at(maps[view], pixels).to(pixels)
    known, expected = normals.norm(dim=1) > 0, -rays
    if caster is not None and face_normals is not None:
        hits = caster.cast(cameras.centers_world[view], rays)
        met = face_normals[hits.face.clamp_min(0)].to(rays)
        expected = met * -(met * rays).sum(dim=1, keepdim=True).sign()
        known = known & (hits.face >= 0)
    return normals[known], expected[known], cameras.cam_from_world[view, :3, :3]


def _rays(
    cameras: Cameras, view: int, pixels: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 3"]:
    return rays_through(pixels, cameras.cam_from_world[view], cameras.intrinsics[view])


def _grid(cameras: Cameras, view: int) -> Float[Tensor, "pixel 2"]:
    """Return the centres of pixels on a regular grid over a photograph."""
    width, height = (int(side) for side in cameras.sizes_px[view])
    step = ceil(max(width, height) / _GRID_PX)
    centers = pixel_centers(width, height, like=cameras.intrinsics)
    return centers[step // 2 :: step, step // 2 :: step].reshape(-1, 2)


def _at(
    values: Shaped[Tensor, "height width *channel"], pixels: Float[Tensor, "pixel 2"]
) -> Shaped[Tensor, "..."]:
    column, row = pixels.long().unbind(dim=1)
    return values[row, column]


def _inside(
    cameras: Cameras, view: int, points_world: Float[Tensor, "point 3"]
) -> tuple[Bool[Tensor, " point"], Float[Tensor, "inside 2"], Float[Tensor, " inside"]]:
    """Return which points a photograph shows, their pixels and their depths."""
    pixels, depth = project(points_world, cameras.cam_from_world[view], cameras.intrinsics[view])
    inside = (depth > 0) & (pixels >= 0).all(dim=1) & (pixels < cameras.sizes_px[view]).all(dim=1)
    return inside, pixels[inside], depth[inside]


def _neighbours(num_views: int) -> list[tuple[int, int]]:
    """Pair every other view with the next, and in small sets all with all."""
    if num_views <= 4:
        return list(combinations(range(num_views), 2))
    return [(view, view + 1) for view in range(0, num_views - 1, 2)]


def _spread(capture: Capture) -> list[int]:
    """Choose views of different positions, in pairs of successive ones that share most.

    Views of a single viewpoint differ in their lights, and any are chosen.
    """
    first = {
        position: view for view, position in reversed(list(enumerate(capture.position.tolist())))
    }
    views = list(range(capture.views.num_views))
    if capture.cameras is not None:
        views = sorted(first.values())
    if len(views) <= _MAX_VIEWS:
        return views
    starts = np.linspace(0, len(views) - 2, _MAX_VIEWS // 2).round().astype(int)
    return [views[index] for start in starts for index in (start, start + 1)]


def _taken(truth: Truth, chosen: list[int]) -> Truth:
    fields = {name: getattr(truth, name) for name in ("depth", "normals_world", "foreground")}
    return truth.replace(
        **{name: values[chosen] for name, values in fields.items() if values is not None}
    )


def _surface_points(truth: Truth) -> Float[Tensor, "point 3"] | None:
    """Draw points of the true mesh or cloud; ``None`` without either."""
    mesh = truth.mesh
    if mesh is None and truth.points_world is not None:
        mesh = Mesh(vertices_world=truth.points_world, faces=torch.zeros(0, 3, dtype=torch.long))
    if mesh is None or len(mesh.vertices_world) == 0:
        return None
    return sample_surface(mesh, _MAX_POINTS, torch.Generator().manual_seed(0)).points
