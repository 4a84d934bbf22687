"""Small valid files of every kind read by the package, and their readers."""

import warnings
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import camera_writers as rigs
import numpy as np
import scipy.io
import tifffile
import torch
import trimesh
from PIL import Image, ImageCms, PngImagePlugin
from sparse_models import observed, views_of

import pimper_torch as pt
from pimper_bench.datasets import read_rendered
from pimper_bench.datasets.matlab import read_matlab, read_toolbox_projections
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.cli.video.read import luma_frames
from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.cameras.read_cameras import read_cameras
from pimper_torch.io.decode import decode, write_deep_png
from pimper_torch.io.meshes import write_glb, write_ply
from pimper_torch.io.openexr import write_exr
from pimper_torch.io.responses import read_curve
from pimper_torch.runtime.config import build, read_mapping, to_yaml
from pimper_torch.stages.sfm.colmap import reconstruction_of, write_binary
from tests.io.dng import write_dng
from tests.io.heic_files import UPRIGHT


@dataclass(frozen=True)
class Seed:
    """A valid folder, its files to damage, and its reader."""

    name: str
    folder: Path
    files: tuple[str, ...]
    read: Callable[[Path], object]


PIXELS = np.random.default_rng(7).integers(60, 200, (18, 24, 3), dtype=np.uint8)
DEEP = PIXELS.astype(np.uint16) * 256
MASK = np.pad(np.full((10, 14), 255, dtype=np.uint8), ((4, 4), (5, 5)))
CAMERAS = arc_cameras(4, width=24, height=18, focal_px=30.0, distance=5.0)
VIEWS = views_of(
    torch.full((4, 3, 18, 24), 0.5), masks=torch.from_numpy(MASK > 0).expand(4, -1, -1)
)


def make_seeds(root: Path) -> list[Seed]:
    """Write all folders below a root, and check that their readers accept them."""
    seeds = [
        *(_alone(root / "image", name, write, decode) for name, write in _pictures().items()),
        *_photographs(root / "photographs"),
        *_meshes(root / "mesh"),
        *_models(root / "model"),
        *_tables(root / "table"),
        *_maps(root / "maps"),
        *_camera_files(root / "cameras"),
        *_videos(root / "video"),
        _rendered(root / "rendered"),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in seeds:
            seed.read(seed.folder)
    return seeds


def _alone(
    root: Path, name: str, write: Callable[[Path], object], read: Callable[[Path], object]
) -> Seed:
    """Write a file to a new folder."""
    folder = root / name.replace(".", "_")
    folder.mkdir(parents=True)
    write(folder / name)
    return Seed(f"{root.name} {name}", folder, (name,), lambda copy: read(copy / name))


def _ball() -> pt.Mesh:
    vertices, faces = icosphere(1)
    grey = torch.full((len(vertices), 3), 0.5).double()
    return pt.Mesh(
        vertices_world=vertices.double(),
        faces=faces,
        albedo=grey,
        confidence=grey[:, 0],
        expected_error=grey[:, 0],
    )


def _pictures() -> dict[str, Callable[[Path], object]]:
    exif = Image.Exif()
    exif[274] = 6
    exif.get_ifd(0x8769)[0xA405] = 50
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    plain = Image.fromarray(PIXELS)
    rgba = Image.fromarray(np.concatenate([PIXELS, PIXELS[..., :1] // 120 * 255], axis=2))

    def saved(picture: Image.Image, **how: object) -> Callable[[Path], object]:
        return lambda path: picture.save(path, **how)

    def tiff(values: np.ndarray, **how: object) -> Callable[[Path], object]:
        return lambda path: tifffile.imwrite(path, values, photometric="rgb", **how)

    def pages(path: Path) -> None:
        with tifffile.TiffWriter(path) as file:
            file.write(PIXELS, photometric="rgb", extratags=[(281, "H", 3, (255,) * 3, True)])
            file.write(PIXELS[::2, ::2], photometric="rgb", subfiletype=1)

    pictures = {
        "a.jpg": saved(plain, exif=exif, quality=90),
        "a.png": saved(plain),
        "palette.png": saved(plain.quantize(16), transparency=bytes([0, 255])),
        "rgba.png": saved(rgba),
        "deep.png": lambda path: write_deep_png(DEEP, path),
        "a.tif": saved(plain, compression="tiff_lzw", exif=exif),
        "deep.tif": tiff(DEEP),
        "planes.tif": tiff(np.moveaxis(DEEP, -1, 0), planarconfig="separate"),
        "tiled.tif": tiff(DEEP, tile=(16, 16)),
        "pages.tif": pages,
        "profile.png": saved(plain, icc_profile=profile),
        "a.bmp": saved(plain),
        "a.ppm": saved(plain),
    }
    if find_spec("rawpy"):
        raw = np.tile(DEEP[..., 1] // 16, (2, 2))
        pictures["a.dng"] = lambda path: write_dng(path, raw, equivalent=50)
    if find_spec("pi_heif") or find_spec("pillow_heif"):
        pictures["a.heic"] = lambda path: path.write_bytes(UPRIGHT)
    return pictures


def _photographs(root: Path) -> list[Seed]:
    for folder in ("photos", "masks"):
        (root / folder).mkdir(parents=True)
    for name in ("1", "2", "3"):
        Image.fromarray(PIXELS).save(root / "photos" / f"{name}.jpg")
        Image.fromarray(MASK).save(root / "masks" / f"{name}.png")
    files = ("photos/1.jpg", "photos/2.jpg", "masks/1.png", "masks/2.png")

    def masked(folder: Path) -> object:
        return pt.load_views(folder / "photos", masks=folder / "masks")

    return [
        Seed("photographs", root, files, lambda folder: pt.load_views(folder / "photos")),
        Seed("masks", root, files, masked),
    ]


def _meshes(root: Path) -> list[Seed]:
    mesh = _ball()
    plain = trimesh.Trimesh(mesh.vertices_world.numpy(), mesh.faces.numpy(), process=False)

    def exported(**how: object) -> Callable[[Path], object]:
        return lambda path: plain.export(path, **how)

    writers: dict[str, Callable[[Path], object]] = {
        "a.ply": lambda path: write_ply(mesh, path),
        "a.glb": lambda path: write_glb(mesh, path),
        "text.ply": exported(encoding="ascii"),
        "a.obj": exported(),
        "a.stl": exported(),
        "text.stl": exported(file_type="stl_ascii"),
        "a.off": exported(),
    }
    return [_alone(root, name, write, pt.read_mesh) for name, write in writers.items()]


def _models(root: Path) -> list[Seed]:
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64) * 0.5
    model = observed(CAMERAS, points)
    colors = torch.zeros(30, 3, dtype=torch.uint8)
    write_binary(model, colors, root / "bin")
    (root / "txt").mkdir()
    reconstruction_of(model, colors).write_text(str(root / "txt"))
    seeds = []
    for kind in ("bin", "txt"):
        files = tuple(sorted(path.name for path in (root / kind).iterdir()))
        seeds += [
            Seed(f"model {kind}", root / kind, files, read_model),
            Seed(f"sparse {kind}", root / kind, files, lambda at: existing_model(VIEWS, at)),
        ]
    return seeds


def _tables(root: Path) -> list[Seed]:
    curve = np.linspace(0, 1, 256) ** 2.2
    text = "level,radiance\n" + "".join(f"{i},{value:.6f}\n" for i, value in enumerate(curve))
    arrays = {"fc": np.array([30.0, 30]), "cc": np.array([12.0, 9])}
    for view in (1, 2):
        arrays[f"Rc_{view}"] = CAMERAS.cam_from_world[view - 1, :3, :3].numpy()
        arrays[f"Tc_{view}"] = CAMERAS.cam_from_world[view - 1, :3, 3:].numpy()

    def matlab(path: Path) -> object:
        file = DataSetPath(path, "a test")
        read_matlab(file, ("fc",))
        return read_toolbox_projections(file, (1, 2))

    def config(path: Path) -> object:
        return build(pt.CoarseToFineConfig, read_mapping(path), str(path))

    def record(path: Path) -> object:
        return pt.load_record(pt.Mesh, path) and None  # values are checked by stages

    files: dict[str, tuple[Callable[[Path], object], Callable[[Path], object]]] = {
        "curve.csv": (lambda path: path.write_text(text), read_curve),
        "curve.npy": (lambda path: np.save(path, curve), read_curve),
        "settings.yaml": (lambda path: path.write_text(to_yaml(pt.CoarseToFineConfig())), config),
        "mesh.safetensors": (lambda path: pt.save_record(_ball(), path), record),
        "calibration.mat": (lambda path: scipy.io.savemat(path, arrays), matlab),
        "packed.mat": (lambda path: scipy.io.savemat(path, arrays, do_compression=True), matlab),
    }
    return [_alone(root, name, write, read) for name, (write, read) in files.items()]


def _maps(root: Path) -> list[Seed]:
    depth = PIXELS[..., 0].astype(np.float32)
    normals = depth[..., None] / 300 - np.ones(3, np.float32)
    limits = PngImagePlugin.PngInfo()
    limits.add_text("near", "0.5")
    limits.add_text("far", "9")
    views = VIEWS.take([0]).replace(names=("a.jpg",))
    picture = Image.fromarray(depth.astype(np.uint16))
    writers: dict[str, Callable[[Path], object]] = {
        "a.npy": lambda path: np.save(path, normals),
        "a.npz": lambda path: np.savez(path, normals=normals, variance=depth),
        "a.exr": lambda path: write_exr(normals, path),
        "a.png": lambda path: picture.save(path, pnginfo=limits),
    }

    def read(path: Path) -> object:
        if path.suffix == ".png":
            return pt.read_depth(path.parent, views).depth
        return pt.read_normals(path.parent, views).normals

    return [_alone(root, name, write, read) for name, write in writers.items()]


def _camera_files(root: Path) -> list[Seed]:
    """Write camera files that refer to photographs in other folders, as for `--sparse FILE`."""

    def seed(write: Callable[[pt.Cameras, Path], Path]) -> Seed:
        folder = root / write.__name__
        folder.mkdir(parents=True)
        name = write(rigs.rig_of(7), folder).name
        return Seed(f"cameras {write.__name__}", folder, (name,), lambda copy: read(copy / name))

    def read(path: Path) -> object:
        return read_cameras(
            path, rigs.NAMES, lambda names: [(rigs.WIDTH, rigs.HEIGHT)] * len(names)
        )

    ways = (
        rigs.of_matrices,
        rigs.of_projections,
        rigs.of_idr,
        rigs.of_transforms,
        rigs.of_meshroom,
        rigs.of_metashape,
        rigs.of_record3d,
    )
    return [seed(write) for write in ways]


def _videos(root: Path) -> list[Seed]:
    if not find_spec("av"):
        return []
    from tests.video.clips import written

    def read(path: Path) -> None:
        deque(luma_frames(path), maxlen=0)

    return [
        _alone(root, name, lambda path: written(path, places=range(8)), read)
        for name in ("a.mp4", "a.mkv")
    ]


def _rendered(root: Path) -> Seed:
    ball = root.parent / "ball.ply"
    write_ply(_ball(), ball)
    config = SceneConfig(num_views=3, width=24, height=18, supersample=1)
    render_scene(ball, root, config, processes=1)
    files = tuple(
        str(path.relative_to(root))
        for path in sorted((root / "truth").rglob("*"))
        if path.suffix in (".json", ".npz", ".ply", ".bin")
    )
    return Seed("rendered", root, files, read_rendered)
