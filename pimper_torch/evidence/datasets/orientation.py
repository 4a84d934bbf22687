"""Checks of orientation: of meshes, normal maps and lights."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.evidence.datasets.evidence import (
    normals_of_depth,
    pixel_rays,
    shrunk_cameras,
)
from pimper_torch.evidence.datasets.findings import Comparison, Finding
from pimper_torch.evidence.datasets.mistakes import VECTOR_MISTAKES, VectorMistake
from pimper_torch.evidence.datasets.raster import nearest
from pimper_torch.geometry.surfaces import unit_face_normals
from pimper_torch.geometry.visibility import Hits, cast_view
from pimper_torch.records import Cameras, Mesh, Truth, Views

_LOOKED_AT = 4  # views
_SMALL_PX = 160
_SATURATED = 0.99
# Right normals agree with those of depth or mesh to a mean cosine above 0.95, and no hypothesis
# halves the rest; mirrored ones reach 0.9 where a surface is rather flat.
_LEFT, _BETTER_COSINE = 0.5, 0.03
_BETTER_CORRELATION = 0.1
_FACING = 0.75


def check_mesh(
    truth: Truth, cameras: Cameras, findings: list[Finding], comparisons: list[Comparison]
) -> None:
    """Add findings on a mesh whose faces or vertex normals point inward."""
    mesh = truth.mesh
    if mesh is None or len(mesh.faces) == 0:
        return
    small = shrunk_cameras(cameras, _SMALL_PX)
    faces, vertices = [], []
    for view in _few(cameras.num_views):
        hits = cast_view(mesh, small, view)
        hit = hits.face >= 0
        if not bool(hit.any()):
            continue
        toward = -pixel_rays(small, view)[hit]
        faces.append(_fraction_facing(_face_normals_hit(mesh, hits)[hit], toward))
        if mesh.normals_world is not None:
            interpolated = hits.interpolate(mesh.normals_world.to(toward), mesh.faces)
            vertices.append(_fraction_facing(interpolated[hit], toward))
    for fractions, name, meaning, remedy in (
        (
            faces,
            "mesh_inside_out",
            "the mesh's faces are clockwise seen from outside",
            "exchange two corners of every face",
        ),
        (vertices, "mesh_normals_inward", "the mesh's vertex normals point inward", "negate them"),
    ):
        if not fractions:
            continue
        fraction = float(np.mean(fractions))
        comparisons.append(
            Comparison(
                evidence=name, hypotheses=("as given", name), scores=(fraction, 1 - fraction)
            )
        )
        if fraction < 1 - _FACING:
            findings.append(
                Finding(
                    name=name, meaning=meaning, remedy=remedy, evidence={"share facing": fraction}
                )
            )


def check_normals(
    views: Views,
    truth: Truth,
    cameras: Cameras | None,
    findings: list[Finding],
    comparisons: list[Comparison],
) -> None:
    """Add a finding on normal maps that disagree with the depth, the mesh or the viewpoint."""
    maps = truth.normals_world
    if maps is None:
        return
    samples = [_normal_samples(truth, cameras, view) for view in _few(len(maps))]
    samples = [one for one in samples if len(one[0])]
    if not samples:
        return
    geometric = all(one[1] is not None for one in samples)

    def score(mistake: VectorMistake | None) -> float:
        fractions = []
        for normals, truth_normals, toward, rotation in samples:
            rotated = normals if mistake is None else mistake.undo(normals, rotation)
            if geometric and truth_normals is not None:
                fractions.append(float((rotated * truth_normals).sum(dim=-1).clamp_min(0).mean()))
            else:
                fractions.append(_fraction_facing(rotated, toward))
        return float(np.mean(fractions))

    mistakes = VECTOR_MISTAKES if geometric else VECTOR_MISTAKES[:3]
    values = [score(None), *(score(mistake) for mistake in mistakes)]
    best = int(np.argmax(values))
    if geometric:
        halved = 1 - values[best] < _LEFT * (1 - values[0])
        wrong = halved and values[best] > values[0] + _BETTER_COSINE
    else:
        # Several hypotheses may face the camera; the shading selects one.
        shaded = [_shading_score(views, truth, cameras, one, None) for one in (None, *mistakes)]
        best = int(np.argmax(np.add(values, shaded)))
        wrong = values[0] < _FACING and values[best] > 0.95
    evidence = "normals against the surface" if geometric else "normals facing the camera"
    comparisons.append(_comparison(evidence, "normals", mistakes, values))
    if wrong:
        findings.append(_finding("normals", mistakes[best - 1], values, best))


def check_lights(
    views: Views,
    truth: Truth,
    cameras: Cameras | None,
    findings: list[Finding],
    comparisons: list[Comparison],
) -> None:
    """Add a finding on lights whose shading does not correlate with the photographs."""
    if any(one.name.startswith("normals") for one in findings):
        return
    values = [_shading_score(views, truth, cameras, None, one) for one in (None, *VECTOR_MISTAKES)]
    if max(values) == 0:
        return
    comparisons.append(_comparison("shading", "lights", VECTOR_MISTAKES, values))
    best = int(np.argmax(values))
    if values[best] > max(0.4, values[0] + _BETTER_CORRELATION):
        findings.append(_finding("lights", VECTOR_MISTAKES[best - 1], values, best))


def _shading_score(
    views: Views,
    truth: Truth,
    cameras: Cameras | None,
    in_normals: VectorMistake | None,
    in_lights: VectorMistake | None,
) -> float:
    """Give the correlation of the photographs with the shading of normals and lights.

    The mean over the views, negative ones counting 0; 0 also where either is unknown.
    """
    lights, found = truth.lights_world, []
    if lights is None or truth.normals_world is None:
        return 0.0
    for view in range(len(lights)):
        gray, normals, rotation = _shading_samples(views, truth, cameras, view)
        light = lights[view].to(normals)
        direction = light[1:]
        if in_normals is not None:
            normals = in_normals.undo(normals, rotation)
        if in_lights is not None:
            direction = in_lights.undo(direction, rotation)
        shading = (light[0] + normals @ direction).clamp_min(0)
        found.append(max(0.0, _correlation(shading, gray)))
    return float(np.mean(found))


def _finding(what: str, mistake: VectorMistake, values: Sequence[float], best: int) -> Finding:
    return Finding(
        name=f"{what}_{mistake.name}",
        meaning=f"the {what}: {mistake.meaning}",
        remedy=mistake.remedy,
        evidence={"agreement, as given": values[0], "agreement, set right": values[best]},
    )


def _comparison(
    evidence: str, what: str, mistakes: Sequence[VectorMistake], values: Sequence[float]
) -> Comparison:
    return Comparison(
        evidence=evidence,
        hypotheses=("as given", *(f"{what}_{mistake.name}" for mistake in mistakes)),
        scores=tuple(values),
    )


def _normal_samples(
    truth: Truth, cameras: Cameras | None, view: int
) -> tuple[Tensor, Tensor | None, Tensor, Tensor]:
    """Give a view's normals, those of its depth or mesh, directions to the eye, and rotation."""
    assert truth.normals_world is not None
    full = truth.normals_world[view]
    if cameras is None:
        known = full.norm(dim=-1) > 0
        toward = full.new_tensor([0.0, 0.0, -1.0]).expand_as(full[known])
        return full[known], None, toward, torch.eye(3).to(full)
    small = shrunk_cameras(cameras, _SMALL_PX)
    width, height = (int(side) for side in small.sizes_px[view])
    wide, high = (int(side) for side in cameras.sizes_px[view])
    maps = nearest(full[:high, :wide], width, height)
    like = small.intrinsics
    known = maps.norm(dim=-1) > 0
    surface = None
    if truth.depth is not None:
        depth = nearest(truth.depth[view, :high, :wide], width, height)
        surface = normals_of_depth(small, depth, view)
    elif truth.mesh is not None and len(truth.mesh.faces):
        hits = cast_view(truth.mesh, small, view)
        surface = _face_normals_hit(truth.mesh, hits)
        outward = (surface * -pixel_rays(small, view)).sum(dim=-1, keepdim=True).sign()
        surface = surface * outward
    if surface is not None:
        known = known & (surface.norm(dim=-1) > 0)
        surface = surface[known].to(like)
    return (
        maps[known].to(like),
        surface,
        -pixel_rays(small, view)[known],
        cameras.cam_from_world[view, :3, :3],
    )


def _shading_samples(
    views: Views, truth: Truth, cameras: Cameras | None, view: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Give a view's brightness and normals where neither dark nor saturated, and rotation."""
    assert truth.normals_world is not None
    width, height = (int(side) for side in views.sizes_px[view])
    factor = min(1.0, _SMALL_PX / max(width, height))
    wide, high = max(1, round(width * factor)), max(1, round(height * factor))
    image = nearest(views.images[view, :, :height, :width].movedim(0, -1), wide, high)
    normals = nearest(truth.normals_world[view, :height, :width], wide, high)
    known = (normals.norm(dim=-1) > 0) & (image.amax(dim=-1) < _SATURATED)
    if truth.foreground is not None:
        known = known & nearest(truth.foreground[view, :height, :width], wide, high)
    gray = image.mean(dim=-1)[known]
    if truth.albedo is not None:  # texture known beforehand
        albedo = nearest(truth.albedo[view, :height, :width], wide, high).mean(dim=-1)[known]
        gray = gray / albedo.clamp_min(1e-3)
    rotation = torch.eye(3) if cameras is None else cameras.cam_from_world[view, :3, :3]
    return gray, normals[known], rotation.to(normals)


def _correlation(one: Float[Tensor, " pixel"], other: Float[Tensor, " pixel"]) -> float:
    if len(one) <= 10:
        return 0.0
    a, b = one.double() - one.double().mean(), other.double() - other.double().mean()
    size = float(a.norm() * b.norm())
    return float(a @ b) / size if size > 0 else 0.0


def _fraction_facing(normals: Float[Tensor, "pixel 3"], toward: Float[Tensor, "pixel 3"]) -> float:
    return float(((normals.to(toward) * toward).sum(dim=-1) > 0).float().mean())


def _face_normals_hit(mesh: Mesh, hits: Hits) -> Float[Tensor, "height width 3"]:
    normals = unit_face_normals(mesh.vertices_world, mesh.faces)
    return torch.where((hits.face >= 0)[..., None], normals[hits.face.clamp_min(0)], 0)


def _few(num_views: int) -> list[int]:
    count = min(_LOOKED_AT, num_views)
    return sorted(set(np.linspace(0, num_views - 1, count).round().astype(int).tolist()))
