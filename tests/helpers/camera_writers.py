"""Writers of one rig in the formats of all supported programs."""

import json
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from sparse_models import observed

from pimper_torch.export.alicevision import write_sfm
from pimper_torch.export.nerfstudio import write_transforms
from pimper_torch.geometry.rigid import invert_rigid, rigid
from pimper_torch.records import Cameras, Views
from pimper_torch.stages.sfm import colmap

WIDTH, HEIGHT = 64, 48
NAMES = ("10.png", "2.png", "a b.png")


def rig_of(seed: int) -> Cameras:
    """Return three cameras with equal intrinsics and random poses."""
    generator = torch.Generator().manual_seed(seed)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3, 3, generator=generator).double())
    rotation = rotation * torch.linalg.det(rotation)[:, None, None]
    fx, fy, cx, cy = (0.5 + torch.rand(4, generator=generator).double()).tolist()
    K = torch.tensor([[90 * fx, 0, 32 * cx], [0, 90 * fy, 24 * cy], [0, 0, 1]])
    return Cameras(
        intrinsics=K.double().expand(3, 3, 3),
        cam_from_world=rigid(rotation, 5 * torch.randn(3, 3, generator=generator).double()),
        sizes_px=torch.tensor([[WIDTH, HEIGHT]] * 3),
    )


def views_of(scale: float = 1.0, folder: Path | None = None) -> Views:
    width, height = round(WIDTH * scale), round(HEIGHT * scale)
    return Views(
        images=torch.full((3, 1, height, width), 0.5),
        sizes_px=torch.tensor([[width, height]] * 3),
        names=NAMES,
        focals_px=torch.full((3,), torch.nan),
        folder=str(folder or ""),
    )


def of_colmap(
    rig: Cameras, folder: Path, *, text: bool = False, names: tuple[str, ...] = NAMES
) -> Path:
    model = observed(rig, torch.zeros(0, 3).double()).replace(names=names)
    path, colors = folder / "model", torch.zeros(0, 3, dtype=torch.uint8)
    colmap.write_binary(model, colors, path)
    if text:
        colmap.reconstruction_of(model, colors).write_text(str(path))
        for binary in path.glob("*.bin"):
            binary.unlink()
    return path


def of_transforms(rig: Cameras, folder: Path, *, sizes: bool = True) -> Path:
    write_transforms(views_of(), rig, folder)
    path = folder / "transforms.json"
    whole = json.loads(path.read_text())
    if not sizes:
        del whole["w"], whole["h"]
    path.write_text(json.dumps({**whole, "frames": whole["frames"][::-1]}))
    return path


def of_metashape(rig: Cameras, folder: Path) -> Path:
    K = rig.intrinsics[0]
    cameras = "".join(
        f'<camera id="{index}" sensor_id="0" label="{name.removesuffix(".png")}"><transform>'
        + " ".join(map(repr, matrix.flatten().tolist()))
        + "</transform></camera>"
        for index, (name, matrix) in enumerate(
            zip(NAMES, invert_rigid(rig.cam_from_world), strict=True)
        )
    )
    path = folder / "cameras.xml"
    f, b1 = float(K[1, 1]), float(K[0, 0] - K[1, 1])
    path.write_text(
        '<document version="2.0.0"><chunk label="1"><sensors><sensor id="0" type="frame">'
        f'<resolution width="{WIDTH}" height="{HEIGHT}"/><calibration class="adjusted">'
        f"<f>{f}</f><b1>{b1}</b1><cx>{float(K[0, 2]) - WIDTH / 2}</cx>"
        f"<cy>{float(K[1, 2]) - HEIGHT / 2}</cy></calibration></sensor></sensors>"
        f"<cameras>{cameras}</cameras></chunk></document>"
    )
    return path


def of_meshroom(rig: Cameras, folder: Path) -> Path:
    write_sfm(rig, [f"C:\\theirs\\{name}" for name in NAMES], folder / "cameras.sfm")
    return folder / "cameras.sfm"


def of_sfm_json(rig: Cameras, folder: Path) -> Path:
    return of_meshroom(rig, folder).rename(folder / "sfm.json")


def of_polycam(rig: Cameras, folder: Path) -> Path:
    """Write a file for each camera, named like its photograph, with ARKit's axes."""
    path = folder / "keyframes" / "corrected_cameras"
    path.mkdir(parents=True)
    K = rig.intrinsics[0].tolist()
    lens = {"fx": K[0][0], "fy": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    size = {"width": WIDTH, "height": HEIGHT}
    poses = invert_rigid(rig.cam_from_world) * torch.tensor([1.0, -1, -1, 1])
    for name, pose in zip(NAMES, poses.tolist(), strict=True):
        cells = {f"t_{i}{j}": pose[i][j] for i in range(3) for j in range(4)}
        file = path / name.replace(".png", ".json")
        file.write_text(json.dumps({**lens, **size, **cells, "blur_score": 100.0}))
    return path


def of_record3d(rig: Cameras, folder: Path) -> Path:
    """Write quaternions, real part last, and positions, with ARKit's axes."""
    poses = invert_rigid(rig.cam_from_world) * torch.tensor([1.0, -1, -1, 1])
    turns = Rotation.from_matrix(poses[:, :3, :3].numpy()).as_quat()
    rows = np.concatenate([turns, poses[:, :3, 3].numpy()], axis=1).tolist()
    content = {"K": rig.intrinsics[0].T.flatten().tolist(), "w": WIDTH, "h": HEIGHT, "poses": rows}
    (folder / "metadata").write_text(json.dumps(content))
    return folder / "metadata"


def saved(folder: Path, **arrays: object) -> Path:
    path = folder / "cameras.npz"
    np.savez(path, **{name: np.asarray(value) for name, value in arrays.items()})
    return path


def of_idr(rig: Cameras, folder: Path) -> Path:
    K = rig.intrinsics.clone()
    K[:, :2, 2] -= 0.5  # its first pixel centre is 0
    order = np.argsort(NAMES)
    world = rig.cam_from_world.clone()
    world[:, :3] = 2.5 * K @ rig.cam_from_world[:, :3]
    arrays = {f"world_mat_{rank}": world[view].numpy() for rank, view in enumerate(order)}
    arrays |= {f"scale_mat_{rank}": np.eye(4) for rank in range(3)}
    return saved(folder, **arrays)


def of_matrices(rig: Cameras, folder: Path) -> Path:
    pose = rig.cam_from_world
    return saved(folder, K=rig.intrinsics[0], R=pose[:, :3, :3], t=pose[:, :3, 3])


def of_named_poses(rig: Cameras, folder: Path) -> Path:
    backwards = list(range(3))[::-1]
    return saved(
        folder,
        intrinsics=rig.intrinsics[backwards],
        cam_from_world=rig.cam_from_world[backwards],
        names=NAMES[::-1],
    )


def of_projections(rig: Cameras, folder: Path) -> Path:
    return saved(folder, P=-0.7 * rig.intrinsics @ rig.cam_from_world[:, :3])
