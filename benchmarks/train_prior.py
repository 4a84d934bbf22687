"""Train the learned prior on rendered scenes: ``python benchmarks/train_prior.py OUT.safetensors``.

The chain runs once on every scene, and some patches of its passes are kept with their true normals.
Lights given, a sample's normal is a robust least-squares fit: the network is trained through a few
steps of that first, and through the factorization itself at the end.
"""

import argparse
import math
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from safetensors.torch import save_file
from torch import Tensor
from torch.nn.functional import normalize

import pimper_torch as pt
from pimper_torch.evidence.datasets.rendered import read_rendered
from pimper_torch.evidence.scenes import SceneConfig, render_scene
from pimper_torch.patches.transfer import transfer, transferred_normals
from pimper_torch.photometry import Factorize, FactorizeConfig, Illumination
from pimper_torch.photometry.cone import tangents
from pimper_torch.photometry.factor_priors import (
    RELATIVE_NOISE,
    FactorPrior,
    FieldLights,
    Known,
    LearnedPrior,
    PatchSamples,
    SurfaceNormals,
)
from pimper_torch.photometry.light_field import harmonics
from pimper_torch.photometry.sample_estimates import rows_of
from pimper_torch.records import PatchViews, PhotometricPatches

# Objects, and what differs from 10 photographs of 200x150. The jar is held out.
SCENES: dict[str, tuple[str, dict[str, float]]] = {
    "mug": ("mug", {"seed": 21}),
    "shiny mug": ("mug", {"seed": 51, "specular": 0.07, "roughness": 0.3}),
    "matte mug": ("mug", {"seed": 52, "specular": 0.0, "num_views": 12}),
    "balls": ("balls", {"seed": 24}),
    "glossy balls": ("balls", {"seed": 26, "specular": 0.05, "roughness": 0.35}),
    "shiny balls": ("balls", {"seed": 53, "specular": 0.08, "roughness": 0.2, "num_views": 12}),
    "potatoes": ("potatoes", {"seed": 27}),
    "glossy potatoes": ("potatoes", {"seed": 22, "specular": 0.06, "roughness": 0.3}),
}

# Of each call of a factorization so many patches are kept, of each pass.
PATCHES = 12

# Samples whose surface is further off than this are of another part of the object, mostly.
MIN_COSINE = 0.9


@dataclass(frozen=True)
class Kept:
    """Some patches of a pass, and their true normals."""

    seen: PatchViews
    light: Illumination
    truth: Float[Tensor, "patch height width 3"]
    known: Bool[Tensor, "patch height width"]


@dataclass(frozen=True)
class Solved:
    """What the prior is asked of some patches, their fitted lights, and their true normals."""

    samples: PatchSamples
    lights: Float[Tensor, "patch view 4"]
    truth: Float[Tensor, "patch sample 3"]
    known: Bool[Tensor, "patch sample"]


class Keeping(Factorize):
    """A factorization that keeps some of the patches it is called with."""

    def __init__(self, config: FactorizeConfig | None = None) -> None:
        super().__init__(config)
        self.kept: list[tuple[PatchViews, Illumination]] = []

    def solve(self, seen: PatchViews, light: Illumination) -> PhotometricPatches:
        """Factorize, and keep."""
        for templates, registered in zip(seen.patches.buckets, seen.buckets, strict=True):
            if len(templates.facet):
                generator = torch.Generator().manual_seed(len(self.kept))
                some = torch.randperm(len(templates.facet), generator=generator)[:PATCHES]
                patches = seen.patches.replace(buckets=(templates.take(some),))
                part = PatchViews(patches=patches, buckets=(registered.take(some),))
                self.kept.append((part, light))
        return super().solve(seen, light)


class Asked(FactorPrior):
    """A prior that knows nothing, and keeps what it is asked."""

    def forward(self, samples: PatchSamples) -> Known:
        """Keep the samples."""
        self.samples = samples
        return Known()


def kept_of(folder: Path, scales: Sequence[float] = (0.4, 1.0)) -> list[Kept]:
    """Run the chain on a rendered scene with its true cameras and masks, and keep patches."""
    chain = pt.load_chain("default", {"scales": list(scales)})
    chain.factorize = keeping = Keeping()
    views = pt.load_views(folder / "photos", masks=folder / "masks")
    found = chain(views, folder / "truth" / "sparse")
    mesh = read_rendered(folder, maps=False, photographs=False).truth.mesh
    vertices = mesh.vertices_world.double() - torch.as_tensor(found.scene.offset_world).double()
    mesh = mesh.replace(vertices_world=vertices.float(), normals_world=None)
    kept = []
    for seen, light in keeping.kept:
        true = transfer(seen.patches, mesh).buckets[0]
        own = seen.patches.buckets[0]
        assert true.normals_patch is not None
        surface = transferred_normals(seen.patches.coarse, own)
        near = (surface * true.normals_patch).sum(dim=-1) > MIN_COSINE
        known = true.inside & own.inside & near
        kept.append(Kept(seen=seen, light=light, truth=true.normals_patch, known=known))
    return kept


def solved(kept: Kept) -> Solved:
    """Factorize without the network."""
    asked = Asked()
    factorize = Factorize(priors=[FieldLights(), SurfaceNormals(), asked])
    with torch.no_grad():
        found = factorize.solve(kept.seen, kept.light).buckets[0]
    templates, registered = kept.seen.patches.buckets[0], kept.seen.buckets[0]
    normals = transferred_normals(kept.seen.patches.coarse, templates)
    index = rows_of(templates, registered, normals).index
    known = (kept.known & found.valid).flatten(1).gather(1, index)
    truth = kept.truth.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 3))
    lights = found.lights_patch
    return Solved(samples=asked.samples, lights=lights, truth=truth, known=known)


def fitted(solved: Solved, known: Known, steps: int = 4) -> Float[Tensor, "patch sample 3"]:
    """Fit normals to the samples by Gauss-Newton steps with Cauchy's weights, lights given."""
    samples, lights = solved.samples, solved.lights
    assert known.inlier is not None
    assert known.normals is not None
    normals, radiance = samples.normals, samples.radiance
    level = samples.lights.square().sum(dim=(1, 2)) / samples.seen.any(dim=2).sum(dim=1).clamp_min(
        1
    )
    inlier = samples.seen * known.inlier
    weight = inlier

    def total(one: Tensor, other: Tensor) -> Tensor:
        return (weight * one * other).sum(dim=1)

    for _ in range(steps):
        shading = lights @ harmonics(normals).mT
        albedo = (total(shading, radiance) / (total(shading, shading) + 1e-9)).clamp_min(1e-4)
        residual = radiance - albedo[:, None] * shading
        with torch.no_grad():
            size = residual.abs().masked_fill(~samples.seen, math.nan).flatten(1)
            spread = 1.4826 * size.nanmedian(dim=1).values.nan_to_num(nan=1.0).clamp_min(1e-4)
        weight = inlier / (1 + (residual / (2.385 * spread[:, None, None])).square())
        axes = tangents(normals)
        square = total(shading, shading) + 1e-9
        x, y, r = (
            part - (total(shading, part) / square)[:, None] * shading
            for part in (*(albedo[:, None] * (lights[..., 1:] @ t.mT) for t in axes), residual)
        )
        a, b, c, first, second = total(x, x), total(x, y), total(y, y), total(x, r), total(y, r)
        for mean, pull in ((samples.normals, 0.1), (known.normals, known.normal_weight)):
            force = level[:, None] * pull * albedo.square()
            a, c = a + force, c + force
            first = first + force * ((mean - normals) * axes[0]).sum(dim=-1)
            second = second + force * ((mean - normals) * axes[1]).sum(dim=-1)
        determinant = a * c - b * b + 1e-12
        tilt = torch.stack([c * first - b * second, a * second - b * first]) / determinant
        tilt = tilt * (1 + tilt.square().sum(dim=0) / 0.09).rsqrt()
        moved = normals + tilt[0][..., None] * axes[0] + tilt[1][..., None] * axes[1]
        normals = normalize(moved, dim=-1)
    return normals


def angles(one: Float[Tensor, "*batch 3"], other: Float[Tensor, "*batch 3"]) -> Tensor:
    """Return the angles between unit normals, smooth at zero."""
    return 2 * torch.asin(((one - other).square().sum(dim=-1) + 1e-8).sqrt().clamp_max(1.99) / 2)


def loss_of(part: Solved, known: Known) -> Tensor:
    """Return errors of what is fitted and of what is guessed, and the likelihood of the weight."""
    guess = angles(known.normals, part.truth)[part.known]
    variance = RELATIVE_NOISE**2 / known.normal_weight[part.known]
    likelihood = (guess.square() / variance + variance.log()).mean()
    fit = angles(fitted(part, known), part.truth)[part.known]
    return fit.mean() + 0.3 * guess.mean() + 1e-3 * likelihood


def pretrained(scenes: list[list[Solved]], steps: int, seed: int = 0) -> LearnedPrior:
    """Train through the fit of normals with lights given."""
    torch.manual_seed(seed)
    prior = LearnedPrior()
    with torch.no_grad():  # begin near what is known without: all are inliers, little weight
        prior.of_entry.weight.mul_(0.3)
        prior.of_entry.bias.copy_(torch.tensor([2.0, 0.0, 0.0]))
        prior.of_sample.weight.mul_(0.1)
        prior.of_sample.bias.copy_(torch.tensor([-2.5, 0.0]))
    optimizer = torch.optim.Adam(prior.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        optimizer.zero_grad()
        for _ in range(2):
            scene = scenes[int(torch.randint(len(scenes), (), generator=generator))]
            part = scene[int(torch.randint(len(scene), (), generator=generator))]
            loss = loss_of(part, prior(part.samples))
            loss.backward()
        torch.nn.utils.clip_grad_norm_(prior.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        if step % 500 == 499:
            sys.stdout.write(f"{step + 1} steps, {time.process_time():.0f} s\n")
            sys.stdout.flush()
    return prior


def through(prior: LearnedPrior, kept: Kept) -> Tensor | None:
    """Return the mean error of normals that the factorization finds with the prior, radians."""
    factorize = Factorize(priors=[FieldLights(), SurfaceNormals(), prior])
    found = factorize.solve(kept.seen, kept.light).buckets[0]
    at = kept.known & found.valid
    return angles(found.normals_patch, kept.truth)[at].mean() if bool(at.any()) else None


def finish(prior: LearnedPrior, kept: list[Kept], steps: int, seed: int = 0) -> list[float]:
    """Train on through the factorization; return the loss of every step."""
    optimizer = torch.optim.Adam(prior.parameters(), lr=1e-3)
    generator = torch.Generator().manual_seed(seed)
    losses = []
    for _ in range(steps):
        error = through(prior, kept[int(torch.randint(len(kept), (), generator=generator))])
        if error is None:
            continue
        optimizer.zero_grad()
        error.backward()
        torch.nn.utils.clip_grad_norm_(prior.parameters(), 0.1)
        optimizer.step()
        losses.append(float(error))
    return losses


def errors_deg(parts: list[Solved], prior: LearnedPrior) -> tuple[float, float]:
    """Return mean errors of the normals fitted without and with the prior."""
    before, after = [], []
    with torch.no_grad():
        for part in parts:
            plain = part.samples
            none = Known(
                normals=plain.normals,
                normal_weight=torch.zeros_like(plain.albedo),
                inlier=torch.ones_like(plain.radiance),
            )
            for known, errors in ((none, before), (prior(plain), after)):
                errors.append(angles(fitted(part, known), part.truth)[part.known])
    one, other = (float(torch.rad2deg(torch.cat(errors).mean())) for errors in (before, after))
    return one, other


def main() -> None:
    """Render, run the chain, train, and write the weights."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--last-steps", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    wanted = parser.parse_args()
    warnings.simplefilter("ignore")
    scenes, kept = {}, []
    for name, (shape, changes) in SCENES.items():
        with tempfile.TemporaryDirectory() as folder:
            settings = {"num_views": 10, "width": 200, "height": 150, **changes}
            config = SceneConfig(**settings)  # type: ignore[arg-type]
            own = kept_of(render_scene(shape, Path(folder) / "scene", config, processes=1))
        parts = [part for part in map(solved, own) if part.known.any()]
        scenes[name], kept = parts, kept + own
        sys.stdout.write(f"{name}: {len(parts)} parts, {time.process_time():.0f} s\n")
        sys.stdout.flush()
    prior = pretrained(list(scenes.values()), wanted.steps, wanted.seed)
    save_file(prior.state_dict(), wanted.out)
    losses = finish(prior, kept, wanted.last_steps, wanted.seed)
    save_file(prior.state_dict(), wanted.out)
    for name, parts in scenes.items():
        before, after = errors_deg(parts, prior)
        sys.stdout.write(f"{name}: {before:.2f} without, {after:.2f} degrees with the prior\n")
    sys.stdout.write(f"{len(losses)} last steps, {time.process_time():.0f} s\n")


if __name__ == "__main__":
    main()
