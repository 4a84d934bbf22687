"""Rendered scenes, as :func:`pimper_torch.evidence.scenes.rendered_folder` writes them."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.camera_files.layout import expect, inside, read_json
from pimper_torch.config import build
from pimper_torch.errors import ConfigError, InputError
from pimper_torch.evidence.scenes.rendered_folder import (
    FORMAT,
    FORMAT_VERSION,
    MAP_NAMES,
    unpack_maps,
)
from pimper_torch.evidence.scenes.scene_settings import SceneConfig
from pimper_torch.io.decode import decode
from pimper_torch.io.meshes import read_mesh
from pimper_torch.numpy_files import read_npz
from pimper_torch.progress import track
from pimper_torch.radiometry import Linear, Srgb
from pimper_torch.records import Cameras, Capture, Truth, Views
from pimper_torch.sfm.colmap import pinhole_of, read_model

_KIND = "a rendered scene (`pimper render`)"


def read_rendered(
    folder: Path | str,
    *,
    views: Sequence[int] | None = None,
    maps: bool = True,
    photographs: bool = True,
) -> Capture:
    """Read a rendered scene, or as much of it as memory should hold.

    A view of 1600 x 1200 takes 23 MB of memory for its photograph and 60 MB for its maps.

    Args:
        views: Numbers of those wanted, in the order wanted; ``None`` is all.
        maps: Read depth, normals, albedo and masks too; without, they are ``None``.
        photographs: Read these and the object's masks too; without, the images are zeros
            that take no memory, and there are no masks.

    Returns:
        Cameras and lights in float64. Every view has a light of its own, and a position of its own
        unless ``lights_per_pose`` share one.

    Raises:
        InputError: Not such a folder, or something in it is missing or damaged.
    """
    folder = Path(folder)
    names, settings = _read_report(folder)
    chosen = list(range(len(names)) if views is None else views)
    expect(
        len(set(chosen)) == len(chosen) > 0 and all(0 <= one < len(names) for one in chosen),
        folder,
        _KIND,
        f"different views between 0 and {len(names) - 1}",
        f"a wish for {chosen}",
    )
    named = [names[one] for one in chosen]
    cameras = _read_cameras(folder, named)
    pictures = _read_views(folder, named, settings, cameras, photographs)
    point_lights, lights = _read_lights(folder, names, chosen)
    truth = Truth(
        mesh=read_mesh(folder / "truth" / "mesh.ply"),
        surroundings=None
        if settings.fixed_table or settings.turned_over
        else read_mesh(folder / "truth" / "surroundings.ply"),
        lights_world=lights,
        point_lights_world=point_lights,
    )
    if maps:
        truth = truth.replace(**_read_maps(folder, named, settings))
    order = torch.tensor(chosen)
    position = order // settings.lights_per_pose
    if settings.lights_per_pose > 1:
        pictures = pictures.replace(poses=position)
    return Capture(views=pictures, cameras=cameras, truth=truth, position=position, light=order)


def _read_report(folder: Path) -> tuple[tuple[str, ...], SceneConfig]:
    path = folder / "truth" / "scene.json"
    report = read_json(path, _KIND)
    expect(
        report.get("format") == FORMAT and report.get("format_version") == FORMAT_VERSION,
        path,
        _KIND,
        f"format {FORMAT!r}, version {FORMAT_VERSION}",
        f"{report.get('format')!r}, version {report.get('format_version')!r}",
    )
    names, settings = report.get("names"), report.get("settings")
    expect(
        isinstance(settings, dict)
        and isinstance(names, list)
        and all(
            isinstance(name, str) and Path(name).name and ".." not in Path(name).parts
            for name in names
        ),
        path,
        _KIND,
        "a list `names` of file names, and `settings`",
        f"names {names!r}",
    )
    assert isinstance(names, list)
    assert isinstance(settings, dict)
    try:
        # Settings that have gone since changed nothing that is read here.
        known = {name: settings[name] for name in SceneConfig.__slots__ if name in settings}
        config = build(SceneConfig, known, str(path))
    except ConfigError as error:
        raise InputError(f"{path}: {error}") from error
    expect(
        len(names) == config.num_views and len(set(names)) == len(names),
        path,
        _KIND,
        f"num_views = {config.num_views} different names",
        f"{len(names)} names",
    )
    return tuple(names), config


def _read_cameras(folder: Path, names: Sequence[str]) -> Cameras:
    model = read_model(folder / "truth" / "sparse")
    missing = [name for name in names if name not in model.names]
    expect(
        not missing, folder / "truth" / "sparse", _KIND, f"cameras of {names}", f"none of {missing}"
    )
    rows = [model.names.index(name) for name in names]
    lenses = [model.lenses[row] for row in rows]
    return Cameras(
        intrinsics=torch.stack([pinhole_of(lens) for lens in lenses]),
        cam_from_world=model.cam_from_world[rows],
        sizes_px=torch.tensor([[lens.width, lens.height] for lens in lenses]),
    )


def _read_views(
    folder: Path,
    names: Sequence[str],
    settings: SceneConfig,
    cameras: Cameras,
    photographs: bool,
) -> Views:
    width, height = settings.width, settings.height
    response = Srgb() if settings.encoding == "srgb" else Linear()
    images = torch.zeros(1).expand(len(names), 3, height, width)
    masks = None
    if photographs:
        images = torch.zeros(len(names), 3, height, width)
        masks = torch.zeros(len(names), height, width, dtype=torch.bool)
        for row in track(range(len(names))):
            samples = _read_picture(folder / "photos", names[row], width, height)
            images[row] = response.linear_from_encoded(samples).expand(3, -1, -1)
            masks[row] = _read_picture(folder / "masks", names[row], width, height).amax(dim=0) > 0
    return Views(
        images=images,
        sizes_px=cameras.sizes_px,
        names=tuple(names),
        masks=masks,
        focals_px=torch.full((len(names),), torch.nan),
    )


def _read_picture(
    folder: Path, name: str, width: int, height: int
) -> Float[Tensor, "channel {height} {width}"]:
    samples = decode(_file(folder, name)).samples
    expect(
        samples.shape[1:] == (height, width),
        folder / name,
        _KIND,
        f"{width} x {height} pixels as scene.json says",
        f"{samples.shape[2]} x {samples.shape[1]}",
    )
    return samples


def _read_maps(folder: Path, names: Sequence[str], settings: SceneConfig) -> dict[str, Tensor]:
    read: dict[str, list[Tensor]] = {name: [] for name in MAP_NAMES}
    for name in track(names):
        path = _file(folder / "truth" / "maps", Path(name).with_suffix(".npz").as_posix())
        try:
            maps = unpack_maps(read_npz(path))
        except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
            raise InputError(
                f"{path}: cannot be read, it seems damaged ({error}). Render the scene again."
            ) from error
        for key, values in maps.items():
            expect(
                values.shape[:2] == (settings.height, settings.width),
                path,
                _KIND,
                f"{key} of {settings.width} x {settings.height} pixels as scene.json says",
                f"a shape of {tuple(values.shape)}",
            )
            finite = key == "depth" or bool(values.isfinite().all())  # depth is infinite off it
            expect(finite, path, _KIND, f"finite numbers as {key}", "others")
            read[key].append(values)
    return {key: torch.stack(values) for key, values in read.items()}


def _read_lights(
    folder: Path, names: Sequence[str], chosen: Sequence[int]
) -> tuple[Float[Tensor, "view 3"], Float[Tensor, "view 4"]]:
    path = folder / "truth" / "lights.json"
    report = read_json(path, _KIND)
    try:
        point_lights = torch.tensor(report["positions_world"], dtype=torch.float64)
        lights = torch.tensor(report["harmonics_world"], dtype=torch.float64)
    except (KeyError, TypeError, ValueError, OverflowError, RuntimeError) as error:
        raise InputError(
            f"{path}: has no numbers in `positions_world` or `harmonics_world` ({error}). Render "
            "the scene again."
        ) from error
    expect(
        point_lights.shape == (len(names), 3) and lights.shape == (len(names), 4),
        path,
        _KIND,
        f"a position and four harmonics for each of {len(names)} views",
        f"{tuple(point_lights.shape)} and {tuple(lights.shape)}",
    )
    return point_lights[list(chosen)], lights[list(chosen)]


def _file(folder: Path, name: str) -> Path:
    path = inside(folder, name, _KIND)
    expect(path.is_file(), folder, _KIND, f"a file {name}")
    return path
