"""DiLiGenT-MV: objects from twenty viewpoints, under 96 lights each."""

import re
from pathlib import Path
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.datasets.matlab import read_matlab, read_toolbox_projections
from pimper_bench.datasets.raster import nearest
from pimper_bench.datasets.sampling import LightOptions, Shot, read_shots
from pimper_bench.truth import Capture, Truth
from pimper_torch.io.cameras.camera_arrays import decompose_projections
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.meshes import read_mesh

# Photometric stereo's axes are x right, y up, z towards the viewer; this converts them to ours.
FLIP = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
_VIEW = re.compile(r"view_(\d{2})")


def read_diligent_mv(folder: Path | str, **options: Unpack[LightOptions]) -> Capture:
    """Read an object of DiLiGenT-MV with its cameras, lights, normals and mesh.

    ``folder`` is the object's, such as ``mvpmsData/bearPNG``::

        Calib_Results.mat                KK, Rc_1 ... Rc_20, Tc_1 ... Tc_20
        mesh_Gt.ply                      in the calibration's world, millimetres
        view_01/001.png ... 096.png      16 bits, linear
        view_01/filenames.txt            their order; 001.png and so on where it is absent
        view_01/light_directions.txt, light_intensities.txt, mask.png, Normal_gt.mat

    Light directions and normals are in each view's frame with x right, **y up and z
    towards the viewer**; they are converted to the world. ``Rc`` is not exactly orthogonal in
    the published files: the remainder is moved to ``K``, so points project exactly as with the
    product in the files. ``KK`` counts pixel centres from 0.

    Args:
        options: See :func:`~pimper_bench.datasets.sampling.read_shots`; views and lights
            count from 1.

    Returns:
        ``truth.lights_world`` has the lights' mean intensity over channels.

    Source: Li, Zhou, Wu, Shi, Diao & Tan, Multi-view photometric stereo, IEEE TIP 29, 2020;
    layout and axes as in its benchmark page and public loaders (PS-NeRF, SuperNormal).
    """
    root = DataSetPath(Path(folder), "DiLiGenT-MV")
    root.expect(root.path.is_dir(), "an object's folder such as mvpmsData/bearPNG")
    folders = {
        int(match[1]): root.inner(path)
        for path in sorted(root.path.iterdir())
        if path.is_dir() and (match := _VIEW.fullmatch(path.name))
    }
    root.expect(bool(folders), "folders view_01, view_02 and so on")
    calibration, mesh = root.inner("Calib_Results.mat"), root.path / "mesh_Gt.ply"
    shots = [shot for view, inner in folders.items() for shot in _shots(view, inner, root)]
    selection = read_shots(
        shots,
        root,
        lambda views: decompose_projections(read_toolbox_projections(calibration, views)),
        **options,
    )
    views, position = selection.capture.views, selection.capture.position
    world_from_cam = selection.cam_from_world[:, :3, :3].mT
    directions = [shot.direction for shot in selection.chosen if shot.direction is not None]
    strength = torch.tensor([shot.strength for shot in selection.chosen], dtype=torch.float64)
    directions_world = world_from_cam @ torch.stack(directions)[..., None]
    width, height = views.sizes_px[0].tolist()
    seen, index = torch.unique(position, return_inverse=True)
    maps = [_normals(folders[view]) for view in seen.tolist()]
    first = [position.tolist().index(view) for view in seen.tolist()]
    normals = [
        normalize(nearest(normal, width, height) @ world_from_cam[row].mT.float(), dim=-1)
        for normal, row in zip(maps, first, strict=True)
        if normal is not None
    ]
    return selection.capture.replace(
        truth=Truth(
            mesh=read_mesh(mesh) if mesh.is_file() else None,
            normals_world=torch.stack(normals)[index] if len(normals) == len(maps) else None,
            foreground=views.masks,
            lights_world=directed_lights(directions_world[..., 0], strength),
        )
    )


def directed_lights(
    directions_world: Float[Tensor, "view 3"], strength: Float[Tensor, " view"]
) -> Float[Tensor, "view 4"]:
    """Return the first-order light of distant point lights without ambient light."""
    directed = strength[:, None] * directions_world
    return torch.cat([torch.zeros_like(directed[:, :1]), directed], dim=1).float()


def _shots(view: int, folder: DataSetPath, root: DataSetPath) -> list[Shot]:
    """Return a viewpoint's photographs with their lights, in the order of ``filenames.txt``."""
    directions, intensities = (
        _rows_of_three(folder.inner(f"light_{what}.txt")) for what in ("directions", "intensities")
    )
    listed = folder.inner("filenames.txt")
    names = [f"{light + 1:03d}.png" for light in range(len(directions))]
    if listed.path.is_file():
        names = listed.read_text().split()
    folder.expect(
        len(names) == len(directions) == len(intensities) > 0,
        "as many photographs as light directions and intensities",
        f"{len(names)}, {len(directions)} and {len(intensities)}",
    )
    folder.expect(len(set(names)) == len(names), "photographs of different names", "duplicates")
    folder.expect(bool((intensities > 0).all()), "intensities above 0", "others")
    rows = zip(names, normalize(directions, dim=-1), intensities.mean(dim=1), strict=True)
    return [
        Shot(
            position=view,
            light=light,
            path=path,
            name=path.relative_to(root.path).as_posix(),
            mask=folder.path / "mask.png",
            direction=direction * FLIP,
            strength=float(strength),
        )
        for light, (name, direction, strength) in enumerate(rows, start=1)
        for path in (folder.inside(name),)
    ]


def _normals(folder: DataSetPath) -> Float[Tensor, "height width 3"] | None:
    """Read ``Normal_gt.mat`` in our camera frame; ``None`` without such a file."""
    file = folder.inner("Normal_gt.mat")
    if not file.path.is_file():
        return None
    array = read_matlab(file, ("Normal_gt",))["Normal_gt"]
    shape = " x ".join(map(str, array.shape))
    ok = array.ndim == 3 and array.shape[2] == 3
    file.expect(ok, "Normal_gt of height x width x 3", f"shape {shape}")
    return facing_us(torch.from_numpy(array.astype(np.float32)))


def facing_us(normals: Float[Tensor, "height width 3"]) -> Float[Tensor, "height width 3"]:
    """Convert normals with y up and z to the viewer to our camera frame, ``n_z < 0``.

    Zero where unknown: not finite, or shorter than 0.5, as on a background.
    """
    rotated = normals.nan_to_num(0) * FLIP.float()
    valid = normals.nan_to_num(0).norm(dim=-1, keepdim=True) > 0.5
    return torch.where(valid, normalize(rotated, dim=-1), 0)


def _rows_of_three(file: DataSetPath) -> Float[Tensor, "row 3"]:
    words = file.read_text().split()
    file.expect(len(words) % 3 == 0 and bool(words), "rows of three numbers", f"{len(words)}")
    return file.numbers(words, len(words), "rows of three").reshape(-1, 3)
