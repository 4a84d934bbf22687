"""Compare coarse surfaces of a rendered scene, with true masks.

    python benchmarks/studies/coarse.py SCENE [SCENE ...] [--cache DIR]

SCENE is a folder that ``pimper render`` wrote. Cameras are estimated without masks. Each surface is
simplified to the number of facets of ``default`` and compared with the truth before the first pass.
In the reference view: the fraction of the object's pixels that it covers, the 3D error and the
normals of its shape. In percent of the diagonal: accuracy, and completeness of the surface that
three views see.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.metrics import pair_views, similarity_between_cameras, transfer
from pimper_bench.metrics.in_view import compare_along_rays
from pimper_bench.metrics.surface_distances import TrueSurface
from pimper_torch.geometry.contours import Contours
from pimper_torch.geometry.poisson import reduced
from pimper_torch.geometry.rigid import transform
from pimper_torch.geometry.undistortion import undistorted
from pimper_torch.io.photographs import load_views
from pimper_torch.records import Mesh, Silhouettes, SparseScene
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.coarse.fine_surface import (
    REACH_PX,
    TOLERANCE_PX,
    closed_surface,
    cropped,
    poisson,
)
from pimper_torch.stages.coarse.oriented import matched_cloud
from pimper_torch.stages.coarse.reference import reference_view
from pimper_torch.stages.coarse.surface import CoarseSurface, reliable_points
from pimper_torch.stages.coarse.trim import (
    CELL_PX,
    seen_surface,
    supports,
    view_counts,
)
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.silhouettes.trace import TraceContours

Surface = tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--cache", type=Path, help="folder where structure from motion is kept")
    options = parser.parse_args()
    warnings.simplefilter("ignore", PimperWarning)
    sys.stdout.write(
        "| scene | way | met % | 3D error % | normals °, mean (median) | accuracy % "
        "| completeness % | CPU s |\n|---|---|--:|--:|--:|--:|--:|--:|\n"
    )
    for folder in options.scenes:
        scene = Reconstruct(cache=options.cache)(load_views(folder / "photos"))
        judge = Judge(folder, scene)
        for name, way in ways(scene, masks_of(folder, scene)).items():
            began = time.process_time()
            vertices, faces = way()
            seconds = time.process_time() - began
            row = f"| {folder.name} | {name} | {judge(vertices, faces)} | {seconds:.0f} |\n"
            sys.stdout.write(row)
            sys.stdout.flush()


def masks_of(folder: Path, scene: SparseScene) -> Silhouettes:
    """Read the true masks, undistorted as the photographs are."""
    views = load_views(folder / "photos", masks=folder / "masks")
    views = views.take([views.names.index(name) for name in scene.views.names])
    inside = torch.zeros_like(views.images[:, 0])
    for view, (_, mask) in enumerate(undistorted(views, scene.lenses)):
        inside[view, : mask.shape[0], : mask.shape[1]] = mask.to(inside)
    reliable = torch.ones(len(inside), dtype=torch.bool)
    return Silhouettes(inside=inside, reliable=reliable, source="masks")


def ways(scene: SparseScene, silhouettes: Silhouettes) -> dict[str, Callable[[], Surface]]:
    """List the surfaces to compare; the later ones share results of the photographs."""
    builder = CoarseSurface()
    contours = TraceContours()(silhouettes, scene.cameras)
    hull = contours.hull
    reliable = reliable_points(scene)
    inside = reliable[hull.depth_of(scene.points_world[reliable]) > 0]
    part = cropped(scene, silhouettes)
    cloud, maps, pixel = matched_cloud(part, inside, builder.config.levels)
    away, cell = TOLERANCE_PX * pixel, CELL_PX * pixel
    cloud = cloud.take(hull.depth_of(cloud.points_world) > -away)
    vertices, faces, contour = closed_surface(cloud, contours, pixel)

    def given(masked: bool) -> Surface:
        some = scene.replace(views=scene.views.replace(masks=silhouettes.masks if masked else None))
        free = Contours.none(Silhouettes.everything(some.views), some.cameras)
        found = builder(some, free).mesh
        return found.vertices_world, found.faces

    def facets(some: Surface) -> Surface:
        vertices, faces = some
        reach = REACH_PX * pixel
        counts = view_counts(vertices, faces, maps.level, maps, cloud.points_world, reach)
        centre = vertices[faces].mean(dim=1)
        support = supports(centre, cloud, contour, counts, reach)
        within = hull.depth_of(centre) > -max(away, float(hull.spacing))
        kept = seen_surface(vertices, faces, support, counts, within, pixel, 0.01)
        used, faces = torch.unique(faces[kept], return_inverse=True)
        mesh = Mesh(vertices_world=vertices[used], faces=faces)
        few = reduced(mesh, builder.config.num_facets)
        return few.vertices_world, few.faces

    return {
        "no silhouettes": lambda: given(False),
        "no silhouettes, photographs masked": lambda: given(True),
        "Poisson of points": lambda: facets(poisson(cloud, cell)),
        "Poisson of points and contours": lambda: facets((vertices, faces)),
    }


class Judge:
    """The truth of a scene, to compare with."""

    def __init__(self, folder: Path, scene: SparseScene) -> None:
        capture = read_rendered(folder, maps=False, photographs=False)
        assert capture.cameras is not None  # a rendered scene has them
        ours, theirs = pair_views(scene.views.names, capture.views.names)
        self._truth_from_world = similarity_between_cameras(
            scene.cameras.take(ours.tolist()), capture.cameras.take(theirs.tolist())
        ).double()
        view = capture.views.names.index(scene.views.names[reference_view(scene)])
        self._maps = read_rendered(folder, views=[view], photographs=False)
        self._surface = TrueSurface(capture, samples=50_000)

    def __call__(self, vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> str:
        """Return a row's figures."""
        mesh = Mesh(vertices_world=vertices.double(), faces=faces)
        seen = compare_along_rays(transfer(mesh, self._truth_from_world), self._maps, 0)
        moved = transform(self._truth_from_world, mesh.vertices_world)
        found = self._surface.compare(mesh.replace(vertices_world=moved))
        assert seen is not None
        assert seen.shape_normals is not None
        normals = f"{seen.shape_normals.mean_deg:.1f} ({seen.shape_normals.median_deg:.1f})"
        near = "-" if found.accuracy is None else f"{found.accuracy.mean_percent:.2f}"
        full = "-" if found.seen is None else f"{found.seen.completeness.mean_percent:.2f}"
        met = f"{100 * seen.coverage:.1f} | {seen.relative_error:.1f}"
        return f"{met} | {normals} | {near} | {full}"


if __name__ == "__main__":
    main()
