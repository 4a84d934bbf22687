"""Reader of scenes that :func:`pimper_bench.scenes.rendered_folder` wrote."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_bench.datasets.raster import read_photographs
from pimper_bench.scenes.ray_tracing import MAP_NAMES
from pimper_bench.scenes.scene_files import FORMAT, FORMAT_VERSION, unpack_maps
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.truth import Capture, Truth
from pimper_torch.geometry.lens_models import pinholes_of
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import Encoding
from pimper_torch.records import Cameras, Views
from pimper_torch.runtime.config import build
from pimper_torch.runtime.errors import ConfigError, InputError
from pimper_torch.runtime.numpy_files import read_npz
from pimper_torch.runtime.progress import track

_KIND = "a rendered scene (`pimper render`)"
_PICTURES = ("photos", "masks")


def read_rendered(
    folder: Path | str,
    *,
    views: Sequence[int] | None = None,
    maps: bool = True,
    photographs: bool = True,
) -> Capture:
    """Read a rendered scene, or parts of it to save memory.

    A view of 1600 x 1200 takes 23 MB of memory for its photograph and 60 MB for its maps.

    Args:
        views: Indices of the views to read, in order; ``None`` for all.
        maps: Whether to read depth, normals, albedo and masks; if not, they are ``None``.
        photographs: Whether to read photographs and the object's masks; if not, the images are
            zeros that take no memory, and masks are ``None``.

    Returns:
        Cameras and lights in float64. Every view has a different light, and a different position
        unless ``lights_per_pose`` views share one.
    """
    root = DataSetPath(Path(folder), _KIND)
    names, settings = _read_report(root)
    chosen = list(range(len(names)) if views is None else views)
    root.expect(
        len(set(chosen)) == len(chosen) > 0 and all(0 <= view < len(names) for view in chosen),
        f"different views between 0 and {len(names) - 1}",
        f"a request for {chosen}",
    )
    named = [names[view] for view in chosen]
    truth_of = root.inner("truth")
    cameras = _read_cameras(truth_of.inner("sparse"), named)
    photographed = _read_views(root, named, settings, cameras, photographs)
    lights = _read_lights(truth_of.inner("lights.json"), len(names))
    moving = settings.fixed_table or settings.turned_over
    truth = Truth(
        mesh=read_mesh(truth_of.path / "mesh.ply"),
        surroundings=None if moving else read_mesh(truth_of.path / "surroundings.ply"),
        lights_world=lights[chosen],
    )
    if maps:
        truth = truth.replace(**_read_maps(truth_of.inner("maps"), named, settings))
    order = torch.tensor(chosen)
    position = order // settings.lights_per_pose
    if settings.lights_per_pose > 1:
        photographed = photographed.replace(poses=position)
    return Capture(views=photographed, cameras=cameras, truth=truth, position=position, light=order)


def _read_report(root: DataSetPath) -> tuple[tuple[str, ...], SceneConfig]:
    file = root.inner("truth/scene.json")
    report = file.read_json()
    header = (report.get("format"), report.get("format_version"))
    needed = f"format {FORMAT!r}, version {FORMAT_VERSION}"
    file.expect(header == (FORMAT, FORMAT_VERSION), needed, "{!r}, version {!r}".format(*header))
    names, settings = report.get("names"), report.get("settings")
    if not isinstance(settings, dict) or not isinstance(names, list):
        file.refuse("a list `names` of file names, and `settings`", f"names {names!r}")
    for name in names:
        ok = isinstance(name, str) and Path(name).name and ".." not in Path(name).parts
        file.expect(bool(ok), "a list `names` of file names, and `settings`", f"names {names!r}")
    try:
        # Settings that were removed since do not affect the values read here.
        present = {name: settings[name] for name in SceneConfig.__slots__ if name in settings}
        config = build(SceneConfig, present, str(file.path))
    except ConfigError as error:
        raise InputError(f"{file.path}: {error}") from error
    ok = len(names) == config.num_views and len(set(names)) == len(names)
    file.expect(ok, f"num_views = {config.num_views} different names", f"{len(names)} names")
    return tuple(names), config


def _read_cameras(folder: DataSetPath, names: Sequence[str]) -> Cameras:
    model = read_model(folder.path)
    missing = [name for name in names if name not in model.names]
    folder.expect(not missing, f"cameras of {names}", f"none of {missing}")
    return pinholes_of(model).take([model.names.index(name) for name in names])


def _read_views(
    root: DataSetPath,
    names: Sequence[str],
    settings: SceneConfig,
    cameras: Cameras,
    photographs: bool,
) -> Views:
    width, height = settings.width, settings.height
    if not photographs:
        return Views(
            images=torch.zeros(1).expand(len(names), 3, height, width),
            sizes_px=cameras.sizes_px,
            names=tuple(names),
            focals_px=torch.full((len(names),), torch.nan),
        )
    paths, masks = ([root.inner(kind).inside(name) for name in names] for kind in _PICTURES)
    encoding = Encoding(response=settings.encoding, saturation=1.0)
    views = read_photographs(paths, names, encoding=encoding, masks=masks)
    for name, size in zip(names, views.sizes_px.tolist(), strict=True):
        needed = f"{width} x {height} pixels as in scene.json"
        ok = size == [width, height]
        root.expect(ok, f"{name} of {needed}", f"{size[0]} x {size[1]}")
    return views.replace(images=views.images.expand(-1, 3, -1, -1))


def _read_maps(
    folder: DataSetPath, names: Sequence[str], settings: SceneConfig
) -> dict[str, Tensor]:
    read: dict[str, list[Tensor]] = {name: [] for name in MAP_NAMES}
    size = f"{settings.width} x {settings.height} pixels as in scene.json"
    for name in track(names):
        inner = folder.inside(Path(name).with_suffix(".npz").as_posix())
        file = folder._replace(path=inner)
        maps = file.read(lambda path: unpack_maps(read_npz(path)), "maps")
        for key, values in maps.items():
            ok = values.shape[:2] == (settings.height, settings.width)
            file.expect(ok, f"{key} of {size}", f"a shape of {tuple(values.shape)}")
            finite = key == "depth" or bool(values.isfinite().all())  # depth is infinite for misses
            file.expect(finite, f"finite numbers as {key}", "values that are not finite")
            read[key].append(values)
    return {key: torch.stack(values) for key, values in read.items()}


def _read_lights(file: DataSetPath, count: int) -> Float[Tensor, "view 4"]:
    harmonics = file.read_json().get("harmonics_world")
    needed = f"harmonics_world, for each of {count} views"
    return file.numbers(harmonics, 4 * count, needed).reshape(-1, 4)
