"""Estimates to evaluate: a result in memory or in its folder, or a mesh of any method."""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.export.reports import common_lights
from pimper_torch.export.result import read_lights, read_reference
from pimper_torch.geometry.lens_models import pinholes_of
from pimper_torch.geometry.local_frame import NO_OFFSET, from_local
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import Cameras, Mesh, Reconstruction, Record
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Estimate(Record):
    """A method's estimate of an object, in an arbitrary frame.

    Attributes:
        mesh: The surface; may have no faces if the method gives only points.
        names: Names of the photographs that have cameras.
        cameras: One per name, in the same order; ``None`` if the method gives none.
        lights_world: First-order light of each view, up to one scale; ``None`` if unknown.
        reference: Name of the view in which the surface was estimated, if any.
    """

    mesh: Mesh
    names: tuple[str, ...] = ()
    cameras: Cameras | None = None
    lights_world: Float[Tensor, "view 4"] | None = None
    reference: str | None = None


def read_estimate(path: Path | str) -> Estimate:
    """Read a method's estimate of an object.

    Args:
        path: A mesh or point cloud; or a folder with ``mesh.ply`` and optionally ``sparse/``
            (COLMAP model with the cameras), ``lights.json`` and ``depth.npz`` (with the ``name`` of
            the reference view), as written by
            :func:`pimper_torch.export.results.write_result`.
    """
    path = Path(path)
    if not path.is_dir():
        return Estimate(mesh=read_mesh(path))
    if not (path / "mesh.ply").is_file():
        raise InputError(
            f"{path}: contains no mesh.ply; needed: a folder written by `pimper reconstruct`, or "
            "the path of a mesh file."
        )
    model = read_model(path / "sparse") if (path / "sparse").is_dir() else None
    names = () if model is None else model.names
    return Estimate(
        mesh=read_mesh(path / "mesh.ply"),
        names=names,
        cameras=None if model is None else pinholes_of(model),
        lights_world=read_lights(path / "lights.json", names),
        reference=read_reference(path / "depth.npz"),
    )


def estimate_of(result: Reconstruction) -> Estimate:
    """Return a run's estimate of the object, in the frame of its files.

    A view's light is that of all patches that determine it, NaN if none does; see
    :func:`pimper_torch.export.reports.common_lights`.
    """
    lights, counts = common_lights(result)
    names, offset = result.scene.views.names, result.scene.offset_world
    mesh, cameras = result.mesh, result.cameras
    if offset != NO_OFFSET:
        vertices = mesh.vertices_world.double()
        mesh = mesh.replace(vertices_world=vertices + vertices.new_tensor(offset))
        poses = from_local(cameras.cam_from_world, offset)
        intrinsics = cameras.intrinsics.double()
        cameras = cameras.replace(cam_from_world=poses, intrinsics=intrinsics)
    return Estimate(
        mesh=mesh,
        names=names,
        cameras=cameras,
        lights_world=torch.where(counts[:, None] > 0, lights, torch.nan),
        reference=names[result.coarse.reference],
    )
