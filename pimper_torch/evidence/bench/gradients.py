"""Gradients of every stage, and of the chain whole, beside finite differences.

The chain runs once on a small closed-form scene; every stage is then asked again, with what it was
handed moved a little. Photographs, cameras and whatever a record carries from stage to stage are
inputs; the coarse mesh that structure from motion gives is brought.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.chains.published import Published
from pimper_torch.evidence.metrics.derivatives import DerivativeCheck, Tensors, check_derivatives
from pimper_torch.evidence.scenes import render_shape, sparse_scene
from pimper_torch.evidence.scenes.cameras import arc_cameras
from pimper_torch.evidence.scenes.lights import wandering_lights
from pimper_torch.evidence.scenes.noise import random_speckle
from pimper_torch.evidence.scenes.shapes import Sphere
from pimper_torch.paper.triangulate import Triangulate, TriangulateConfig
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    PatchViews,
    PhotometricPatches,
    Record,
    Silhouettes,
    SparseScene,
    Views,
)
from pimper_torch.stage import Given, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """A stage as a function of named tensors, and where it is asked.

    Attributes:
        function: From tensors to tensors, all in float64.
        inputs: What the chain handed to the stage.
        scales: See :func:`~pimper_torch.evidence.metrics.derivatives.check_derivatives`.
    """

    function: Callable[[Tensors], Tensors]
    inputs: Tensors
    scales: dict[str, float]

    def check(
        self,
        generator: torch.Generator,
        *,
        directions: int = 3,
        weights: int = 2,
        steps: tuple[float, float] = (1e-6, 1e-7),
    ) -> dict[tuple[str, str], DerivativeCheck]:
        """Compare autograd with finite differences, by input and output.

        See :func:`~pimper_torch.evidence.metrics.derivatives.check_derivatives`.
        """
        return check_derivatives(
            self.function,
            self.inputs,
            generator,
            scales=self.scales,
            directions=directions,
            weights=weights,
            steps=steps,
        )


def small_scene(
    seed: int = 31, num_views: int = 6, width: int = 64, num_points: int = 24
) -> tuple[SparseScene, CoarseMesh]:
    """Give photographs of a speckled sphere under wandering point lights, its cloud, and facets.

    Args:
        seed: Of point lights, speckle and cloud.
        num_views: Photographs.
        width: Of them in pixels; three quarters as high.
        num_points: Of the cloud that become vertices of facets.
    """
    generator = torch.Generator().manual_seed(seed)
    cameras = arc_cameras(
        num_views,
        width=width,
        height=3 * width // 4,
        focal_px=3.125 * width,
        distance=3.0,
        span_deg=40.0,
    )
    point_lights = wandering_lights(
        num_views, generator, distance=5.0, spread_deg=35.0, irradiance=0.6
    )
    texture = random_speckle(generator, cells=(0.3, 0.1), contrast=1.0)
    rendered = render_shape(Sphere(), cameras, point_lights.harmonics_world(), texture)
    scene = sparse_scene(rendered, 120, generator, dtype=torch.float64)
    coarse: CoarseMesh = Triangulate(TriangulateConfig(num_points=num_points))(scene)
    return scene, coarse


AnyChain = CoarseToFine | Published


class Whole(Stage):
    """A factorization that is called with all patches at once."""

    def __init__(self, factorize: Callable[[PatchViews], PhotometricPatches]) -> None:
        super().__init__()
        self.factorize = factorize

    def forward(self, seen: PatchViews) -> PhotometricPatches:
        """Call it."""
        return self.factorize(seen)


def probes(chain: AnyChain, scene: SparseScene, coarse: CoarseMesh) -> dict[str, Probe]:
    """Run the chain once, and make a probe of every stage that took part, and of the whole.

    Args:
        chain: Its stages may be swapped; structure from motion and the coarse mesh are replaced
            by ``scene`` and ``coarse``, and no silhouettes are looked for.
        scene: Float64.
        coarse: In the same frame.
    """
    calls = _calls(chain, scene, coarse)
    makers: dict[str, Callable[..., Probe]] = {
        "warp": _warp,
        "factorize": _factorize,
        "integrate": _integrate,
        "align": _align,
        "refine": _refine,
        "sweep": _sweep,
        "fuse": _fuse,
        "repair": _mend,
        "remesh": _adapt,
    }
    found = {
        name: make(getattr(chain, name), *calls[name])
        for name, make in makers.items()
        if name in calls
    }
    if "remesh" in calls:
        found["decompose"] = _decompose(chain.decompose, *calls["decompose"])
    return {**found, "chain": _chain(chain, scene, coarse)}


def moved_cameras(cameras: Cameras, motion: Float[Tensor, "view 6"]) -> Cameras:
    """Turn and shift cameras: rotation vectors, then shifts, in the cameras' frames."""
    rotation, shift = motion[:, :3], motion[:, 3:]
    none = torch.zeros_like(rotation[:, 0])
    x, y, z = rotation.unbind(dim=1)
    rows = [[none, -z, y, shift[:, 0]], [z, none, -x, shift[:, 1]], [-y, x, none, shift[:, 2]]]
    rows.append([none] * 4)
    generator = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    moved = torch.linalg.matrix_exp(generator) @ cameras.cam_from_world
    return cameras.replace(cam_from_world=moved)


def _calls(chain: AnyChain, scene: SparseScene, coarse: CoarseMesh) -> dict[str, tuple[Any, ...]]:
    """Run the chain and keep what each stage was handed last."""
    calls: dict[str, tuple[Any, ...]] = {}

    def keep(name: str) -> Callable[[nn.Module, tuple[Any, ...]], None]:
        return lambda _, handed: calls.update({name: handed})

    _place(chain, scene, coarse)
    chain.factorize = Whole(chain.factorize)
    hooks = [stage.register_forward_pre_hook(keep(name)) for name, stage in chain.named_children()]
    chain(scene)
    for hook in hooks:
        hook.remove()
    return calls


def _place(chain: AnyChain, scene: SparseScene, coarse: CoarseMesh) -> None:
    # Silhouettes jump as photographs change: everything is the object.
    chain.silhouettes = Given(Silhouettes.everything(scene.views))
    if isinstance(chain, Published):
        chain.triangulate = Given(coarse)
    else:
        chain.coarse_surface = Given(coarse)


def _gathered(buckets: Sequence[Record], name: str) -> Float[Tensor, " value"]:
    return torch.cat([getattr(bucket, name).flatten() for bucket in buckets])


def _replaced(buckets: Sequence[Any], **fields: Float[Tensor, " _"]) -> tuple[Any, ...]:
    """Put gathered values back into their buckets."""
    for name, values in fields.items():
        sizes = [getattr(bucket, name).numel() for bucket in buckets]
        buckets = [
            bucket.replace(**{name: part.reshape(getattr(bucket, name).shape)})
            for bucket, part in zip(buckets, torch.split(values, sizes), strict=True)
        ]
    return tuple(buckets)


def _spacing(patches: Any) -> float:  # noqa: ANN401 - any record with patches
    return float(patches.buckets[0].spacing[0])


def _still(cameras: Cameras) -> Float[Tensor, "view 6"]:
    return torch.zeros(cameras.num_views, 6, dtype=torch.float64)


def _per_pixel(cameras: Cameras) -> float:
    """Give the angle of a pixel: cameras move by some pixels at most."""
    return 1 / float(cameras.intrinsics[:, 0, 0].median())


def _warp(
    stage: nn.Module,
    views: Views,
    cameras: Cameras,
    patches: Any,  # noqa: ANN401
    _sources: object = None,  # which the stage makes itself, of photographs that vary
) -> Probe:
    def function(x: Tensors) -> Tensors:
        carrying = patches.replace(buckets=_replaced(patches.buckets, depth=x["depth"]))
        moved = moved_cameras(cameras, x["cameras"])
        seen = stage(views.replace(images=x["photographs"]), moved, carrying)
        return {"radiance": _gathered(seen.buckets, "radiance")}

    inputs = {
        "photographs": views.images,
        "cameras": _still(cameras),
        "depth": _gathered(patches.buckets, "depth"),
    }
    scales = {"depth": _spacing(patches), "cameras": _per_pixel(cameras)}
    return Probe(function=function, inputs=inputs, scales=scales)


def _factorize(stage: nn.Module, seen: Any) -> Probe:  # noqa: ANN401
    patches = seen.patches
    carrying = patches.buckets[0].normals_patch is not None

    def function(x: Tensors) -> Tensors:
        templates = patches.buckets
        if carrying:
            templates = _replaced(templates, normals_patch=x["carried normals"])
        found = stage(
            seen.replace(
                patches=patches.replace(buckets=templates),
                buckets=_replaced(seen.buckets, radiance=x["radiance"]),
            )
        )
        residual = [bucket.convergence.residual for bucket in found.buckets]
        return {
            "normals": _gathered(found.buckets, "normals_patch"),
            "albedo": _gathered(found.buckets, "albedo"),
            "lights": _gathered(found.buckets, "lights_patch"),
            "confidence": _gathered(found.buckets, "confidence"),
            "residual": torch.cat(residual),
        }

    inputs = {"radiance": _gathered(seen.buckets, "radiance")}
    if carrying:
        inputs["carried normals"] = _gathered(patches.buckets, "normals_patch")
    return Probe(function=function, inputs=inputs, scales={})


def _integrate(stage: nn.Module, photometric: Any) -> Probe:  # noqa: ANN401
    information = _gathered(photometric.buckets, "information")

    def function(x: Tensors) -> Tensors:
        buckets = _replaced(
            photometric.buckets,
            normals_patch=x["normals"],
            information=information * x["information"],
        )
        return {"depth": _gathered(stage(photometric.replace(buckets=buckets)).buckets, "depth")}

    inputs = {
        "normals": _gathered(photometric.buckets, "normals_patch"),
        "information": torch.ones_like(information),  # as a factor: none stays none
    }
    return Probe(function=function, inputs=inputs, scales={})


def _align(stage: nn.Module, depths: Any) -> Probe:  # noqa: ANN401
    def function(x: Tensors) -> Tensors:
        found = stage(depths.replace(buckets=_replaced(depths.buckets, depth=x["depth"])))
        return {"depth": _gathered(found.buckets, "depth")}

    spacing = _spacing(depths.patches)
    inputs = {"depth": _gathered(depths.buckets, "depth")}
    return Probe(function=function, inputs=inputs, scales={"depth": spacing})


def _refine(stage: nn.Module, depths: Any) -> Probe:  # noqa: ANN401
    photometric = depths.photometric

    def function(x: Tensors) -> Tensors:
        buckets = _replaced(photometric.buckets, normals_patch=x["normals"], albedo=x["albedo"])
        surface = stage(
            depths.replace(
                photometric=photometric.replace(buckets=buckets),
                buckets=_replaced(depths.buckets, depth=x["depth"]),
            )
        )
        return _of_surface(surface)

    inputs = {
        "depth": _gathered(depths.buckets, "depth"),
        "normals": _gathered(photometric.buckets, "normals_patch"),
        "albedo": _gathered(photometric.buckets, "albedo"),
    }
    return Probe(function=function, inputs=inputs, scales={"depth": _spacing(depths.patches)})


def _sweep(
    stage: nn.Module,
    views: Views,
    cameras: Cameras,
    seen: Any,  # noqa: ANN401
    photometric: Any,  # noqa: ANN401
    _sources: object = None,
) -> Probe:
    spacing = _spacing(seen.patches)

    def function(x: Tensors) -> Tensors:
        patches = seen.patches.replace(buckets=_replaced(seen.patches.buckets, depth=x["depth"]))
        buckets = _replaced(
            photometric.buckets, normals_patch=x["normals"], lights_patch=x["lights"]
        )
        found = stage(
            views.replace(images=x["photographs"]),
            moved_cameras(cameras, x["cameras"]),
            seen.replace(patches=patches),
            photometric.replace(buckets=buckets, patches=patches),
        )
        return {
            "offset": _gathered(found.buckets, "offset") / spacing,
            "information": _gathered(found.buckets, "information") * spacing**2,
        }

    inputs = {
        "photographs": views.images,
        "cameras": _still(cameras),
        "normals": _gathered(photometric.buckets, "normals_patch"),
        "lights": _gathered(photometric.buckets, "lights_patch"),
        "depth": _gathered(seen.patches.buckets, "depth"),
    }
    scales = {"depth": spacing, "cameras": _per_pixel(cameras)}
    return Probe(function=function, inputs=inputs, scales=scales)


def _fuse(stage: nn.Module, swept: Any, contours: Any, expected: bool) -> Probe:  # noqa: ANN401
    photometric = swept.photometric
    patches = photometric.patches
    spacing, cloud = _spacing(patches), patches.coarse.points
    information = _gathered(swept.buckets, "information")
    certain = _gathered(photometric.buckets, "information")

    def function(x: Tensors) -> Tensors:
        carrying = patches.replace(buckets=_replaced(patches.buckets, depth=x["depth"]))
        if cloud is not None:
            points = cloud.replace(points_world=x["cloud"])
            carrying = carrying.replace(coarse=patches.coarse.replace(points=points))
        buckets = _replaced(
            photometric.buckets,
            normals_patch=x["normals"],
            albedo=x["albedo"],
            information=certain * x["normal information"],
        )
        heights = _replaced(
            swept.buckets, offset=x["offset"], information=information * x["information"]
        )
        surface = stage(
            swept.replace(
                photometric=photometric.replace(buckets=buckets, patches=carrying),
                buckets=heights,
            ),
            contours,
            expected,
        )
        return _of_surface(surface)

    inputs = {
        "normals": _gathered(photometric.buckets, "normals_patch"),
        "albedo": _gathered(photometric.buckets, "albedo"),
        "normal information": torch.ones_like(certain),
        "offset": _gathered(swept.buckets, "offset"),
        "information": torch.ones_like(information),  # as a factor: none stays none
        "depth": _gathered(patches.buckets, "depth"),
    }
    if cloud is not None:
        inputs["cloud"] = cloud.points_world
    scales = {"depth": spacing, "cloud": spacing, "offset": spacing}
    return Probe(function=function, inputs=inputs, scales=scales)


def _mend(stage: nn.Module, surface: Any) -> Probe:  # noqa: ANN401
    def function(x: Tensors) -> Tensors:
        found = stage(surface.replace(vertices_world=x["vertices"]))
        return {"vertices": found.vertices_world}

    scale = _step_of(surface.vertices_world, surface.faces)
    inputs = {"vertices": surface.vertices_world}
    return Probe(function=function, inputs=inputs, scales={"vertices": scale})


def _adapt(stage: nn.Module, swept: Any, surface: Any, contours: Any) -> Probe:  # noqa: ANN401
    def function(x: Tensors) -> Tensors:
        found = stage(
            swept,
            surface.replace(
                vertices_world=x["vertices"],
                normals_world=x["normals"],
                information=surface.information * x["information"],
            ),
            contours,
        )
        return {"vertices": found.mesh.vertices_world, "normals": found.mesh.normals_world}

    inputs = {
        "vertices": surface.vertices_world,
        "normals": surface.normals_world,
        "information": torch.ones_like(surface.information),
    }
    scale = _step_of(surface.vertices_world, surface.faces)
    return Probe(function=function, inputs=inputs, scales={"vertices": scale})


def _decompose(
    stage: Callable[..., Any],
    coarse: CoarseMesh,
    cameras: Cameras,
    surface: Any,  # noqa: ANN401
    scale: float,
) -> Probe:
    def function(x: Tensors) -> Tensors:
        mesh = coarse.mesh.replace(vertices_world=x["facets"])
        found = stage(
            coarse.replace(mesh=mesh),
            cameras,
            surface.replace(vertices_world=x["vertices"], normals_world=x["normals"]),
            scale,
        )
        return {
            "depth": _gathered(found.buckets, "depth"),
            "normals": _gathered(found.buckets, "normals_patch"),
            "frames": _gathered(found.buckets, "patch_from_world"),
        }

    step = _step_of(surface.vertices_world, surface.faces)
    inputs = {
        "vertices": surface.vertices_world,
        "normals": surface.normals_world,
        "facets": coarse.mesh.vertices_world,
    }
    return Probe(function=function, inputs=inputs, scales={"vertices": step, "facets": step})


def _chain(chain: AnyChain, scene: SparseScene, coarse: CoarseMesh) -> Probe:
    step = _step_of(coarse.mesh.vertices_world, coarse.mesh.faces)

    def function(x: Tensors) -> Tensors:
        views = scene.views.replace(images=x["photographs"])
        mesh = coarse.mesh.replace(vertices_world=x["mesh"])
        moved = scene.replace(views=views, cameras=moved_cameras(scene.cameras, x["cameras"]))
        _place(chain, moved, coarse.replace(mesh=mesh))
        result = chain(moved)
        found = result.mesh
        return {
            "vertices": found.vertices_world,
            "normals": _known(found.normals_world),
            "albedo": _known(found.albedo),
            "lights": _gathered(result.patches.photometric.buckets, "lights_patch"),
        }

    inputs = {
        "photographs": scene.views.images,
        "cameras": _still(scene.cameras),
        "mesh": coarse.mesh.vertices_world,
    }
    scales = {"mesh": step, "cameras": _per_pixel(scene.cameras)}
    return Probe(function=function, inputs=inputs, scales=scales)


def _known(values: Tensor | None) -> Tensor:
    assert values is not None  # what a chain extracts has all
    return values


def _of_surface(surface: Any) -> Tensors:  # noqa: ANN401
    return {
        "vertices": surface.vertices_world,
        "normals": surface.normals_world,
        "albedo": surface.albedo,
        "confidence": surface.confidence,
    }


def _step_of(vertices: Float[Tensor, "vertex 3"], faces: Tensor) -> float:
    """Give the median length of the faces' edges."""
    ends = vertices.detach()[faces]
    return float((ends[:, 1] - ends[:, 0]).norm(dim=1).median())
