"""Options of ``reconstruct`` and ``demo``, with the settings of all stages."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pimper_torch.cli.arguments import Flag, Option, options_of, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.export.result_folder.files import require_name
from pimper_torch.export.result_folder.folders import prepare_output, require_apart
from pimper_torch.export.result_folder.marker import read_marker
from pimper_torch.io.assets.mesh_files import MeshFiles, MeshFormat, TextureFormat
from pimper_torch.io.photograph_files import image_name, list_images
from pimper_torch.paper.paper_config import PublishedConfig
from pimper_torch.presets.load_config import Config, load_config
from pimper_torch.priors.map_config import DEPTH_ERROR, NORMALS_ERROR_DEG, NormalAxes
from pimper_torch.priors.salient_networks import network_file, require_network
from pimper_torch.runtime.config import bytes_of, presets, require
from pimper_torch.runtime.errors import ConfigError, InputError
from pimper_torch.runtime.file_names import view_named
from pimper_torch.scale import given
from pimper_torch.viewer.server import require_viser


def _words(read: Callable[..., object], metavar: str) -> Any:  # noqa: ANN401 - tyro's
    """Read as many words of the command line as the placeholder has as one value."""
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=len(metavar.split()),
        metavar=metavar,
        instance_from_str=lambda words: read(*words),
        is_instance=lambda _: True,
        str_from_instance=lambda value: [str(value)],
    )


_PLACE, _BAR, _DISTANCE = "NAME,x,y", "A,x,y B,x,y LENGTH", "A B LENGTH"
_Place = Annotated[given.Mark, _words(given.Mark.read, _PLACE)]
_Bar = Annotated[given.ScaleBar, _words(given.ScaleBar.read, _BAR)]
_Distance = Annotated[given.CameraDistance, _words(given.CameraDistance.read, _DISTANCE)]
Places = Annotated[tyro.conf.UseAppendAction[tuple[_Place, ...]], tyro.conf.arg(metavar=_PLACE)]
ScaleBars = Annotated[tyro.conf.UseAppendAction[tuple[_Bar, ...]], tyro.conf.arg(metavar=_BAR)]
CameraDistances = Annotated[
    tyro.conf.UseAppendAction[tuple[_Distance, ...]], tyro.conf.arg(metavar=_DISTANCE)
]
Markers = Annotated[Literal["auto", "off"] | float, tyro.conf.arg(metavar="auto|off|MM")]

# The demo keeps 0.8 GB. Chosen for a few runs with photographs of twice the size.
MAX_KEPT = "8GB"


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonOptions:
    """Options of every reconstruction.

    Attributes:
        preset: Settings to start from: default, fast, paper, or your own YAML file.
        reference: Photograph for sample spacing and rendered views; by default automatic.
        device: Device of the stages after structure from motion; cuda has not been tested on a GPU.
        max_size_px: Longer side of shrunk photographs, 0 for none; 1600, or less for short memory.
        overwrite: Replace the result in OUT.
        faces: Maximum number of faces of the mesh, or all; by default as few as the shape needs.
        watertight: Close the mesh; caps are marked as not measured.
        stl: Also write the mesh as STL.
        obj: Also write mesh and asset as OBJ.
        texture: Format of the textures in asset.glb.
        asset_cameras: Include the cameras of the photographs in asset.glb.
        no_report: Do not write report.html.
        open: Open report.html at the end.
        fresh: Ignore the records that earlier runs kept.
        cache: Folder for the records of stages, which later runs reuse; OUT/.stages by default.
        max_kept: Maximum size of this folder, such as 2GB.
        view: Show cameras and each pass in the browser.
    """

    preset: str = "default"
    reference: str = ""
    device: Literal["cpu", "cuda"] = "cpu"
    max_size_px: int | None = None
    overwrite: Flag = False
    faces: Annotated[int | Literal["all"] | None, tyro.conf.arg(metavar="N")] = None
    watertight: Flag = False
    stl: Flag = False
    obj: Flag = False
    texture: TextureFormat = "png"
    asset_cameras: Flag = False
    no_report: Flag = False
    open: Flag = False
    fresh: Flag = False
    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    max_kept: str = MAX_KEPT
    view: Flag = False

    def __post_init__(self) -> None:
        bytes_of(self.max_kept, "max_kept")
        _ = self.files  # refused before anything is read
        # The smallest photographs for which depth maps are computed.
        size = self.max_size_px or 0
        require(size == 0 or size >= 32, "max_size_px", size, "0, or at least 32 pixels")

    @property
    def files(self) -> MeshFiles:
        """Faces and file formats of the written surface."""
        wanted: dict[MeshFormat, bool] = {"stl": self.stl, "obj": self.obj}
        return MeshFiles(
            faces=self.faces,
            watertight=self.watertight,
            formats=tuple(name for name, written in wanted.items() if written),
            texture=self.texture,
            cameras=self.asset_cameras,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class InputOptions:
    """Optional inputs besides the photographs.

    Attributes:
        masks: Folder with a mask for each photograph, of the same name; zero off the object.
        mask_object: Brightness of the object in the masks; auto decides from all masks together.
        sparse: Known cameras: folder of a COLMAP model, transforms.json, cameras.xml, .sfm or .npz.
        mesh: Rough surface to start from (PLY, OBJ, STL, GLB), in the frame of these cameras.
        object: Compute the object's silhouettes (auto), use the masks (masks), or reconstruct all
            in view, such as walls (everything). (default: auto)
        region: Box around the object: smallest and largest corner in scene units, such as
            (-1,-1,0,1,1,2).
        scale_bar: Two points in photographs, in pixels, and their distance; may be repeated.
        camera_distance: Two photographs and the distance between their cameras; may be repeated.
        markers: Use markers printed by `pimper markers` for real size (auto), or not (off); or the
            side of other markers in millimetres. With --sparse, only markers of a given side count.
        unit: Unit of given lengths, and of the result if its size is known.
        silhouettes: Folder of soft masks of a segmentation network, for all or some photographs, of
            any size: PNG, JPEG, EXR, NPZ or NPY. Contradicting views overrule them.
        segmenter: Make soft masks by a salient-object network: name of one in rembg, such as u2net,
            isnet-general-use or birefnet-general; or its ONNX file.
        object_at: Pixel of a photograph on the object; may be repeated.
        normals: Folder of a network's normal maps, named like photographs: PNG, EXR, NPZ or NPY.
        axes: Axes of these normals; auto detects them from point cloud and outlines.
        normals_error_deg: Root mean square error in degrees, if no file has their variance.
        depth: Folder of depth maps of a network; their kind is detected from the point cloud.
        depth_error: Root mean square error over the range of depths, if no file has their variance.
    """

    masks: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    mask_object: Literal["auto", "bright", "dark"] = "auto"
    sparse: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    mesh: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    object: Literal["auto", "masks", "everything"] | None = None
    region: tuple[float, ...] = ()
    scale_bar: ScaleBars = ()
    camera_distance: CameraDistances = ()
    markers: Markers = "auto"
    unit: given.Unit = "mm"
    silhouettes: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    segmenter: Annotated[str, tyro.conf.arg(metavar="NAME|FILE")] = ""
    object_at: Places = ()
    normals: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    axes: NormalAxes = "auto"
    normals_error_deg: float = NORMALS_ERROR_DEG
    depth: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    depth_error: float = DEPTH_ERROR

    def __post_init__(self) -> None:
        valid = isinstance(self.markers, str) or 0 < self.markers < float("inf")
        require(valid, "markers", self.markers, "auto, off, or a length in millimetres above 0")
        require(
            self.masks is None or not (self.silhouettes or self.segmenter or self.object_at),
            "--silhouettes, --segmenter or --object-at",
            str(self.silhouettes or self.segmenter or (*self.object_at, "")[0]),
            "no value together with --masks, which are used unchanged",
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """Arguments of a run."""

    photos: Path
    out: Path
    common: CommonOptions
    config: Config
    inputs: InputOptions = field(default_factory=InputOptions)


# Rarely used options, listed by `--help-all` only.
_RARE = (
    *("--scales", "--on-failure", "--max-kept", "--camera-distance", "--markers", "--unit"),
    *("--no-report", "--normals", "--axes", "--normals-error-deg", "--depth", "--depth-error"),
    *("--silhouettes", "--segmenter", "--object-at", "--texture", "--asset-cameras"),
)

# Both cranium and face of the skull are visible in this photograph.
SKULL = CommonOptions(reference="37")


def parse(command: str, arguments: Sequence[str]) -> Job:
    """Return the run that the arguments of a command describe.

    The preset is read first: its settings are the defaults, also in ``--help-all``.
    """
    name = _preset(arguments)
    _refuse_others(command, arguments, name)
    verb = _command(command, load_config(name))
    job = read_arguments(verb, command, arguments, levels=True, rare=_RARE)
    shortcuts = {"object": job.inputs.object, "region": tuple(map(float, job.inputs.region))}
    changes: dict[str, Any] = {name: value for name, value in shortcuts.items() if value}
    silhouettes = dataclasses.replace(job.config.silhouettes, **changes)
    config = dataclasses.replace(job.config, silhouettes=silhouettes)
    if reference := job.common.reference:
        surface = dataclasses.replace(config.coarse_surface, reference=reference)
        config = dataclasses.replace(config, coarse_surface=surface)
        if isinstance(config, PublishedConfig):
            triangulate = dataclasses.replace(config.triangulate, reference=reference)
            config = dataclasses.replace(config, triangulate=triangulate)
    return dataclasses.replace(job, config=config)


def _command(name: str, preset: Config) -> Callable[..., Job]:
    """Return the command as a function, with the settings of a preset as default arguments."""
    settings: Any = type(preset)  # chains have different settings

    def reconstruct(
        photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")],
        out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")],
        inputs: Annotated[InputOptions, tyro.conf.arg(name="")] = InputOptions(),
        common: Annotated[CommonOptions, tyro.conf.arg(name="")] = CommonOptions(),
        config: Annotated[settings, tyro.conf.arg(name="")] = preset,
    ) -> Job:
        """Reconstruct the surface of an object from a folder of photographs.

        Args:
            photos: Folder of JPEG, PNG or TIFF files.
            out: Folder for the result; new or empty.
            inputs: Optional inputs besides the photographs.
        """
        return Job(photos=photos, out=out, common=common, inputs=inputs, config=config)

    def demo(
        out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")] = Path("pimper_demo"),
        common: Annotated[CommonOptions, tyro.conf.arg(name="")] = SKULL,
        config: Annotated[settings, tyro.conf.arg(name="")] = preset,
    ) -> Job:
        """Reconstruct the skull whose photographs come with the package.

        Args:
            out: Folder for the result; new or empty.
        """
        return Job(photos=bundled_photographs(), out=out, common=common, config=config)

    return reconstruct if name == "reconstruct" else demo


def every_option(command: str) -> list[Option]:
    """List the options of a command for all presets."""
    return [
        option for name in presets() for option in options_of(_command(command, load_config(name)))
    ]


def _refuse_others(command: str, arguments: Sequence[str], preset: str) -> None:
    """Refuse options that only other presets have."""

    def options(preset: str) -> set[str]:
        names = (option.names for option in options_of(_command(command, load_config(preset))))
        return {name for spellings in names for name in spellings}

    written = {argument.partition("=")[0].replace("_", "-") for argument in arguments}
    named = {argument for argument in written if argument.startswith("--")}
    for option in sorted(named - options(preset)):
        if others := [name for name in presets() if option in options(name)]:
            raise ConfigError(
                f"{option} is not an option of the preset {preset}, but of {', '.join(others)}. "
                f"Remove it, or choose `--preset {others[0]}`."
            )


def run(job: Job, output: Output) -> None:
    """Run ``reconstruct`` or ``demo``."""
    from pimper_torch.cli.run import carry_out

    carry_out(job, output)


def checked(command: str, arguments: Sequence[str]) -> Job:
    """Return the run of the arguments, after all checks that do not read photographs."""
    return check(parse(command, arguments))


def check(job: Job) -> Job:
    """Make all checks of a run that do not read photographs, and return the run."""
    if job.common.view:
        require_viser()
    if job.inputs.segmenter:
        require_network(job.inputs.segmenter)
    require_apart(job.out, inputs_of(job))
    prepare_output(job.out, "result", job.common.overwrite)
    refuse_result(job.photos)
    for folder in (job.photos, job.inputs.masks):
        if folder is not None:
            for path in list_images(folder):
                require_name(path, InputError)
    present = [image_name(path, job.photos) for path in list_images(job.photos)]
    least = job.config.factorize.min_views
    if len(present) < least:
        raise InputError(
            f"{job.photos}: the number of photographs is {len(present)}; needed: at least {least}, "
            f"better 10 or more. A normal is computed from at least {least} lights "
            "(`factorize.min_views`)."
        )
    references = [job.config.coarse_surface.reference]
    if isinstance(job.config, PublishedConfig):
        references.append(job.config.triangulate.reference)
    marked = [pointer.name for mark in job.inputs.object_at for pointer in mark.pointers]
    measured = given.measured_in(job.inputs.scale_bar, job.inputs.camera_distance)
    for name in (*filter(None, references), *measured, *marked):
        view_named(name, present)
    return job


def refuse_result(folder: Path) -> None:
    """Raise an error for a folder of results in place of photographs."""
    marker = read_marker(folder)
    if marker is not None and marker.kind == "result":
        raise InputError(
            f"{folder}: is a result of `pimper reconstruct`; needed: a folder of photographs."
        )


def inputs_of(job: Job) -> dict[str, Path | None]:
    """Return the files and folders that a run reads, by option."""
    return {
        "PHOTOS": job.photos,
        "--masks": job.inputs.masks,
        "--sparse": job.inputs.sparse,
        "--mesh": job.inputs.mesh,
        "--silhouettes": job.inputs.silhouettes,
        "--segmenter": network_file(job.inputs.segmenter) if job.inputs.segmenter else None,
        "--normals": job.inputs.normals,
        "--depth": job.inputs.depth,
        "--cache": job.common.cache,
    }


def bundled_photographs() -> Path:
    """Return the folder of the skull's photographs, which also contains their licence."""
    return Path(str(resources.files("pimper_torch"))) / "data" / "skull"


def _preset(arguments: Sequence[str]) -> str:
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == "--preset":
            return value if equals else "".join(arguments[index + 1 : index + 2]) or "default"
    return CommonOptions().preset
