"""Measure a carton: the flatness of its sides, and their angles.

    python benchmarks/carton.py MESH.ply [--band 0.02]
    python benchmarks/carton.py --data FOLDER [--preset default] [--reference NAME] [--out DIR]
        [--views 15] [--max-size 0]

FOLDER is an LLFF set (``poses_bounds.npy``, ``images``, masks) with its cloud in ``pts.pkl``. The
cloud has no tracks: a point is observed, at its projection, by the views that the surface around it
faces. With ``--sfm`` structure from motion runs on the photographs instead. ``--model DIR`` writes
the photographs, their masks, their known cameras and the cloud with those tracks as a COLMAP model,
and stops: ``pimper reconstruct DIR/images --masks DIR/masks --sparse DIR/sparse/0``.
"""

import argparse
import pickle
import time
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from PIL import Image
from planarity import dihedrals, planar_faces
from scipy.spatial import cKDTree
from sides import drawn, far_apart, square_round
from torch import Tensor

from pimper_bench.datasets import read_llff, write_colmap
from pimper_bench.truth import Capture
from pimper_torch.export.picture_files import file_names
from pimper_torch.geometry.projection import project
from pimper_torch.io.meshes import read_mesh, write_ply
from pimper_torch.paper.paper_config import PublishedConfig
from pimper_torch.presets.load_chain import load_chain
from pimper_torch.presets.load_config import load_config
from pimper_torch.records import CameraModel, Cameras, Mesh, SparseScene
from pimper_torch.runtime.errors import InputError
from pimper_torch.stages.sfm.sparse_scene import write_model
from pimper_torch.stages.stage import Given
from pimper_torch.viz.render import crop

# A point of the object is inside this fraction of the views' masks, which were drawn independently
# and miss a pixel of the contour in places.
IN_MASKS = 0.9

# Neighbours for the plane fitted at a point, and the minimum cosine between its normal and a view.
NEIGHBOURS, MIN_FACING = 16, 0.25

# Angles further from right than this belong to the gable; and only sides with this fraction of the
# area that is flat are walls, whose angles are averaged.
RIGHT, WALL = 10.0, 0.12


class Arrays(pickle.Unpickler):
    """Reads arrays only, because a pickle can run any program."""

    def find_class(self, module: str, name: str) -> object:
        """Return the classes that arrays consist of."""
        if module.split(".")[0] == "numpy" and name in ("_reconstruct", "ndarray", "dtype"):
            return super().find_class(module, name)
        raise InputError(f"{module}.{name} in a pickle; needed: an array of numbers alone.")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("mesh", nargs="*", type=Path)
    parser.add_argument("--band", type=float, default=0.02)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--reference", default="")
    parser.add_argument("--num-points", type=int, default=250)
    parser.add_argument("--views", type=int, default=0)
    parser.add_argument("--max-size", type=int, default=0)
    parser.add_argument("--sfm", action="store_true")
    parser.add_argument("--model", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    for path in options.mesh:
        print(f"\n{path}\n")  # noqa: T201
        report(read_mesh(path), options.band)
    if options.data is None:
        return
    capture = read_llff(options.data, max_size_px=options.max_size)
    if options.model is not None:
        write_colmap_model(carton_scene(options.data, capture), options.model)
        return
    named = {"reference": options.reference}
    changes: dict[str, object] = {"coarse_surface": named}
    if isinstance(load_config(options.preset), PublishedConfig):
        changes["triangulate"] = named | {"num_points": options.num_points}
    pimper = load_chain(options.preset, changes)
    views = capture.views
    if not options.sfm:
        scene = carton_scene(options.data, capture, options.reference, options.views)
        pimper.reconstruct, views = Given(scene), scene.views
    began = time.perf_counter()
    result = pimper(views)
    seconds = time.perf_counter() - began
    name = result.scene.views.names[result.coarse.reference]
    print(  # noqa: T201
        f"{len(result.scene.views.names)} views, {len(result.scene.points_world)} points, "
        f"reference {name}, {len(result.coarse.mesh.faces)} facets, {seconds:.0f} s"
    )
    for title, mesh in (("facets", result.coarse.mesh), ("surface", result.mesh)):
        print(f"\n{title}\n")  # noqa: T201
        report(mesh, options.band)
        if options.out is not None:
            options.out.mkdir(parents=True, exist_ok=True)
            write_ply(mesh, options.out / f"{title}.ply")
    if options.out is not None:
        draw(result.mesh, result.cameras, options.out / "sides.jpg")


def draw(mesh: Mesh, cameras: Cameras, path: Path, sides: int = 6, width: int = 330) -> None:
    """Draw the surface from several sides, shape alone."""
    vertices = mesh.vertices_world
    row = []
    for view in far_apart(cameras, vertices.mean(dim=0), 0, sides).tolist():
        camera = cameras.take([view])
        row.append(drawn(mesh, crop(camera, *square_round(vertices, camera), width)))
    Image.fromarray(np.concatenate(row, axis=1)).save(path, quality=85)


def report(mesh: Mesh, band: float) -> None:
    """Print how flat each side is, and the angles between those that meet."""
    sides = planar_faces(mesh, torch.Generator().manual_seed(0), band=band)
    total = sum(side.area for side in sides)
    print("| side | area, % | sides | off plane, RMS % of edge | 95 % within |")  # noqa: T201
    print("|--:|--:|--:|--:|--:|")  # noqa: T201
    for number, side in enumerate(sides):
        print(  # noqa: T201
            f"| {number} | {100 * side.area / total:.0f} | {side.sides[0]:.3f} x "
            f"{side.sides[1]:.3f} | {100 * side.rms / side.edge:.3f} "
            f"| {100 * side.p95 / side.edge:.3f} |"
        )
    print("\n| sides | angle, ° | off 90° |")  # noqa: T201
    print("|---|--:|--:|")  # noqa: T201
    off = []
    for each in dihedrals(mesh, sides):
        miss = each.angle_deg - 90
        right = abs(miss) <= RIGHT
        walls = min(sides[each.one].area, sides[each.other].area) >= WALL * total
        off += [abs(miss)] if right and walls else []
        shown = f"{miss:+.2f}" if right else "(no right angle)"
        print(f"| {each.one}, {each.other} | {each.angle_deg:.2f} | {shown} |")  # noqa: T201
    if sides:
        edge = sum(side.rms / side.edge * side.area for side in sides) / total
        angles = f", angles of walls off by {np.mean(off):.2f}° in the mean" if off else ""
        print(f"\nFlat to {100 * edge:.3f} % of the edge (RMS, by area){angles}.")  # noqa: T201


def read_cloud(folder: Path) -> Float[Tensor, "point 3"]:
    """Read ``pts.pkl``, an array and nothing else."""
    path = folder / "pts.pkl"
    with path.open("rb") as file:
        points = Arrays(file).load()
    if not isinstance(points, np.ndarray) or points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"{path}: holds {type(points)}; needed: an array of shape (points, 3).")
    return torch.from_numpy(points.astype(np.float64))


def on_object(cloud: Float[Tensor, "point 3"], capture: Capture) -> Bool[Tensor, " point"]:
    """Mark points inside the masks of nearly all views whose frame contains them."""
    _, framed, masked = _looked_at(cloud, capture)
    return (masked & framed).sum(dim=0) >= IN_MASKS * framed.sum(dim=0).clamp_min(1)


def carton_scene(
    folder: Path, capture: Capture, reference: str = "", num_views: int = 0
) -> SparseScene:
    """Return known cameras, and the cloud with predicted tracks, as the chain takes them.

    Args:
        folder: Of the set.
        capture: Read from it.
        reference: Name of a photograph; with ``num_views`` those nearest to it stay.
        num_views: How many photographs to keep; 0 is all.
    """
    cameras, views = cameras_of(capture), capture.views
    cloud = read_cloud(folder)
    cloud = cloud[on_object(cloud, capture)]
    _, near = cKDTree(cloud.numpy()).query(cloud.numpy(), k=NEIGHBOURS)
    around = cloud[torch.from_numpy(near)]
    offset = around - around.mean(dim=1, keepdim=True)
    normals = torch.linalg.eigh(offset.mT @ offset).eigenvectors[:, :, 0]
    outward = ((cloud - cloud.mean(dim=0)) * normals).sum(dim=1, keepdim=True).sign()
    normals = normals * outward
    pixels, framed, masked = _looked_at(cloud, capture)
    to_camera = cameras.centers_world[:, None] - cloud
    facing = (to_camera * normals).sum(dim=-1) / to_camera.norm(dim=-1)
    seen = framed & masked & (facing > MIN_FACING)
    if num_views:
        names = list(views.names)
        centre = names.index(reference) if reference else len(names) // 2
        axes = cameras.cam_from_world[:, 2, :3]
        chosen = (axes @ axes[centre]).argsort(descending=True)[:num_views].sort().values.tolist()
        views, cameras = views.take(chosen), cameras.take(chosen)
        pixels, seen = pixels[chosen], seen[chosen]
    kept = seen.sum(dim=0) >= 3
    point, view = seen[:, kept].T.nonzero(as_tuple=True)
    lenses = tuple(
        CameraModel(
            camera=1,
            model="PINHOLE",
            params=(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])),
            width=int(width),
            height=int(height),
        )
        for K, (width, height) in zip(cameras.intrinsics, cameras.sizes_px, strict=True)
    )
    return SparseScene(
        views=views,
        cameras=cameras.replace(
            intrinsics=cameras.intrinsics.float(), cam_from_world=cameras.cam_from_world.float()
        ),
        points_world=cloud[kept].float(),
        # Not known: COLMAP's own mean is about half a pixel on such photographs.
        reprojection_errors_px=torch.full((int(kept.sum()),), 0.5),
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[:, kept][view, point].float(),
        lenses=lenses,
    )


def write_colmap_model(scene: SparseScene, folder: Path) -> None:
    """Write photographs, masks, and the model with its predicted tracks."""
    named = scene.views.replace(names=file_names(scene.views.names))
    write_colmap(named, scene.cameras, folder)
    write_model(scene.replace(views=named), folder / "sparse" / "0")


def cameras_of(capture: Capture) -> Cameras:
    """Return the cameras, which an LLFF set always has."""
    assert capture.cameras is not None
    return capture.cameras


def _looked_at(
    cloud: Float[Tensor, "point 3"], capture: Capture
) -> tuple[Float[Tensor, "view point 2"], Bool[Tensor, "view point"], Bool[Tensor, "view point"]]:
    """Project points to all views: where, whether in the frame, whether in the mask."""
    cameras, masks = cameras_of(capture), capture.views.masks
    if masks is None:
        raise InputError("the set has no masks; needed: a folder `images_mask` next to `images`.")
    pixels, depth = project(cloud, cameras.cam_from_world, cameras.intrinsics)
    framed = ((pixels > 0) & (pixels < cameras.sizes_px[:, None])).all(dim=-1) & (depth > 0)
    height, width = masks.shape[-2:]
    u = pixels[..., 0].long().clamp(0, width - 1)
    v = pixels[..., 1].long().clamp(0, height - 1)
    view = torch.arange(len(masks))[:, None].expand_as(u)
    return pixels, framed, masks[view, v, u]


if __name__ == "__main__":
    main()
