"""Gain of priors on photographs, and cost of wrong ones.

Cameras and masks are true. A kind is a prior made from the
true maps: `normals:DEG` with independent noise of DEG degrees per pixel, `smooth:DEG` with errors
that vary over a fifth of the image, like those of networks, `depth:MILLE` with noise of MILLE
thousandths of the mean depth, `inliers` with the pixels that were rendered without a highlight. A
third number divides the stated variance.
"""

import math
from functools import partial

import torch
from bench_runs import figures_of
from declared import Figures, Place, Row, Study, Table, figure, listed
from torch import Tensor
from torch.nn.functional import interpolate, normalize

import pimper_torch as pt
from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.metrics.estimates import estimate_of
from pimper_bench.metrics.evaluation import EvaluateConfig, evaluate
from pimper_bench.truth import Capture
from pimper_torch.records import Prior

KINDS = {
    "none": "none",
    "normals:2": "noise of 2° in each pixel",
    "smooth:10": "smooth errors of 10°",
}


def tilted(normals: Tensor, noise: Tensor, degrees: float) -> Tensor:
    """Tilt normals by noise whose components have unit variance; `degrees` is the mean angle."""
    across = noise - (noise * normals).sum(dim=-1, keepdim=True) * normals
    return normalize(normals + math.radians(degrees) / 2**0.5 * across, dim=-1)


def prior_of(kind: str, capture: Capture) -> tuple[Prior, ...]:
    """Make a prior of the true maps."""
    name, *numbers = kind.split(":")
    size = float(numbers[0]) if numbers else 0.0
    understated = float(numbers[1]) if len(numbers) > 1 else 1.0
    truth, views, cameras = capture.truth, capture.views, capture.cameras
    assert cameras is not None
    assert truth.normals_world is not None
    assert truth.depth is not None
    assert truth.foreground is not None
    known, generator = truth.foreground, torch.Generator().manual_seed(3)
    rotation = cameras.cam_from_world[:, :3, :3].to(truth.normals_world)
    normals = torch.einsum("vij,vhwj->vhwi", rotation, truth.normals_world)
    nowhere = torch.full_like(normals[..., 0], math.inf)
    variance = torch.where(known, math.radians(size) ** 2 / understated, nowhere)
    if name == "normals":
        guess = tilted(normals, torch.randn(normals.shape, generator=generator), size)
    elif name == "smooth":
        coarse = torch.randn(len(normals), 3, 4, 5, generator=generator)
        noise = interpolate(coarse, size=normals.shape[1:3], mode="bicubic").movedim(1, -1)
        guess = tilted(normals, noise / noise.square().mean().sqrt(), size)
    elif name == "depth":
        sigma = size / 1000 * float(truth.depth[known].mean())
        noisy = truth.depth + sigma * torch.randn(truth.depth.shape, generator=generator)
        return (
            pt.DepthPrior(
                names=views.names,
                sizes_px=views.sizes_px,
                depth=torch.where(known, noisy, 0).float(),
                variance=torch.where(known, sigma**2 / understated, nowhere),
                gauge="scene",
            ),
        )
    elif name == "inliers":
        assert truth.lit is not None
        assert truth.highlight is not None
        plain = (truth.lit & ~truth.highlight) | ~known
        sizes = views.sizes_px
        return (pt.InlierPrior(names=views.names, sizes_px=sizes, probability=plain.float()),)
    else:
        return ()
    return (
        pt.NormalPrior(
            names=views.names, sizes_px=views.sizes_px, normals=guess, variance=variance
        ),
    )


def measure(place: Place, scene: str, kind: str) -> Figures:
    """Reconstruct with a prior, and measure."""
    folder = place.scene(scene, num_views=8, width=240, height=180)
    capture = read_rendered(folder)
    photographs = pt.load_views(folder / "photos", masks=folder / "masks")
    photographs = photographs.replace(priors=prior_of(kind, capture))
    chain = pt.load_chain("default", cache=place.cache / "stages")
    result = chain(photographs, folder / "truth" / "sparse")
    chosen = EvaluateConfig(samples=50_000, views=capture.views.names)
    found = evaluate(estimate_of(result), capture, chosen)
    angles = [float(view.shape_normals.mean_deg) for view in found.views if view.shape_normals]
    return figures_of(found) | {"normals": sum(angles) / len(angles)}


STUDY = Study(
    name="priors",
    rows={
        (scene, told): Row(measure=partial(measure, scene=scene, kind=kind))
        for scene in ("jar",)
        for kind, told in KINDS.items()
    },
    tables=[
        Table(
            name="priors",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["scene", "prior"],
                [
                    figure("normals, °", "normals"),
                    figure("accuracy, %", "accuracy", 3),
                ],
            ),
        )
    ],
)
