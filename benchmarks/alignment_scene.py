"""Alignment and refinement on a rendered sequence: depth and normals in the reference view.

    python benchmarks/alignment_scene.py FOLDER

The chain runs once from the photographs to the height fields, with cameras from structure from
motion; then each row aligns and refines the same height fields. Depth errors are distances along
the rays of the reference view in per cent of the object's extent: their median, the mean of
those below 3 %, and the fraction above. Normals are those of the mesh's shape, in degrees.
"""

import argparse
from pathlib import Path

import torch
from torch.nn.functional import normalize

from pimper_torch.chains.published import Published, PublishedConfig
from pimper_torch.config import build
from pimper_torch.evidence.datasets import read_rendered
from pimper_torch.evidence.metrics import pair_views, similarity_between_cameras
from pimper_torch.evidence.metrics.relative import angles_deg, meet_in_view
from pimper_torch.geometry.frames import rotate
from pimper_torch.geometry.surfaces import vertex_normals
from pimper_torch.io.photographs import load_views
from pimper_torch.meshing.extract import Extract
from pimper_torch.paper.alignment.align import Align, AlignConfig
from pimper_torch.paper.refinement.refine import Refine, RefineConfig
from pimper_torch.records import Capture, DepthPatches, Mesh, SparseScene

# The chain that aligns patches, whose figures the README gives.
SETTINGS = {
    "decompose": {"overlap_samples": 6.0, "max_samples": float("inf")},
    "factorize": {"loss_scale": 2.0, "shadows": False},
    "extract": {"max_hole": 0.2, "overturned": "all", "min_piece": 1.0},
}

CASES: dict[str, tuple[AlignConfig | None, RefineConfig]] = {
    "not aligned": (None, RefineConfig()),
    "default: bas-relief": (AlignConfig(), RefineConfig()),
    "without points between vertices": (AlignConfig(points=0.0), RefineConfig()),
    "without k": (AlignConfig(curvature=False), RefineConfig()),
    "without offset": (AlignConfig(offset=False), RefineConfig()),
}

FAR = 3.0


def main() -> None:
    """Print one row a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", choices=list(CASES), default=list(CASES))
    options = parser.parse_args()
    truth = read_rendered(options.folder, photographs=False)
    masks = options.folder / "masks"
    views = load_views(options.folder / "photos", masks=masks if masks.exists() else None)
    pimper = Published(build(PublishedConfig, SETTINGS, __file__))
    scene = pimper.reconstruct(views)
    patches = pimper.decompose(pimper.triangulate(scene), scene.cameras)
    seen = pimper.warp(scene.views, scene.cameras, patches)
    depths = pimper.integrate(pimper.factorize(seen))
    print("| case | depth, median % | mean | far, % | normals, median ° | mean ° | on mesh |")  # noqa: T201
    print("|---|--:|--:|--:|--:|--:|--:|")  # noqa: T201
    for name in options.only:
        align, refine = CASES[name]
        aligned = depths if align is None else Align(align)(depths)
        mesh = Extract(pimper.config.extract)(Refine(refine)(aligned))
        left = sum(int((~bucket.aligned).sum()) for bucket in aligned.buckets)
        print(f"| {name} | {compare(mesh, aligned, scene, truth)} | {left} |", flush=True)  # noqa: T201


def compare(mesh: Mesh, depths: DepthPatches, scene: SparseScene, truth: Capture) -> str:
    """Give the figures of one mesh."""
    reference = scene.views.names[depths.patches.coarse.reference]
    view = truth.views.names.index(reference)
    ours, theirs = pair_views(scene.views.names, truth.views.names)
    cameras, depth, normals = truth.cameras, truth.truth.depth, truth.truth.normals_world
    assert cameras is not None, "rendered scenes have cameras"
    assert depth is not None, "rendered scenes have depth"
    assert normals is not None, "rendered scenes have normals"
    truth_from_world = similarity_between_cameras(
        scene.cameras.take(ours.tolist()), cameras.take(theirs.tolist())
    ).to(mesh.vertices_world)
    foreground = truth.truth.foreground
    met = meet_in_view(
        mesh,
        truth_from_world,
        cameras,
        view,
        depth[view],
        None if foreground is None else foreground[view],
    )
    extent = (met.points_true.amax(dim=0) - met.points_true.amin(dim=0)).norm()
    away = 100 * (met.points - met.points_true).norm(dim=1) / extent
    own = rotate(truth_from_world, vertex_normals(mesh.vertices_world, mesh.faces))
    angles = angles_deg(
        normalize(met.interpolate(own).double(), dim=-1), normals[view][met.both].double()
    )
    near = away < FAR
    return (
        f"{away.median():.3f} | {away[near].mean():.3f} "
        f"| {100 * (~near).to(torch.float64).mean():.1f} "
        f"| {angles.median():.2f} | {angles.mean():.2f}"
    )


if __name__ == "__main__":
    main()
