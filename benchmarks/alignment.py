"""Alignment of many patches: remaining error, seconds and peak memory.

    python benchmarks/alignment.py [--facets 5000] [--side 60] [--noise 0.0]

Facets of a subdivided icosahedron on a sphere with bumps of a facet's size. Every patch has the
exact height field, changed by a random bas-relief transform: tilts of 0.15, scales of a factor 1.4,
offsets of a fiftieth of an edge, one standard deviation each. ``--what scale`` changes scales only.
``--noise`` adds waves of a quarter edge's length to each patch, as fractions of the height field's
root mean square. Times are the best of ``--repeat`` runs; memory is the peak above the process's
size before the run.
"""

import argparse
import resource
import time
from collections.abc import Callable

import torch
import trimesh
from torch import Tensor

from pimper_torch.geometry.rigid import invert_rigid, transform
from pimper_torch.paper.align import Align
from pimper_torch.records import (
    Cameras,
    CoarseMesh,
    Convergence,
    DepthPatches,
    Depths,
    Mesh,
    PatchSet,
    PhotometricPatches,
    Photometry,
    Templates,
)
from pimper_torch.stages.patches.decompose import Decompose
from pimper_torch.stages.patches.patches_config import DecomposeConfig

# Wavelength over 2 pi and height of the bumps: slopes of 0.3 over an edge of 0.06.
BUMP = (0.03, 0.008)


def main() -> None:
    """Print a row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--facets", type=int, default=5000)
    parser.add_argument("--side", type=int, default=60)
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--what", choices=["bas-relief", "scale"], default="bas-relief")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    generator = torch.Generator().manual_seed(0)
    patches = sphere_patches(options.facets, options.side)
    truth = with_height_field(patches, bumpy_height_field)
    transforms = random_transforms(patches.num_patches, truth, generator)
    if options.what == "scale":
        transforms[:, [0, 1, 3]] = 0
    bad = spoil(truth, transforms)
    if options.noise > 0:
        bad = add_waves(bad, options.noise * rms(truth), generator)
    sizes = [bucket.depth.shape[1:] for bucket in patches.buckets]
    samples = sum(bucket.depth.numel() for bucket in patches.buckets) / patches.num_patches
    print(  # noqa: T201
        f"{patches.num_patches} patches of {samples**0.5:.0f} x {samples**0.5:.0f} samples "
        f"({len(sizes)} buckets), {torch.get_num_threads()} threads, "
        f"height fields off by {100 * error(bad, truth):.1f} % of their own size\n"
    )
    print("| s | CPU s | extra memory, MB | error before, % | after, % | scale, % off |")  # noqa: T201
    print("|--:|--:|--:|--:|--:|--:|")  # noqa: T201
    before = peak_mb()
    seconds, cpu = float("inf"), float("inf")
    for _ in range(options.repeat):
        began, spent = time.perf_counter(), time.process_time()
        found = Align()(bad)
        seconds = min(seconds, time.perf_counter() - began)
        cpu = min(cpu, time.process_time() - spent)
    off = scales(found) / scales(truth) - 1  # transforms chain
    print(  # noqa: T201
        f"| {seconds:.1f} | {cpu:.1f} | {peak_mb() - before:.0f} "
        f"| {100 * error(bad, truth):.1f} | {100 * error(found, truth):.2f} "
        f"| {100 * off.abs().median():.1f} |",
        flush=True,
    )


def sphere_patches(facets: int, side: int) -> PatchSet:
    """Decompose part of a subdivided icosahedron so that templates have about a size."""
    levels = 0
    while 20 * 4**levels < facets:
        levels += 1
    ball = trimesh.creation.icosphere(subdivisions=levels)
    directions = torch.from_numpy(ball.vertices.copy())
    vertices = directions
    for _ in range(30):
        ripple = torch.sin(vertices / BUMP[0]).sum(dim=1, keepdim=True)
        vertices = directions * (1 + BUMP[1] * ripple) / 2 + vertices / 2
    vertices = vertices.float()
    faces = torch.from_numpy(ball.faces.copy()).long()[:facets]
    edge = (vertices[faces[:, 0]] - vertices[faces[:, 1]]).norm(dim=-1).mean()
    overlap = 6.0
    # Rasters are as wide as an enlarged triangle in any direction: about its side.
    spacing = edge / (side - 2 * 3**0.5 * overlap)
    cam_from_world = torch.eye(4)[None].clone()
    cam_from_world[0, 2, 3] = 10.0
    focal = 10.0 / spacing
    cameras = Cameras(
        intrinsics=torch.tensor([[[focal, 0, 0], [0, focal, 0], [0, 0, 1]]]),
        cam_from_world=cam_from_world,
        sizes_px=torch.tensor([[100, 100]]),
    )
    coarse = CoarseMesh(
        mesh=Mesh(vertices_world=vertices, faces=faces),
        reference=0,
        is_point=torch.ones(len(vertices), dtype=torch.bool),
    )
    return Decompose(DecomposeConfig(overlap_samples=overlap))(coarse, cameras)


def bumpy_height_field(templates: Templates) -> Tensor:
    """Return the near side of a unit sphere with bumps, along each patch's z, by Newton's steps."""
    world_from_patch = invert_rigid(templates.patch_from_world.double())
    flat = templates.points_patch.double().flatten(1, 2)
    along = world_from_patch[:, None, :3, 2]
    depth = torch.zeros_like(flat[..., 0])
    wave, height = BUMP
    for _ in range(12):
        points = transform(world_from_patch, torch.cat([flat[..., :2], depth[..., None]], dim=-1))
        phase = points / wave
        ripple = torch.sin(phase)
        radius = points.norm(dim=-1)
        gap = radius - 1 - height * ripple.sum(dim=-1)
        slope = points / radius[..., None] - height / wave * torch.cos(phase)
        depth = depth - gap / (slope * along).sum(dim=-1).clamp_max(-0.3)
    return depth.reshape(templates.depth.shape).to(templates.depth)


def with_height_field(
    patches: PatchSet, height_field: Callable[[Templates], Tensor]
) -> DepthPatches:
    """Return every patch its height field, and photometry that says nothing."""
    height_fields, photometry = [], []
    for templates in patches.buckets:
        depth = height_field(templates)
        count, height, width = depth.shape
        one = depth.new_ones(count)
        height_fields.append(
            Depths(
                depth=depth,
                valid=templates.inside,
                transform=depth.new_tensor([0, 0, 1, 0]).expand(count, 4),
            )
        )
        photometry.append(
            Photometry(
                normals_patch=depth.new_tensor([0, 0, -1]).expand(count, height, width, 3),
                albedo=depth.new_ones(1).expand(count, height, width, 1),
                lights_patch=depth.new_ones(count, 1, 4),
                valid=templates.inside,
                information=depth.new_ones(1).expand(count, height, width),
                status=0 * one.long(),
                convergence=Convergence(
                    iterations=one.long(), residual=0 * one, cause=0 * one.long()
                ),
            )
        )
    return DepthPatches(
        photometric=PhotometricPatches(patches=patches, buckets=tuple(photometry)),
        buckets=tuple(height_fields),
    )


def random_transforms(count: int, depths: DepthPatches, generator: torch.Generator) -> Tensor:
    """Draw ``(h_x, h_y, h_z, h_0)`` for every facet."""
    mesh = depths.patches.coarse.mesh
    ends = mesh.vertices_world[mesh.faces[:, :2]]
    edge = (ends[:, 0] - ends[:, 1]).norm(dim=-1).mean()
    draw = torch.randn(count, 4, generator=generator)
    shifts = edge / 50 * draw[:, 3:]
    return torch.cat([0.15 * draw[:, :2], (0.35 * draw[:, 2:3]).exp(), shifts], dim=1)


def spoil(depths: DepthPatches, transforms: Tensor) -> DepthPatches:
    """Apply transforms to all patches."""
    buckets = []
    for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        own = transforms[templates.facet]
        hx, hy, hz, h0 = own[:, :, None, None].unbind(dim=1)
        depth = hx * x + hy * y + hz * height_field.depth + h0
        buckets.append(height_field.replace(depth=depth, transform=own))
    return depths.replace(buckets=tuple(buckets))


def add_waves(depths: DepthPatches, amplitude: float, generator: torch.Generator) -> DepthPatches:
    """Add waves of its own to every patch, about a quarter of its facet's edge long."""
    buckets = []
    for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        length = templates.spacing[:, None, None] * 10 / (2 * torch.pi)
        waves = torch.zeros_like(x)
        for _ in range(6):
            fx, fy, start = torch.randn(3, len(x), 1, 1, generator=generator)
            waves = waves + torch.cos((fx * x + fy * y) / length + 9 * start)
        buckets.append(height_field.replace(depth=height_field.depth + amplitude * waves / 3**0.5))
    return depths.replace(buckets=tuple(buckets))


def error(found: DepthPatches, truth: DepthPatches) -> float:
    """Return the root mean square error, as a fraction of the height field's own."""
    pairs = zip(found.buckets, truth.buckets, strict=True)
    square = torch.cat([(a.depth - b.depth)[b.valid].square() for a, b in pairs])
    return float(square.mean().sqrt()) / rms(truth)


def rms(depths: DepthPatches) -> float:
    """Return the root mean square of the height fields about each patch's mean plane's height."""
    return float(torch.cat([b.depth[b.valid].square() for b in depths.buckets]).mean().sqrt())


def scales(depths: DepthPatches) -> Tensor:
    """Return ``h_z`` of every patch, in the order of the buckets."""
    return torch.cat([height_field.transform[:, 2] for height_field in depths.buckets])


def peak_mb() -> float:
    """Return the highest resident memory of the process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


if __name__ == "__main__":
    main()
