"""Gradients of every stage and of the whole chain, against finite differences.

The chain runs once on a small closed-form scene; every stage is then evaluated again with perturbed
arguments. Photographs, cameras and the tensors of records between stages are inputs; a given coarse
mesh replaces structure from motion.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pimper_bench.derivatives import DerivativeCheck, Tensors, check_derivatives
from pimper_bench.scenes import render_shape, sparse_scene
from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_bench.scenes.textures import random_speckle
from pimper_torch import load_chain, load_views
from pimper_torch.chains.coarse_to_fine import CoarseToFine
from pimper_torch.geometry.pyramids import Sources
from pimper_torch.paper.chain import Published
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.paper.triangulate import Triangulate
from pimper_torch.records import (
    CoarseMesh,
    PatchViews,
    PhotometricPatches,
    Reconstruction,
    Silhouettes,
    SparseScene,
    Surface,
)
from pimper_torch.stages.stage import Given, Stage


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """A stage as a function of named tensors, and where it is evaluated.

    Attributes:
        function: From tensors to tensors, all in float64.
        inputs: The tensors that the chain passed to the stage.
        scales: See :func:`~derivatives.check_derivatives`.
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

        See :func:`~derivatives.check_derivatives`.
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
    seed: int = 31, num_views: int = 6, width: int = 64, num_points: int = 28
) -> tuple[SparseScene, CoarseMesh]:
    """Render a speckled sphere under wandering point lights; give its cloud and facets, too.

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


def rendered_scene(folder: Path) -> tuple[SparseScene, CoarseMesh]:
    """Read a scene of ``pimper render`` with true cameras and masks, and facets on its surface."""
    views = load_views(folder / "photos", masks=folder / "masks")
    chain = load_chain("default", {"scales": [0.25]})
    scene = chain.reconstruct(views, folder / "truth" / "sparse")
    coarse = chain(scene).patches.photometric.patches.coarse
    return scene.to(torch.float64), coarse.to(torch.float64)


AnyChain = CoarseToFine | Published


class Whole(Stage):
    """The photometry of a chain, of all patches at once: light, factorization and gauge."""

    def __init__(self, chain: AnyChain) -> None:
        super().__init__()
        self.light, self.factorize, self.gauge = chain.light, chain.factorize, chain.gauge

    def forward(self, seen: PatchViews) -> PhotometricPatches:
        """Call the stages."""
        return self.gauge(self.factorize(seen, self.light(seen)))


def calls(chain: AnyChain, run: Callable[[], object]) -> dict[str, tuple[Any, ...]]:
    """Run a chain; return the arguments of each stage's last call, with all patches at once."""
    found: dict[str, tuple[Any, ...]] = {}

    def keep(name: str) -> Callable[[nn.Module, tuple[Any, ...]], None]:
        return lambda _, arguments: found.update({name: arguments})

    hooks = [stage.register_forward_pre_hook(keep(name)) for name, stage in chain.named_children()]
    run()
    for hook in hooks:
        hook.remove()
    if "sweep" in found:
        views, cameras, _, sources = found["warp"]
        patches = found["fuse"][0].patches
        found["warp"] = views, cameras, patches, sources
        seen = chain.warp(*found["warp"])
        found["sweep"] = views, cameras, seen, Whole(chain)(seen), sources
    else:
        seen, _ = found["factorize"]
    return found | {"factorize": (seen,)}


def stage_of(chain: AnyChain, name: str) -> Callable[..., Any]:
    """Return a stage as :func:`calls` has its arguments."""
    return Whole(chain) if name == "factorize" else getattr(chain, name)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Paths:
    """Inputs and outputs of a stage: paths through its arguments, and through its result.

    A path runs through fields, and through all records of a tuple: ``0.buckets.depth`` is the
    depth in every bucket of the first argument. Paths that end in ``None`` are left out.

    Attributes:
        inputs: By name; several paths, where arguments share a tensor.
        outputs: By name.
    """

    inputs: dict[str, tuple[str, ...]]
    outputs: dict[str, str]


_SURFACE = {
    "vertices": "vertices_world",
    "normals": "normals_world",
    "albedo": "albedo",
    "confidence": "confidence",
}
_STAGES = {
    "warp": _Paths(
        inputs={
            "photographs": ("0.images",),
            "cameras": ("1.cam_from_world",),
            "depth": ("2.buckets.depth",),
        },
        outputs={"radiance": "buckets.radiance"},
    ),
    "factorize": _Paths(
        inputs={
            "radiance": ("0.buckets.radiance",),
            "template normals": ("0.patches.buckets.normals_patch",),
        },
        outputs={
            "normals": "buckets.normals_patch",
            "albedo": "buckets.albedo",
            "lights": "buckets.lights_patch",
            "confidence": "buckets.confidence",
            "residual": "buckets.convergence.residual",
        },
    ),
    "integrate": _Paths(
        inputs={
            "normals": ("0.buckets.normals_patch",),
            "information": ("0.buckets.information",),
        },
        outputs={"depth": "buckets.depth"},
    ),
    "align": _Paths(
        inputs={"depth": ("0.buckets.depth",)},
        outputs={"depth": "buckets.depth"},
    ),
    "refine": _Paths(
        inputs={
            "depth": ("0.buckets.depth",),
            "normals": ("0.photometric.buckets.normals_patch",),
            "albedo": ("0.photometric.buckets.albedo",),
        },
        outputs=_SURFACE,
    ),
    "sweep": _Paths(
        inputs={
            "photographs": ("0.images",),
            "cameras": ("1.cam_from_world",),
            "normals": ("3.buckets.normals_patch",),
            "lights": ("3.buckets.lights_patch",),
            "depth": ("2.patches.buckets.depth", "3.patches.buckets.depth"),
        },
        outputs={"offset": "buckets.offset", "information": "buckets.information"},
    ),
    "fuse": _Paths(
        inputs={
            "normals": ("0.photometric.buckets.normals_patch",),
            "albedo": ("0.photometric.buckets.albedo",),
            "normal information": ("0.photometric.buckets.information",),
            "offset": ("0.buckets.offset",),
            "information": ("0.buckets.information",),
            "depth": ("0.photometric.patches.buckets.depth",),
            "cloud": ("0.photometric.patches.coarse.points.points_world",),
        },
        outputs=_SURFACE,
    ),
    "repair": _Paths(
        inputs={"vertices": ("0.vertices_world",)},
        outputs={"vertices": "vertices_world"},
    ),
    "remesh": _Paths(
        inputs={
            "vertices": ("1.vertices_world",),
            "normals": ("1.normals_world",),
            "information": ("1.information",),
        },
        outputs={"vertices": "mesh.vertices_world", "normals": "mesh.normals_world"},
    ),
    "decompose": _Paths(
        inputs={
            "vertices": ("2.vertices_world",),
            "normals": ("2.normals_world",),
            "facets": ("0.mesh.vertices_world",),
        },
        outputs={
            "depth": "buckets.depth",
            "normals": "buckets.normals_patch",
            "frames": "buckets.patch_from_world",
        },
    ),
}
_CHAIN = _Paths(
    inputs={
        "photographs": ("0.views.images",),
        "cameras": ("0.cameras.cam_from_world",),
        "mesh": ("1.mesh.vertices_world",),
    },
    outputs={
        "vertices": "mesh.vertices_world",
        "normals": "mesh.normals_world",
        "albedo": "mesh.albedo",
        "lights": "patches.photometric.buckets.lights_patch",
    },
)

# Inputs that are lengths: a unit step is the spacing of samples, or the edge of a face.
_LENGTHS = ("depth", "offset", "vertices", "facets", "cloud", "mesh")


def moved_poses(
    cam_from_world: Float[Tensor, "view 4 4"], motion: Float[Tensor, "view 6"]
) -> Float[Tensor, "view 4 4"]:
    """Move cameras by rotation vectors and translations in their frames."""
    rotation, shift = motion[:, :3], motion[:, 3:]
    none = torch.zeros_like(rotation[:, 0])
    x, y, z = rotation.unbind(dim=1)
    rows = [[none, -z, y, shift[:, 0]], [z, none, -x, shift[:, 1]], [-y, x, none, shift[:, 2]]]
    rows.append([none] * 4)
    generator = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    return torch.linalg.matrix_exp(generator) @ cam_from_world


@dataclass(frozen=True, slots=True, kw_only=True)
class _Parameter:
    """How an input parametrizes a tensor: ``apply(tensor, start(tensor))`` is the tensor."""

    start: Callable[[Tensor], Tensor]
    apply: Callable[[Tensor, Tensor], Tensor]


_VALUES = _Parameter(start=lambda tensor: tensor, apply=lambda _, values: values)
# Zero information stays zero.
_FACTOR = _Parameter(start=torch.ones_like, apply=lambda tensor, factor: tensor * factor)
_PARAMETERS = {
    "cameras": _Parameter(start=lambda poses: poses.new_zeros(len(poses), 6), apply=moved_poses),
    "information": _FACTOR,
    "normal information": _FACTOR,
}


def probes(chain: AnyChain, scene: SparseScene, coarse: CoarseMesh) -> dict[str, Probe]:
    """Run the chain once; give a probe of every stage that took part, and of the whole.

    Args:
        chain: Its stages may be swapped; structure from motion and the coarse mesh are replaced
            by ``scene`` and ``coarse``, and silhouettes are everything.
        scene: Float64.
        coarse: In the same frame.
    """
    _substitute(chain, scene, coarse)
    given = calls(chain, lambda: chain(scene))

    def whole(scene: SparseScene, coarse: CoarseMesh) -> Reconstruction:
        _substitute(chain, scene, coarse)
        return chain(scene)

    if "remesh" not in given:
        del given["decompose"]  # templates carry no surface, and facets are constants
    found = {
        name: _probe(paths, stage_of(chain, name), given[name])
        for name, paths in _STAGES.items()
        if name in given
    }
    return {**found, "chain": _probe(_CHAIN, whole, (scene, coarse))}


def _substitute(chain: AnyChain, scene: SparseScene, coarse: CoarseMesh) -> None:
    # Silhouettes are not continuous in the photographs: everything is the object.
    chain.silhouettes = Given(Silhouettes.everything(scene.views))
    if isinstance(chain, Published):
        chain.triangulate = Given(coarse)
    else:
        chain.coarse_surface = Given(coarse)


def _probe(paths: _Paths, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Probe:
    # Stages prepare the sources themselves, of photographs that vary.
    arguments = tuple(None if isinstance(one, Sources) else one for one in arguments)
    given = {name: _tensors(arguments, inputs[0]) for name, inputs in paths.inputs.items()}
    given = {name: tensors for name, tensors in given.items() if tensors}
    starts = {
        name: [_PARAMETERS.get(name, _VALUES).start(tensor) for tensor in tensors]
        for name, tensors in given.items()
    }

    def moved(x: Tensors) -> Tensors:
        replaced: Any = arguments
        for name, tensors in given.items():
            parts = torch.split(x[name], [start.numel() for start in starts[name]])
            values = [
                _PARAMETERS.get(name, _VALUES).apply(tensor, part.reshape(start.shape))
                for tensor, start, part in zip(tensors, starts[name], parts, strict=True)
            ]
            for path in paths.inputs[name]:
                replaced = _replaced(replaced, path.split("."), iter(values))
        result = function(*replaced)
        return {name: _flat(_tensors(result, path)) for name, path in paths.outputs.items()}

    scales = {name: _length(arguments) for name in given if name in _LENGTHS}
    if "cameras" in given:
        scales["cameras"] = _pixel_angle(arguments)
    inputs = {name: _flat(tensors) for name, tensors in starts.items()}
    return Probe(function=moved, inputs=inputs, scales=scales)


def _tensors(value: Any, path: str) -> list[Tensor]:
    """Return the tensors at a path; none where it ends in ``None``."""
    found = [value]
    for name in path.split("."):
        inner: list[Any] = []
        for one in found:
            if isinstance(one, tuple):
                inner += [one[int(name)]] if name.isdigit() else [getattr(i, name) for i in one]
            elif one is not None:
                inner.append(getattr(one, name))
        found = inner
    return [one for one in found if one is not None]


def _replaced(value: Any, path: list[str], tensors: Iterator[Tensor]) -> Any:
    """Replace the tensors that :func:`_tensors` gives, in their order."""
    if not path:
        return next(tensors)
    name, *rest = path
    if isinstance(value, tuple) and name.isdigit():
        index = int(name)
        return (*value[:index], _replaced(value[index], rest, tensors), *value[index + 1 :])
    if isinstance(value, tuple):
        return tuple(_replaced(item, path, tensors) for item in value)
    return value.replace(**{name: _replaced(getattr(value, name), rest, tensors)})


def _flat(tensors: list[Tensor]) -> Float[Tensor, " value"]:
    return torch.cat([tensor.flatten() for tensor in tensors])


def _length(arguments: tuple[Any, ...]) -> float:
    """Return the median edge of a surface, or of the coarse mesh of a scene; else the spacing."""
    for one in arguments:
        if isinstance(one, Surface):
            return _edge(one.vertices_world, one.faces)
    if isinstance(arguments[0], SparseScene):
        return _edge(arguments[1].mesh.vertices_world, arguments[1].mesh.faces)
    patches = (getattr(one, "patches", one) for one in arguments)
    return next(float(one.buckets[0].spacing[0]) for one in patches if hasattr(one, "buckets"))


def _edge(vertices: Float[Tensor, "vertex 3"], faces: Tensor) -> float:
    """Return the median length of the faces' edges."""
    ends = vertices.detach()[faces]
    return float((ends[:, 1] - ends[:, 0]).norm(dim=1).median())


def _pixel_angle(arguments: tuple[Any, ...]) -> float:
    """Return the angle of a pixel, the unit of the cameras' motion."""
    first = arguments[0]
    cameras = first.cameras if isinstance(first, SparseScene) else arguments[1]
    return 1 / float(cameras.intrinsics[:, 0, 0].median())
