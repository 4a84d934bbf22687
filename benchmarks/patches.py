"""Factorization of many patches: seconds, steps, and the time of reading the data.

    python benchmarks/patches.py [--patches 206] [--views 30] [--samples 3660] [--missing 0.58]

The numbers are those of the published Jar. Patches are random: normals around a facet's, albedo,
first-order lights that are similar in neighbouring views, noise of 1 %, contiguous parts missing
from each view. Initial lights are 0.1 off, and initial normals are the facet's. Robust objectives
use the weights that each solver ended with, and compare solvers only approximately.
"""

import argparse
import resource
import time

import torch
from torch.nn.functional import normalize

from pimper_torch.lighting.light_field import harmonics
from pimper_torch.linalg.robust import Cauchy, Squares
from pimper_torch.stages.photometry.bilinear import Bilinear, evaluate
from pimper_torch.stages.photometry.cone import Cone
from pimper_torch.stages.photometry.factor_solve import SOLVERS

# Weight of the lights' prior relative to the data, and the loss.
CASES = ((1.0, Squares()), (1.0, Cauchy(2.0)), (1e-6, Squares()))
LIMITS = {"variable-projection": 60, "balm": 300}
TOLERANCES = {"variable-projection": 1e-4, "balm": 1e-3}


def main() -> None:
    """Print one row a solver."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--patches", type=int, default=206)
    parser.add_argument("--views", type=int, default=30)
    parser.add_argument("--samples", type=int, default=3660)
    parser.add_argument("--missing", type=float, default=0.58)
    parser.add_argument("--solvers", nargs="+", choices=list(SOLVERS), default=list(SOLVERS))
    options = parser.parse_args()
    radiance, seen, lights, normals, true_normals = draw(
        options.patches, options.views, options.samples, options.missing
    )
    size = radiance.numel() * 5 / 1e6
    bandwidth = measure_bandwidth()
    walk = size / bandwidth
    print(  # noqa: T201
        f"{options.patches} patches of {options.views} views and {options.samples} samples, "
        f"{100 * (1 - seen.double().mean()):.0f} % missing: {size:.0f} MB (5 bytes an entry); "
        f"{torch.get_num_threads()} threads; reading memory {bandwidth:.1f} GB/s, so one walk "
        f"through the matrices {walk:.1f} ms.\n"
    )
    print(  # noqa: T201
        "| solver | lights | loss | s | CPU s | steps | ms a step | over one walk | objective "
        "| normals, deg | at the limit | extra memory, matrices |"
    )
    print("|---|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|")  # noqa: T201
    for name in options.solvers:
        for damping, loss in CASES:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
            began, spent = time.perf_counter(), time.process_time()
            steps, cost, error, limited = 0, 0.0, [], 0
            chunk = max(1, 400_000 // (options.views * options.samples))
            for first in range(0, options.patches, chunk):
                some = torch.arange(first, min(first + chunk, options.patches))
                problem = pose(radiance[some], seen[some], lights[some], normals[some])
                problem = problem.replace(
                    loss=loss, stride=7, regularization=damping * problem.regularization
                )
                found = SOLVERS[name](problem, LIMITS[name], TOLERANCES[name])
                steps += int(found.convergence.iterations.sum())
                ended = (found.lights, found.shading, found.weight)
                cost += float(evaluate(problem, *ended)[0].sum())
                limited += int((~found.convergence.converged).sum())
                _, unit = problem.manifold.split(found.shading.mT)
                cosine = (unit * true_normals[some]).sum(dim=2).clamp(-1, 1)
                error.append(cosine.acos().rad2deg()[seen[some].sum(dim=1) >= 4])
            seconds, cpu = time.perf_counter() - began, time.process_time() - spent
            sweeps = steps / options.patches
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3 - before
            case = f"{name} | {'held' if damping == 1 else 'free'} | {type(loss).__name__}"
            print(  # noqa: T201
                f"| {case} | {seconds:.1f} | {cpu:.1f} | {sweeps:.1f} "
                f"| {1e3 * seconds / sweeps:.0f} | {1e3 * seconds / sweeps / walk:.0f} "
                f"| {cost:.0f} | {torch.cat(error).median():.2f} "
                f"| {limited} | {max(peak, 0) / size:.1f} |",
                flush=True,
            )


def draw(
    patches: int, views: int, samples: int, missing: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return radiance, visibility, initial lights, and the facet's and the true normals."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    radiance = torch.empty(patches, views, samples)
    seen = torch.empty(patches, views, samples, dtype=torch.bool)
    facing = torch.tensor([0.0, 0.0, -1.0])
    true = normalize(facing + 0.25 * normal(patches, samples, 3), dim=-1)
    common = torch.cat([0.5 + normal(views, 1).abs(), 0.6 * normal(views, 3) - facing.abs()], dim=1)
    lights = common + 0.05 * normal(patches, views, 4)
    for patch in range(patches):
        albedo = 0.3 + 0.5 * torch.rand(samples, generator=generator)
        exact = lights[patch] @ (albedo[:, None] * harmonics(true[patch])).mT
        exact = exact + 0.01 * exact.abs().mean() * normal(views, samples)
        away = torch.rand(views, 1, generator=generator)
        place = (torch.arange(samples) / samples + away) % 1
        seen[patch] = (place >= missing) & (exact > 0.02)
        radiance[patch] = torch.where(seen[patch], exact, 0)
    start = lights + 0.1 * normal(patches, views, 4)
    return radiance, seen, start, facing.expand_as(true), true


def pose(
    radiance: torch.Tensor, seen: torch.Tensor, lights: torch.Tensor, normals: torch.Tensor
) -> Bilinear:
    """Pose a chunk as the default does: lights held by as much as the data, geometry a little."""
    weight = seen.to(radiance)
    basis = harmonics(normals).mT
    shade = lights @ basis
    square = (weight * shade**2).sum(dim=1)
    albedo = (weight * shade * radiance).sum(dim=1) / torch.where(square > 0, square, 1)
    shading = albedo.clamp_min(0)[:, None] * basis
    regularization = (weight @ (shading[:, 0] ** 2)[..., None])[..., 0]
    level = lights.square().sum(dim=2).mean(dim=1)
    return Bilinear(
        radiance=radiance,
        weight=weight,
        lights=lights,
        prior_mean=lights,
        shading=shading,
        regularization=regularization,
        prior=0.1 * level[:, None, None] * Cone().normal_prior(normals.mT),
    )


def measure_bandwidth() -> float:
    """Return GB/s of reading a tensor that no cache holds."""
    large = torch.ones(64_000_000)
    best = 0.0
    for _ in range(5):
        began = time.perf_counter()
        large.sum()
        best = max(best, large.numel() * 4 / 1e9 / (time.perf_counter() - began))
    return best


if __name__ == "__main__":
    main()
