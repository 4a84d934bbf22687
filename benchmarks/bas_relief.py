"""Compare resolvers of the bas-relief ambiguity of uncalibrated photometric stereo.

    python benchmarks/bas_relief.py [--size 64] [--scenes 8]

Prints Markdown tables of mean normal errors in degrees: the median over scenes, with the worst in
brackets. Scenes are balls and bumps in five colours by regions or in one, under random point
lights. Shading is fitted with the true lights to values out of shadow, then transformed by a random
bas-relief, so the tables show the resolvers alone. `best` is the height field nearest to the truth.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable

import torch
from one_view import OneView, photograph, point_lights
from reliefs import align_reliefs, ball, bumps, bumps_in_perspective, regions
from torch import Tensor

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo.albedo_entropy import (
    chromaticity_groups,
    resolve_by_albedo_entropy,
)
from pimper_torch.single_view.photometric_stereo.perspective import factorize_in_perspective

NOISES = (0.0, 0.005, 0.01)
VIEWS = (10, 20)
# Values below this fraction of the brightest are left out as shadow.
DARK = 0.03

Resolver = Callable[[OneView, Tensor, Tensor], BasRelief]


def entropy_and_colour(made: OneView, shading: Tensor, _: Tensor) -> BasRelief:
    """Minimise the entropy of albedo within groups of one chromaticity."""
    return resolve_by_albedo_entropy(shading, chromaticity_groups(made.images[:, :, made.mask]))


RESOLVERS: dict[str, Resolver] = {
    "entropy": lambda _, shading, __: resolve_by_albedo_entropy(shading),
    "entropy + colour": entropy_and_colour,
}


def error_deg(shading: Tensor, normals: Tensor, known: Tensor) -> float:
    """Return the mean angle over the pixels that have a vector."""
    cross = torch.linalg.cross(shading, normals, dim=0).norm(dim=0)
    angle = torch.rad2deg(torch.atan2(cross, (shading * normals).sum(dim=0)))
    return float(angle[known].mean())


def paint(name: str, size: int, generator: torch.Generator) -> Tensor:
    """Return albedo: five colours, five greys, or one grey."""
    if name == "one":
        return torch.full((size, size, 3), 0.6, dtype=torch.float64)
    colours = regions(size, generator)
    return colours if name == "colours" else colours.mean(dim=2, keepdim=True).expand(-1, -1, 3)


def scene(
    shape: str, name: str, size: int, views: int, noise: float, seed: int
) -> tuple[OneView, torch.Generator]:
    """Draw one scene."""
    generator = torch.Generator().manual_seed(seed)
    normals, mask = ball(size) if shape == "ball" else bumps(size, generator)
    albedo = paint(name, size, generator)
    made = photograph(normals, albedo, mask, point_lights(views, generator), generator, noise)
    return made, generator


def fitted(made: OneView) -> tuple[Tensor, Tensor]:
    """Fit shading with the true lights; also return which pixels have at least four values."""
    values = made.images.sum(dim=1)[:, made.mask]
    lit = (values > DARK * values.max()).double()
    known = lit.sum(dim=0) >= 4
    normal = torch.einsum("vi,vp,vj->pij", made.lights, lit, made.lights)
    rhs = torch.einsum("vi,vp->pi", made.lights, lit * values)
    normal = normal + 1e-12 * torch.eye(3, dtype=torch.float64)
    return torch.where(known, torch.linalg.solve(normal, rhs).mT, 0), known


def hidden(generator: torch.Generator) -> BasRelief:
    """Draw a bas-relief: tilts of about a half, flattened or deepened by about a half."""
    mu, nu, log = 0.5 * torch.randn(3, generator=generator, dtype=torch.float64)
    return BasRelief(mu=mu, nu=nu, lam=log.exp())


def summary(errors: list[float]) -> str:
    """Write median and worst; refusals, which are not numbers, are counted."""
    numbers = [one for one in errors if not math.isnan(one)]
    refused = len(errors) - len(numbers)
    text = f"{statistics.median(numbers):.2f} ({max(numbers):.1f})" if numbers else "none"
    return text + (f", {refused} refused" if refused else "")


def resolved(shape: str, name: str, size: int, scenes: int) -> None:
    """Print the table of one family of scenes."""
    print(f"\n{shape}, {name}\n")  # noqa: T201
    columns = ["views", "noise %", "before", *RESOLVERS, "best"]
    print("| " + " | ".join(columns) + " |\n|" + "--:|" * len(columns))  # noqa: T201
    seconds = dict.fromkeys(RESOLVERS, 0.0)
    for views in VIEWS:
        for noise in NOISES:
            errors: dict[str, list[float]] = {column: [] for column in columns[2:]}
            for seed in range(scenes):
                made, generator = scene(shape, name, size, views, noise, seed)
                shading, known = fitted(made)
                height_field = hidden(generator)
                b, lights = height_field.on_shading(shading), height_field.on_lights(made.lights)
                errors["before"].append(error_deg(b, made.normals, known))
                nearest = align_reliefs(b, made.shading, known.double())
                errors["best"].append(error_deg(nearest.on_shading(b), made.normals, known))
                for label, resolve in RESOLVERS.items():
                    began = time.process_time()
                    try:
                        found = resolve(made, b, lights).on_shading(b)
                        errors[label].append(error_deg(found, made.normals, known))
                    except InputError:
                        errors[label].append(math.nan)
                    seconds[label] += time.process_time() - began
            cells = [summary(values) for values in errors.values()]
            print(f"| {views} | {100 * noise:g} | " + " | ".join(cells) + " |", flush=True)  # noqa: T201
    runs = len(VIEWS) * len(NOISES) * scenes
    cost = ", ".join(f"{label} {spent / runs:.2f}" for label, spent in seconds.items())
    print(f"\nCPU seconds a scene: {cost}.")  # noqa: T201


def in_perspective(size: int, scenes: int) -> None:
    """Print the table of factorizations in perspective, shadows left out."""
    print("\nbumps in perspective, colours\n")  # noqa: T201
    fields = (20.0, 40.0, 60.0)
    head = ["views", "noise %", *(f"{field:g}°" for field in fields), "lights known"]
    print("| " + " | ".join(head) + " |\n|" + "--:|" * len(head))  # noqa: T201
    for views in VIEWS:
        for noise in NOISES:
            errors: dict[str, list[float]] = {label: [] for label in head[2:]}
            for seed in range(scenes):
                for field in fields:
                    generator = torch.Generator().manual_seed(seed)
                    normals, mask, intrinsics, _ = bumps_in_perspective(size, generator, field)
                    albedo, lights = regions(size, generator), point_lights(views, generator)
                    made = photograph(normals, albedo, mask, lights, generator, noise)
                    values = made.images.sum(dim=1)[:, made.mask]
                    shading, known = fitted(made)
                    if field == fields[1]:
                        floor = error_deg(shading, made.normals, known)
                        errors["lights known"].append(floor)
                    seen = values > DARK * values.max()
                    try:
                        found, _ = factorize_in_perspective(made.images, mask, intrinsics, seen)
                        errors[f"{field:g}°"].append(error_deg(found, made.normals, known))
                    except InputError:
                        errors[f"{field:g}°"].append(math.nan)
            cells = [summary(values) for values in errors.values()]
            print(f"| {views} | {100 * noise:g} | " + " | ".join(cells) + " |", flush=True)  # noqa: T201


def main() -> None:
    """Print all tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--scenes", type=int, default=8)
    options = parser.parse_args()
    for name in ("colours", "greys", "one"):
        for shape in ("ball", "bumps"):
            resolved(shape, name, options.size, options.scenes)
    in_perspective(options.size, options.scenes)


if __name__ == "__main__":
    main()
