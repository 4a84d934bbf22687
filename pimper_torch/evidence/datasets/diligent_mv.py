"""DiLiGenT-MV: five objects, 20 views on a turntable's circle, 96 lights each."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.camera_files.layout import expect
from pimper_torch.camera_files.projections import decompose_projections
from pimper_torch.evidence.datasets.diligent import (
    FLIP,
    directed_lights,
    point_light_files,
    read_normals,
)
from pimper_torch.evidence.datasets.matlab import read_toolbox_projections
from pimper_torch.evidence.datasets.raster import intrinsics_from_indices, nearest, read_photographs
from pimper_torch.evidence.datasets.sampling import choose_photographs
from pimper_torch.geometry.pixels import scale_intrinsics
from pimper_torch.io.decode import read_header
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import LINEAR
from pimper_torch.records import Cameras, Capture, Mesh, Truth

KIND = "DiLiGenT-MV"
_VIEW = re.compile(r"view_(\d{2})")


def read_diligent_mv(
    folder: Path | str,
    *,
    positions: Sequence[int] | None = None,
    lights: Sequence[int] | None = None,
    light_seed: int | None = None,
    max_size_px: int = 0,
) -> Capture:
    """Read an object of DiLiGenT-MV with its cameras, lights, normals and mesh.

    ``folder`` is the object's, such as ``mvpmsData/bearPNG``::

        Calib_Results.mat                KK, Rc_1 ... Rc_20, Tc_1 ... Tc_20
        mesh_Gt.ply                      in the calibration's world, millimetres
        view_01/001.png ... 096.png      16 bits, linear
        view_01/filenames.txt            their order; 001.png and so on where it is absent
        view_01/light_directions.txt, light_intensities.txt, mask.png, Normal_gt.mat

    Light directions and normals come in each view's own frame with x right, **y up and z
    towards the viewer**; they are turned into the world. ``Rc`` is not exactly orthogonal in
    the published files: what is left over goes into ``K``, so that points project exactly
    where they do with the files' own product. ``KK`` counts pixel centres from 0.

    Args:
        positions: Read these views only, from 1.
        lights: Read these lights only, from 1.
        light_seed: Read one light a view, chosen by this seed; ``None`` reads all, 20 x 96
            photographs. Decided before anything is decoded.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.

    Returns:
        ``truth.lights_world`` has the lights' mean intensity.

    Raises:
        InputError: Another layout; names what was expected and what was found.

    Source: Li, Zhou, Wu, Shi, Diao & Tan, Multi-view photometric stereo, IEEE TIP 29, 2020;
    layout and axes as its benchmark page and public loaders (PS-NeRF, SuperNormal) have them.
    """
    root = Path(folder)
    folders = _view_folders(root)
    point_lights = {position: point_light_files(path, KIND) for position, path in folders.items()}
    table = [
        (position, point_light)
        for position, files in point_lights.items()
        for point_light in range(1, len(files.paths) + 1)
    ]
    chosen = choose_photographs(
        [position for position, _ in table],
        [point_light for _, point_light in table],
        positions=positions,
        lights=lights,
        light_seed=light_seed,
        path=root,
        kind=KIND,
    )
    kept = [table[index] for index in chosen]
    order = sorted({position for position, _ in kept})
    K, pose = decompose_projections(
        read_toolbox_projections(root / "Calib_Results.mat", order, KIND)
    )
    index = torch.tensor([order.index(position) for position, _ in kept])
    paths = [point_lights[position].paths[point_light - 1] for position, point_light in kept]
    intensity = torch.stack(
        [point_lights[position].intensities[point_light - 1] for position, point_light in kept]
    )
    views = read_photographs(
        paths,
        [f"{path.parent.name}/{path.name}" for path in paths],
        encoding=LINEAR,
        max_size_px=max_size_px,
        masks=[path.parent / "mask.png" for path in paths],
    )
    width, height = (int(side) for side in views.sizes_px[0])
    header = read_header(paths[0])
    K = scale_intrinsics(intrinsics_from_indices(K), width / header.width, height / header.height)
    directions = torch.stack(
        [point_lights[position].directions[point_light - 1] for position, point_light in kept]
    )
    world_from_cam = pose[:, :3, :3].mT
    directions_world = (world_from_cam[index] @ (directions * FLIP)[..., None])[..., 0]
    strength = intensity.mean(dim=1)
    normals = [
        _rotated(read_normals(folders[position], KIND), world_from_cam[row], width, height)
        for row, position in enumerate(order)
    ]
    return Capture(
        views=views,
        cameras=Cameras(
            intrinsics=K[index].float(),
            cam_from_world=pose[index].float(),
            sizes_px=views.sizes_px,
        ),
        truth=Truth(
            mesh=_mesh(root),
            normals_world=_stacked(normals, index),
            foreground=views.masks,
            lights_world=directed_lights(directions_world, strength),
        ),
        position=torch.tensor([position for position, _ in kept]),
        light=torch.tensor([point_light for _, point_light in kept]),
    )


def _view_folders(root: Path) -> dict[int, Path]:
    expect(root.is_dir(), root, KIND, "an object's folder such as mvpmsData/bearPNG")
    found = {
        int(match[1]): path
        for path in sorted(root.iterdir())
        if path.is_dir() and (match := _VIEW.fullmatch(path.name))
    }
    expect(bool(found), root, KIND, "folders view_01, view_02 and so on")
    return found


def _mesh(root: Path) -> Mesh | None:
    path = root / "mesh_Gt.ply"
    return read_mesh(path) if path.is_file() else None


def _rotated(
    normals: Float[Tensor, "height_in width_in 3"] | None,
    world_from_cam: Float[Tensor, "3 3"],
    width: int,
    height: int,
) -> Float[Tensor, "{height} {width} 3"] | None:
    if normals is None:
        return None
    small = nearest(normals, width, height)
    return normalize(small @ world_from_cam.mT.to(small), dim=-1)


def _stacked(
    normals: Sequence[Float[Tensor, "height width 3"] | None], index: Tensor
) -> Float[Tensor, "view height width 3"] | None:
    there = [one for one in normals if one is not None]
    if len(there) < len(normals):
        return None
    if len(there) == 1:  # many lights on one view share their map
        return there[0][None].expand(len(index), -1, -1, -1)
    return torch.stack(there)[index]
