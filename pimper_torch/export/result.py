"""Result folders of ``pimper reconstruct``, read with or without their photographs."""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from jaxtyping import Float
from PIL.Image import Image
from torch import Tensor

from pimper_torch.geometry.local_frame import Offset, local_origin, to_local
from pimper_torch.geometry.undistortion import pinholes_for
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.io.photograph_files import image_name, list_images
from pimper_torch.io.photographs import load_views, read_mask
from pimper_torch.radiometry import Encoding
from pimper_torch.records import Cameras, Mesh, Record, Silhouettes, SparseScene, Views
from pimper_torch.records.sparse_model import SparseModel
from pimper_torch.runtime.config import build, read_mapping
from pimper_torch.runtime.errors import InputError, PimperWarning, caution, some
from pimper_torch.runtime.numpy_files import read_npz
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.stages.sfm.sparse_scene import assemble_scene
from pimper_torch.viz.cells import lit_cell
from pimper_torch.viz.overview import preview

_KIND = "a result of `pimper reconstruct`"
_UNRELIABLE = ("silhouettes.unreliable", "silhouettes.empty")  # guards of `left_out`
_FILES = ("mesh.ply", "sparse", "lights.json", "config.yaml", "summary.json")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class WrittenResult(Record):
    """Content of a result folder, without photographs.

    Attributes:
        mesh: The surface of the files, minus ``offset_world``; float32.
        names: Names of the photographs of the reconstruction.
        cameras: Pinholes of the undistorted photographs in float64, in the frame of the files.
        offset_world: Offset subtracted from that frame, see ``SparseScene.offset_world``.
        lights_world: First-order light of every view; NaN where unknown, ``None`` if all are.
        reference: Name of the view in which the images of the result are rendered.
    """

    mesh: Mesh
    names: tuple[str, ...]
    cameras: Cameras
    offset_world: Offset
    lights_world: Float[Tensor, "view 4"] | None
    reference: str
    summary: Mapping[str, Any] = field(repr=False)

    @property
    def mesh_cameras(self) -> Cameras:
        """Cameras in the frame of the mesh; float32."""
        poses = to_local(self.cameras.cam_from_world, self.offset_world)
        return self.cameras.replace(cam_from_world=poses).to(torch.float32)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Result(WrittenResult):
    """Content of a result folder, with the photographs of the reconstruction.

    Attributes:
        scene: Cameras, undistorted photographs and the sparse cloud, in the frame of the mesh;
            float32.
        silhouettes: Silhouettes of the files, 0 or 1; without planes.
    """

    scene: SparseScene
    silhouettes: Silhouettes

    @property
    def masked_views(self) -> Views:
        """Undistorted photographs, with silhouettes as masks if there are any."""
        views = self.scene.views
        if self.silhouettes.source == "everything":
            return views
        return views.replace(masks=self.silhouettes.masks)

    def plot(self) -> Image:
        """Draw a photograph and three views of the surface."""
        return preview(self.scene, self.mesh, self.scene.views.names.index(self.reference))

    def _repr_html_(self) -> str:
        return lit_cell(self, self.mesh, self.scene, self.scene.views.names.index(self.reference))


@isolated
def read_written(folder: Path | str) -> WrittenResult:
    """Read a result folder without its photographs, which may be missing.

    Args:
        folder: Written by ``pimper reconstruct`` or
            :func:`~pimper_torch.export.results.write_result`.

    Returns:
        On the CPU.

    Raises:
        InputError: A file of the result is missing or damaged.
    """
    return _read(Path(folder))[0]


@isolated
def read_result(folder: Path | str, photographs: Path | str | None = None) -> Result:
    """Read a result folder, and its photographs with the settings of the run.

    Photographs that were converted since are matched by their names without suffixes, with a
    :class:`~pimper_torch.runtime.errors.PimperWarning`.

    Args:
        folder: As for :func:`read_written`.
        photographs: Folder of the photographs; by default the one that ``summary.json`` names.
            Photographs larger than in the run are shrunk.

    Returns:
        On the CPU.

    Raises:
        InputError: A file of the result is missing or damaged, or photographs are missing.
    """
    folder = Path(folder)
    written, model = _read(folder)
    views = _photographs(folder, photographs or written.summary.get("photographs"), model)
    scene = assemble_scene(views, model)
    return Result(
        **{each.name: getattr(written, each.name) for each in fields(written)},
        scene=scene,
        silhouettes=_silhouettes(
            folder, scene.views, written.summary, given=views.masks is not None
        ),
    )


def _read(folder: Path) -> tuple[WrittenResult, SparseModel]:
    if missing := [name for name in _FILES if not (folder / name).exists()]:
        found = f"lacks {some(missing)}" if folder.is_dir() else "is not a folder"
        raise InputError(f"{folder}: {found}; needed: a folder written by `pimper reconstruct`.")
    summary = DataSetPath(folder / "summary.json", _KIND).read_json()
    model = read_model(folder / "sparse")
    mesh = read_mesh(folder / "mesh.ply")
    offset = local_origin(model.cam_from_world, model.points_world)
    local = mesh.vertices_world - mesh.vertices_world.new_tensor(offset)
    reference = summary.get("reference") or read_reference(folder / "depth.npz")
    written = WrittenResult(
        mesh=mesh.replace(vertices_world=local).to(torch.float32),
        names=model.names,
        cameras=Cameras(
            intrinsics=pinholes_for(model.lenses),
            cam_from_world=model.cam_from_world,
            sizes_px=torch.tensor([[lens.width, lens.height] for lens in model.lenses]),
        ),
        offset_world=offset,
        lights_world=read_lights(folder / "lights.json", model.names),
        reference=str(reference) if reference in model.names else model.names[0],
        summary=summary,
    )
    return written, model


def _photographs(folder: Path, photographs: object, model: SparseModel) -> Views:
    """Read the photographs of a model as the run read them, under the same names.

    The longest side of the model's images is the one to which the run shrank photographs. Warnings
    are not repeated, as the run gave them.
    """
    if not isinstance(photographs, str | Path):
        raise InputError(
            f"{folder}: its summary.json does not name the folder of its photographs; needed: this "
            "folder. Give it with `--photos DIR` (`photographs=`)."
        )
    path = Path(photographs)
    files = [image_name(file, path) for file in list_images(path)] if path.is_dir() else []
    by_stem = {Path(file).with_suffix(""): file for file in files}
    file_of = {name: by_stem.get(Path(name).with_suffix("")) for name in model.names}
    if missing := [name for name, file in file_of.items() if file is None]:
        raise InputError(
            f"{folder}: its photographs {some(missing)} are not in {path.absolute()}; needed: all "
            f"{model.num_views} photographs of the run. Give their folder with `--photos DIR` "
            "(`photographs=`)."
        )
    if converted := [f"{file} for {name}" for name, file in file_of.items() if file != name]:
        caution(
            f"{path}: photographs were converted since the run of {folder}; {some(converted)} are "
            "read. Give the folder of the originals with `--photos DIR` (`photographs=`).",
            stacklevel=4,
        )
    settings = read_mapping(folder / "config.yaml").get("photographs") or {}
    where = f"{folder / 'config.yaml'}: photographs"
    encoding = build(Encoding, settings if isinstance(settings, Mapping) else {}, where)
    longest = max(max(lens.width, lens.height) for lens in model.lenses)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PimperWarning)
        views = load_views(path, encoding=encoding, max_size_px=longest)
    name_of = {file: name for name, file in file_of.items()}
    views = views.replace(names=tuple(name_of.get(file, file) for file in views.names))
    sizes = dict(zip(views.names, views.sizes_px.tolist(), strict=True))
    for name, lens in zip(model.names, model.lenses, strict=True):
        if sizes[name] != [lens.width, lens.height]:
            raise InputError(
                f"{path / name}: has {sizes[name][0]} x {sizes[name][1]} pixels, but "
                f"{lens.width} x {lens.height} in {folder}; needed: the same photograph. Give the "
                "folder of the originals with `--photos DIR` (`photographs=`)."
            )
    return views


def _silhouettes(
    folder: Path, views: Views, summary: Mapping[str, object], *, given: bool
) -> Silhouettes:
    """Read the masks of a result; silhouettes that were unreliable stay so."""
    if not (folder / "masks").is_dir():
        return Silhouettes.everything(views)
    inside = torch.zeros_like(views.images[:, 0])
    for index, (name, size) in enumerate(zip(views.names, views.sizes_px.tolist(), strict=True)):
        path = mask_path(folder / "masks", name)
        mask = read_mask(path)
        width, height = size
        if mask.shape != (height, width):
            raise InputError(
                f"{path}: has {mask.shape[1]} x {mask.shape[0]} pixels; needed: {width} x "
                f"{height}, like its photograph. Run `pimper reconstruct` again."
            )
        inside[index, :height, :width] = mask.to(inside)
    entries = summary.get("left_out")
    unreliable = {
        name
        for entry in (entries if isinstance(entries, list) else [])
        if isinstance(entry, dict) and entry.get("guard") in _UNRELIABLE
        for name in entry.get("names") or ()
    }
    return Silhouettes(
        inside=inside,
        reliable=torch.tensor([name not in unreliable for name in views.names]),
        source="masks" if given or summary.get("masks") else "found",
    )


def read_lights(path: Path | str, names: tuple[str, ...]) -> Float[Tensor, "view 4"] | None:
    """Read the light of every named view; NaN if the file lacks it.

    Returns:
        ``None`` without such a file, without views, or without lights.
    """
    file = DataSetPath(Path(path), _KIND)
    if not file.path.is_file() or not names:
        return None
    views = file.objects(file.read_json().get("views"), "views")
    light_of = {str(view.get("name")): view.get("light") for view in views}
    unknown = torch.full((4,), torch.nan, dtype=torch.float64)
    rows = [
        file.numbers(light_of[name], 4, f"light of {name}") if light_of.get(name) else unknown
        for name in names
    ]
    lights = torch.stack(rows)
    return lights if bool(lights.isfinite().any()) else None


def read_reference(path: Path | str) -> str | None:
    """Read the name of the reference view; ``None`` without such a file."""
    file = DataSetPath(Path(path), _KIND)
    if not file.path.is_file():
        return None
    arrays = file.read(lambda path: read_npz(path, lambda name: name == "name"), "an archive")
    return str(arrays["name"]) if "name" in arrays else None


def mask_path(folder: Path | str, name: str) -> Path:
    """Return the path of the mask of a photograph, by its name and always inside the folder.

    >>> mask_path(Path("masks"), "pose_03/../light_02.jpg").as_posix()
    'masks/pose_03/light_02.png'
    """
    parts = PurePosixPath(name.replace("\\", "_")).with_suffix(".png").parts
    return Path(folder).joinpath(*(part for part in parts if part not in ("/", "..")))
