"""Small valid files of every kind that the package reads, and their readers."""

import json
import sys
import warnings
from base64 import b64decode
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import scipy.io
import tifffile
import torch
import trimesh
from PIL import Image, ImageCms, PngImagePlugin

sys.path.insert(0, str(Path(__file__).parents[1] / "io"))
from dng import write_dng
from heic_files import UPRIGHT

from pimper_bench.datasets import (
    read_camera_file,
    read_colmap,
    read_diligent,
    read_idr,
    read_llff,
    read_rendered,
    read_transforms,
    write_colmap,
    write_idr,
    write_transforms,
)
from pimper_bench.datasets.matlab import read_matlab, read_toolbox_projections
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.cli.video.read import luma_frames
from pimper_torch.doors.camera_files.layout import DataSetPath
from pimper_torch.doors.camera_files.read_cameras import read_cameras
from pimper_torch.doors.exchange.alicevision import write_sfm
from pimper_torch.doors.exchange.openexr import write_exr
from pimper_torch.doors.io.decode import decode, write_deep_png
from pimper_torch.doors.io.meshes import read_mesh, write_glb, write_ply
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.doors.io.responses import read_curve
from pimper_torch.ground.geometry.lens_models import pinhole_lenses
from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.method.chains.chain_config import CoarseToFineConfig
from pimper_torch.method.sfm.colmap import read_model, reconstruction_of, write_binary
from pimper_torch.method.sfm.existing import existing_model
from pimper_torch.method.sfm.model import SparseModel
from pimper_torch.priors.prior_files.read_maps import read_depth, read_normals
from pimper_torch.records import Mesh, Views
from pimper_torch.records.stored import load_record, save_record
from pimper_torch.runtime.config import build, read_mapping, to_yaml


@dataclass(frozen=True)
class Seed:
    """A valid folder, the files in it that are damaged, and what reads it."""

    name: str
    folder: Path
    files: tuple[str, ...]
    read: Callable[[Path], object]


def make_seeds(root: Path) -> list[Seed]:
    """Write all folders below a root, and check that their readers take them."""
    seeds = [
        *_images(root / "image"),
        *_photographs(root / "photographs"),
        *_meshes(root / "mesh"),
        *_models(root / "model"),
        *_tables(root / "table"),
        *_maps(root / "maps"),
        *_datasets(root / "dataset"),
        *_camera_files(root / "cameras"),
        *_videos(root / "video"),
        _rendered(root / "rendered"),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in seeds:
            seed.read(seed.folder)
    return seeds


def _pixels(width: int = 24, height: int = 18, low: int = 60) -> np.ndarray:
    return np.random.default_rng(7).integers(low, 200, (height, width, 3), dtype=np.uint8)


def _ball() -> Mesh:
    vertices, faces = icosphere(1)
    bright = torch.linspace(0.2, 0.9, len(vertices))[:, None].expand(-1, 3)
    error = torch.full((len(vertices),), 0.1)
    return Mesh(
        vertices_world=vertices.double(),
        faces=faces,
        albedo=bright.double(),
        confidence=0.5 + 0 * error.double(),
        expected_error=error.double(),
    )


def _images(root: Path) -> list[Seed]:
    root.mkdir(parents=True)
    pixels, deep = _pixels(), _pixels().astype(np.uint16) * 256
    exif = Image.Exif()
    exif[274] = 6
    exif.get_ifd(0x8769)[0xA405] = 50
    Image.fromarray(pixels).save(root / "a.jpg", exif=exif, quality=90)
    Image.fromarray(pixels).save(root / "progressive.jpg", progressive=True)
    Image.fromarray(pixels).save(root / "a.png")
    Image.fromarray(pixels).quantize(16).save(root / "palette.png", transparency=bytes([0, 255]))
    rgba = np.concatenate([pixels, pixels[..., :1] // 120 * 255], axis=2)
    Image.fromarray(rgba).save(root / "rgba.png")
    write_deep_png(deep, root / "deep.png")
    Image.fromarray(deep[..., 0]).save(root / "deep_grey.png")
    Image.fromarray(pixels).save(root / "a.tif", compression="tiff_lzw", exif=exif)
    tifffile.imwrite(root / "deep.tif", deep, photometric="rgb")
    tifffile.imwrite(root / "deep_deflate.tif", deep, photometric="rgb", compression="zlib")
    planes = np.moveaxis(deep, -1, 0)
    tifffile.imwrite(root / "planes.tif", planes, photometric="rgb", planarconfig="separate")
    tifffile.imwrite(root / "tiled.tif", deep, photometric="rgb", tile=(16, 16))
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    for name in ("profile.jpg", "profile.png", "profile.tif"):
        Image.fromarray(pixels).save(root / name, icc_profile=profile)
    with tifffile.TiffWriter(root / "pages.tif") as file:
        file.write(pixels[::2, ::2], photometric="rgb", subfiletype=1)
        file.write(pixels, photometric="rgb", extratags=[(281, "H", 3, (255,) * 3, True)])
    if find_spec("rawpy"):
        write_dng(root / "a.dng", np.tile(deep[..., 1] // 16, (2, 2)), equivalent=50)
    if find_spec("pi_heif") or find_spec("pillow_heif"):
        (root / "a.heic").write_bytes(b64decode(UPRIGHT))
    Image.fromarray(pixels).save(root / "a.bmp")
    Image.fromarray(pixels).save(root / "a.ppm")
    names = sorted(path.name for path in root.iterdir())
    return [Seed(f"image {name}", _alone(root, name), (name,), _decoder(name)) for name in names]


def _alone(root: Path, name: str) -> Path:
    folder = root / "of" / name.replace(".", "_")
    folder.mkdir(parents=True)
    (folder / name).write_bytes((root / name).read_bytes())
    return folder


def _decoder(name: str) -> Callable[[Path], object]:
    return lambda folder: decode(folder / name)


def _photographs(root: Path) -> list[Seed]:
    for name in ("1", "2", "3"):
        for folder in ("photos", "masks"):
            (root / folder).mkdir(parents=True, exist_ok=True)
        Image.fromarray(_pixels()).save(root / "photos" / f"{name}.jpg")
        mask = np.zeros((18, 24), dtype=np.uint8)
        mask[4:14, 5:19] = 255
        Image.fromarray(mask).save(root / "masks" / f"{name}.png")
    files = ("photos/1.jpg", "photos/2.jpg", "masks/1.png", "masks/2.png")
    return [
        Seed("photographs", root, files, lambda folder: load_views(folder / "photos")),
        Seed(
            "masks",
            root,
            files,
            lambda folder: load_views(folder / "photos", masks=folder / "masks"),
        ),
    ]


def _meshes(root: Path) -> list[Seed]:
    root.mkdir(parents=True)
    mesh = _ball()
    write_ply(mesh, root / "a.ply")
    write_glb(mesh, root / "a.glb")
    plain = trimesh.Trimesh(mesh.vertices_world.numpy(), mesh.faces.numpy(), process=False)
    for name, options in {
        "text.ply": {"encoding": "ascii"},
        "a.obj": {},
        "a.stl": {},
        "text.stl": {"file_type": "stl_ascii"},
        "a.off": {},
    }.items():
        plain.export(root / name, **options)
    names = sorted(path.name for path in root.iterdir())

    def reader(name: str) -> Callable[[Path], object]:
        return lambda folder: read_mesh(folder / name)

    return [Seed(f"mesh {name}", _alone(root, name), (name,), reader(name)) for name in names]


def _model() -> tuple[SparseModel, Views]:
    cameras = arc_cameras(4, width=24, height=18, focal_px=30.0, distance=5.0)
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(30, 3, generator=generator, dtype=torch.float64) * 0.5
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    point, view = torch.arange(30).repeat_interleave(4), torch.arange(4).repeat(30)
    names = tuple(f"{index}.png" for index in range(4))
    model = SparseModel(
        names=names,
        lenses=pinhole_lenses(cameras),
        cam_from_world=cameras.cam_from_world.double(),
        points_world=points,
        observation_point=point,
        observation_view=view,
        observation_pixels=pixels[view, point].double(),
    )
    views = Views(
        images=torch.full((4, 3, 18, 24), 0.5),
        sizes_px=torch.tensor([[24, 18]] * 4),
        names=names,
        focals_px=torch.full((4,), torch.nan),
    )
    return model, views


def _models(root: Path) -> list[Seed]:
    model, views = _model()
    colors = torch.zeros(30, 3, dtype=torch.uint8)
    write_binary(model, colors, root / "bin")
    (root / "txt").mkdir()
    reconstruction_of(model, colors).write_text(str(root / "txt"))
    seeds = []
    for kind in ("bin", "txt"):
        files = tuple(sorted(path.name for path in (root / kind).iterdir()))
        seeds += [
            Seed(f"model {kind}", root / kind, files, read_model),
            Seed(f"sparse {kind}", root / kind, files, lambda at: existing_model(views, at)),
        ]
    return seeds


def _tables(root: Path) -> list[Seed]:
    root.mkdir(parents=True)
    curve = [(level / 255) ** 2.2 for level in range(256)]
    (root / "curve.csv").write_text(
        "level,radiance\n" + "".join(f"{level},{value:.6f}\n" for level, value in enumerate(curve))
    )
    np.save(root / "curve.npy", np.array(curve))
    (root / "settings.yaml").write_text(to_yaml(CoarseToFineConfig()))
    save_record(_ball(), root / "mesh.safetensors")
    arrays = {"fc": np.array([30.0, 30]), "cc": np.array([12.0, 9])}
    cameras = arc_cameras(2, width=24, height=18, focal_px=30.0, distance=5.0)
    for view in (1, 2):
        arrays[f"Rc_{view}"] = cameras.cam_from_world[view - 1, :3, :3].numpy()
        arrays[f"Tc_{view}"] = cameras.cam_from_world[view - 1, :3, 3:].numpy()
    scipy.io.savemat(root / "calibration.mat", arrays)
    scipy.io.savemat(root / "packed.mat", arrays, do_compression=True)

    def curves(name: str) -> Callable[[Path], object]:
        return lambda folder: read_curve(folder / name)

    def matlab(folder: Path) -> object:
        name = next(folder.iterdir()).name
        file = DataSetPath(folder / name, "a test")
        read_matlab(file, ("fc",))
        return read_toolbox_projections(file, (1, 2))

    def settings(folder: Path) -> object:
        path = folder / "settings.yaml"
        return build(CoarseToFineConfig, read_mapping(path), str(path))

    readers: dict[str, Callable[[Path], object]] = {
        **{name: curves(name) for name in ("curve.csv", "curve.npy")},
        "settings.yaml": settings,
        # Values are checked by the stages that take a record.
        "mesh.safetensors": lambda folder: load_record(Mesh, folder / "mesh.safetensors") and None,
        "calibration.mat": matlab,
        "packed.mat": matlab,
    }
    return [Seed(name, _alone(root, name), (name,), reader) for name, reader in readers.items()]


def _maps(root: Path) -> list[Seed]:
    root.mkdir(parents=True)
    depth = _pixels()[..., 0].astype(np.float32)
    normals = depth[..., None] / 300 - np.ones(3, np.float32)
    np.save(root / "a.npy", normals)
    np.savez(root / "a.npz", normals=normals, variance=depth)
    write_exr(normals, root / "a.exr")
    text = PngImagePlugin.PngInfo()
    text.add_text("near", "0.5")
    text.add_text("far", "9")
    Image.fromarray(depth.astype(np.uint16)).save(root / "a.png", pnginfo=text)
    views = Views(
        images=torch.zeros(1, 1, 18, 24),
        sizes_px=torch.tensor([[24, 18]]),
        names=("a.jpg",),
        focals_px=torch.ones(1),
    )

    def read(folder: Path) -> object:
        if (folder / "a.png").exists():
            return read_depth(folder, views).depth
        return read_normals(folder, views).normals

    names = ("a.npy", "a.npz", "a.exr", "a.png")
    return [Seed(f"map {name}", _alone(root, name), (name,), read) for name in names]


def _datasets(root: Path) -> list[Seed]:
    _, views = _model()
    masks = torch.zeros(4, 18, 24, dtype=torch.bool)
    masks[:, 4:14, 5:19] = True
    views = views.replace(masks=masks)
    cameras = arc_cameras(4, width=24, height=18, focal_px=30.0, distance=5.0)
    points = _ball().vertices_world
    write_transforms(views, cameras, root / "transforms", points_world=points)
    write_idr(views, cameras, root / "idr", points_world=points)
    write_colmap(views, cameras, root / "colmap", points_world=points)
    world_from_cam = invert_rigid(cameras.cam_from_world.double()).numpy()
    for kind in ("llff/images", "meshroom", "metashape/images", "diligent"):
        (root / kind).mkdir(parents=True)
        for name in views.names:
            Image.fromarray(_pixels()).save(root / kind / name)
    rows, placed = [], []
    for index, name in enumerate(views.names):
        pose = world_from_cam[index]
        columns = np.stack([pose[:3, 1], pose[:3, 0], -pose[:3, 2], pose[:3, 3], [18, 24, 30]], 1)
        rows.append([*columns.reshape(-1), 1.0, 9.0])
        text = " ".join(f"{value:.9g}" for value in pose.reshape(-1))
        placed.append(
            f'<camera id="{index}" sensor_id="0" label="{name}"><transform>{text}</transform>'
            "</camera>"
        )
    np.save(root / "llff" / "poses_bounds.npy", np.array(rows))
    sfm = root / "meshroom" / "cameras.sfm"
    write_sfm(cameras, [f"/x/{name}" for name in views.names], sfm)
    whole = json.loads(sfm.read_text())
    for intrinsic in whole["intrinsics"]:
        intrinsic |= {"distortionType": "radialk3", "distortionParams": ["0.01", "0", "0"]}
    sfm.write_text(json.dumps(whole))
    (root / "metashape" / "cameras.xml").write_text(
        '<?xml version="1.0" encoding="UTF-8"?><document version="2.0.0"><chunk><sensors>'
        '<sensor id="0" type="frame"><resolution width="24" height="18"/><calibration type="frame"'
        ' class="adjusted"><resolution width="24" height="18"/><f>30</f><k1>0.01</k1>'
        f"</calibration></sensor></sensors><cameras>{''.join(placed)}</cameras></chunk></document>"
    )
    lights = "0 0 1\n0.3 0 1\n0 0.3 1\n-0.3 0 1\n"
    (root / "diligent" / "light_directions.txt").write_text(lights)
    (root / "diligent" / "light_intensities.txt").write_text("1 1 1\n" * 4)
    (root / "diligent" / "filenames.txt").write_text("\n".join(views.names))
    Image.fromarray(255 * masks[0].numpy().astype(np.uint8)).save(root / "diligent" / "mask.png")
    normals = np.zeros((18, 24, 3))
    normals[..., 2] = 1
    scipy.io.savemat(root / "diligent" / "Normal_gt.mat", {"Normal_gt": normals})
    readers: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
        "transforms": (read_transforms, ("transforms.json",)),
        "idr": (read_idr, ("cameras.npz",)),
        "llff": (read_llff, ("poses_bounds.npy",)),
        "meshroom": (read_camera_file, ("cameras.sfm",)),
        "metashape": (read_camera_file, ("cameras.xml",)),
        "colmap": (
            read_colmap,
            tuple(f"sparse/0/{part}.bin" for part in ("cameras", "images", "points3D")),
        ),
        "diligent": (
            read_diligent,
            ("light_directions.txt", "light_intensities.txt", "filenames.txt", "Normal_gt.mat"),
        ),
    }
    return [
        Seed(f"dataset {name}", root / name, files, read) for name, (read, files) in readers.items()
    ]


def _camera_files(root: Path) -> list[Seed]:
    """Write cameras that come with photographs of other folders, as `--sparse FILE` reads them."""
    root.mkdir(parents=True)
    _, views = _model()
    cameras = arc_cameras(len(views.names), width=24, height=18, focal_px=30.0, distance=5.0)
    K, poses = cameras.intrinsics.numpy(), cameras.cam_from_world.numpy()
    np.savez(root / "turned.npz", K=K, cam_from_world=poses)
    np.savez_compressed(root / "projections.npz", P=K @ poses[:, :3])
    return [
        Seed(
            f"cameras {name}",
            _alone(root, name),
            (name,),
            lambda at, name=name: read_cameras(
                at / name, views.names, lambda names: [(24, 18)] * len(names)
            ),
        )
        for name in ("turned.npz", "projections.npz")
    ]


def _videos(root: Path) -> list[Seed]:
    if not find_spec("av"):
        return []
    import av

    root.mkdir(parents=True)
    seeds = []
    for name in ("a.mp4", "a.mkv"):
        with av.open(str(root / name), "w") as container:
            stream = container.add_stream("mpeg4", rate=30)
            stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
            for shift in range(8):
                picture = np.roll(np.tile(_pixels(), (2, 2, 1))[:32, :48], shift, axis=1)
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        seeds.append(
            Seed(
                f"video {name}",
                _alone(root, name),
                (name,),
                lambda at, name=name: [*luma_frames(at / name)] and None,
            )
        )
    return seeds


def _rendered(root: Path) -> Seed:
    ball = root.parent / "ball.ply"
    write_ply(_ball(), ball)
    config = SceneConfig(num_views=3, width=24, height=18, supersample=1)
    render_scene(ball, root, config, processes=1)
    files = tuple(
        str(path.relative_to(root))
        for path in sorted((root / "truth").rglob("*"))
        if path.is_file() and path.suffix in (".json", ".npz", ".ply", ".bin")
    )
    return Seed("rendered", root, (*files, "truth/scene.json", "truth/lights.json"), read_rendered)
