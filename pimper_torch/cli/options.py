"""The options of every command, and the settings of every stage as options."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pimper_torch.cli.arguments import Flag, Option, options_of, read_arguments
from pimper_torch.cli.output import Output
from pimper_torch.doors.io.photograph_files import image_name, list_images
from pimper_torch.doors.result_folder.files import require_name
from pimper_torch.doors.result_folder.folders import prepare_output, require_apart
from pimper_torch.doors.scale import given
from pimper_torch.method.chains.chain_config import Config, PublishedConfig, load_config
from pimper_torch.priors.map_config import DEPTH_ERROR, NORMALS_ERROR_DEG, NormalAxes
from pimper_torch.result.asset.mesh_files import MeshFiles, MeshFormat, TextureFormat
from pimper_torch.result.viewer.server import require_viser
from pimper_torch.runtime.config import bytes_of, presets, require
from pimper_torch.runtime.errors import ConfigError, InputError
from pimper_torch.runtime.file_names import view_named


def _word(kind: type, read: Callable[[str], object], metavar: str) -> Any:  # noqa: ANN401 - tyro's
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar=metavar,
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda one: isinstance(one, kind),
        str_from_instance=lambda one: [str(one)],
    )


_Place = Annotated[given.Mark, _word(given.Mark, given.Mark.read, "NAME,x,y")]
_Name = Annotated[str, _word(str, str, "NAME")]
_Bar = tuple[_Place, _Place, float]
_Distance = tuple[_Name, _Name, float]
Places = Annotated[tyro.conf.UseAppendAction[tuple[_Place, ...]], tyro.conf.arg(metavar="NAME,x,y")]
ScaleBars = Annotated[
    tyro.conf.UseAppendAction[tuple[_Bar, ...]], tyro.conf.arg(metavar="A,x,y B,x,y LENGTH")
]
CameraDistances = Annotated[
    tyro.conf.UseAppendAction[tuple[_Distance, ...]], tyro.conf.arg(metavar="A B LENGTH")
]
Markers = Annotated[Literal["auto", "off"] | float, tyro.conf.arg(metavar="auto|off|MM")]

# The demo keeps 0.5 GB. A choice: a few runs of twice as large photographs.
MAX_KEPT = "8GB"


@dataclass(frozen=True, slots=True, kw_only=True)
class CommonOptions:
    """Options that every command has.

    Attributes:
        preset: Settings to start from: default, fast, paper, or a YAML file of your own.
        reference: Photograph that facets and pictures are seen from; chosen unless given.
        device: Of all after structure from motion; cuda has never been run on a GPU.
        max_size_px: Shrink photographs whose longer side is longer; 0 leaves them.
        overwrite: Replace a former result in OUT.
        faces: Most that the mesh has, or all; as few as tell the surface unless given.
        watertight: Close the mesh; caps are marked as not measured.
        stl: Write the mesh as STL, too.
        obj: Write mesh and asset as OBJ, too.
        usdz: Write the asset as USDZ, too; needs pip install "pimper_torch[usd]".
        texture: Of the pictures in asset.glb.
        asset_cameras: Put the cameras of the photographs in asset.glb.
        no_report: Leave out report.html.
        fresh: Ignore what an earlier run kept.
        cache: Folder that keeps what stages find, for the next run; OUT/.stages unless given.
        max_kept: Size it may reach, such as 2GB.
        view: Show cameras and every pass in the browser as soon as they are there.
    """

    preset: str = "default"
    reference: str = ""
    device: Literal["cpu", "cuda"] = "cpu"
    max_size_px: int = 0
    overwrite: Flag = False
    faces: Annotated[int | Literal["all"] | None, tyro.conf.arg(metavar="N")] = None
    watertight: Flag = False
    stl: Flag = False
    obj: Flag = False
    usdz: Flag = False
    texture: TextureFormat = "png"
    asset_cameras: Flag = False
    no_report: Flag = False
    fresh: Flag = False
    cache: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    max_kept: str = MAX_KEPT
    view: Flag = False

    def __post_init__(self) -> None:
        bytes_of(self.max_kept, "max_kept")
        _ = self.files  # refused before anything is read
        # The smallest photographs in which depth is searched.
        sound = self.max_size_px == 0 or self.max_size_px >= 32
        require(sound, "max_size_px", self.max_size_px, "0, or 32 pixels at least")

    @property
    def files(self) -> MeshFiles:
        """Form in which the surface is written."""
        wanted: dict[MeshFormat, bool] = {"stl": self.stl, "obj": self.obj, "usdz": self.usdz}
        return MeshFiles(
            faces=self.faces,
            watertight=self.watertight,
            formats=tuple(name for name, written in wanted.items() if written),
            texture=self.texture,
            cameras=self.asset_cameras,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class InputOptions:
    """Inputs beside the photographs.

    Attributes:
        masks: Folder with a mask for each photograph, of the same name; zero off the object.
        mask_object: How masks show the object; auto looks at all of them together.
        sparse: Known cameras: a COLMAP model's folder, transforms.json, cameras.xml, .sfm or .npz.
        mesh: A rough surface in that model's frame (PLY, OBJ, STL, GLB) to start from.
        object: Find silhouettes of the object, take masks for them, or take everything for the
            object, as of walls and scenes. (default: auto)
        region: Box that the object is inside: smallest and largest corner in scene units, such as
            (-1,-1,0,1,1,2).
        scale_bar: Two places in photographs, in pixels, and the length between them; again for
            more.
        camera_distance: Two photographs, and the length between their cameras; again for more.
        markers: Markers printed by `pimper markers` tell the size; their sides in millimetres, if
            others. With --sparse they count only where their sides are given.
        unit: Of lengths that are given, and of the result where its size is known.
        silhouettes: Folder of soft masks of a segmenter, for some photographs or all, any size:
            PNG, JPEG, EXR, NPZ or NPY. What the other views deny is not followed.
        object_at: Pixel of a photograph that shows the object; again for more.
        normals: Folder of normal maps of an estimator, under the photographs' names: PNG, EXR, NPZ
            or NPY.
        axes: Of these normals; auto finds them by cloud and outlines.
        normals_error_deg: Root mean square that they are off, where no file has their variance.
        depth: Folder of depth maps of an estimator; what they hold is found by the cloud.
        depth_error: Root mean square of the range of their values that they are off, where no file
            has their variance.
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
    object_at: Places = ()
    normals: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    axes: NormalAxes = "auto"
    normals_error_deg: float = NORMALS_ERROR_DEG
    depth: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    depth_error: float = DEPTH_ERROR

    def __post_init__(self) -> None:
        sound = isinstance(self.markers, str) or 0 < self.markers < float("inf")
        require(sound, "markers", self.markers, "auto, off, or a length in millimetres above 0")
        require(
            self.masks is None or not (self.silhouettes or self.object_at),
            "--silhouettes or --object-at",
            str(self.silhouettes or (*self.object_at, "")[0]),
            "none beside --masks, which are followed as they are",
        )
        _ = self.bars, self.distances  # refused before anything is read

    @property
    def bars(self) -> tuple[given.ScaleBar, ...]:
        """Places in photographs with the lengths between them."""
        bars = self.scale_bar
        return tuple(
            given.ScaleBar(first=one, second=two, length=length) for one, two, length in bars
        )

    @property
    def distances(self) -> tuple[given.CameraDistance, ...]:
        """Photographs with the lengths between their cameras."""
        pairs = self.camera_distance
        return tuple(
            given.CameraDistance(first=one, second=two, length=length) for one, two, length in pairs
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """The arguments of a run."""

    photos: Path
    out: Path
    common: CommonOptions
    config: Config
    inputs: InputOptions = field(default_factory=InputOptions)


# What few people need: `--help-all` tells of it.
_RARE = (
    *("--scales", "--max-kept", "--camera-distance", "--markers", "--unit"),
    *("--no-report", "--normals", "--axes", "--normals-error-deg", "--depth", "--depth-error"),
    *("--silhouettes", "--object-at", "--usdz", "--texture", "--asset-cameras"),
)

# The skull's cranium and face both show in this photograph.
SKULL = CommonOptions(reference="37")


def parse(command: str, arguments: Sequence[str]) -> Job:
    """Read the arguments of a command.

    The preset is read first: its settings are the defaults that other options change, and
    that ``--help-all`` shows.
    """
    name = _preset(arguments)
    _refuse_others(command, arguments, name)
    verb = _command(command, load_config(name))
    job = read_arguments(verb, command, arguments, levels=True, rare=_RARE)
    silhouettes = job.config.silhouettes
    if job.inputs.object:
        silhouettes = dataclasses.replace(silhouettes, object=job.inputs.object)
    if job.inputs.region:
        silhouettes = dataclasses.replace(silhouettes, region=tuple(map(float, job.inputs.region)))
    config = dataclasses.replace(job.config, silhouettes=silhouettes)
    if named := job.common.reference:
        surface = dataclasses.replace(config.coarse_surface, reference=named)
        config = dataclasses.replace(config, coarse_surface=surface)
        if isinstance(config, PublishedConfig):
            triangulate = dataclasses.replace(config.triangulate, reference=named)
            config = dataclasses.replace(config, triangulate=triangulate)
    return dataclasses.replace(job, config=config)


def _command(name: str, preset: Config) -> Callable[..., Job]:
    """Make the command whose parameters are the options that a preset leaves open."""
    settings: Any = type(preset)  # each chain has its own

    def reconstruct(
        photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")],
        out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="OUT")],
        inputs: Annotated[InputOptions, tyro.conf.arg(name="")] = InputOptions(),
        common: Annotated[CommonOptions, tyro.conf.arg(name="")] = CommonOptions(),
        config: Annotated[settings, tyro.conf.arg(name="")] = preset,
    ) -> Job:
        """Reconstruct the surface that a folder of photographs shows.

        Args:
            photos: Folder of JPEG, PNG or TIFF files.
            out: Folder for the result; new or empty.
            inputs: What the photographs come with.
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
    """List the options of a command, of each preset."""
    return [one for name in presets() for one in options_of(_command(command, load_config(name)))]


def _refuse_others(command: str, arguments: Sequence[str], preset: str) -> None:
    def options(name: str) -> set[str]:
        every = options_of(_command(command, load_config(name)))
        return {name for option in every for name in option.names}

    written = {argument.partition("=")[0].replace("_", "-") for argument in arguments}
    named = {argument for argument in written if argument.startswith("--")}
    for option in sorted(named - options(preset)):
        if having := [name for name in presets() if option in options(name)]:
            raise ConfigError(
                f"{option} is no option of the preset {preset}, but of {', '.join(having)}. Leave "
                f"it out, or choose `--preset {having[0]}`."
            )


def run(job: Job, output: Output) -> None:
    """Carry out ``reconstruct`` or ``demo``."""
    from pimper_torch.cli.run import carry_out

    carry_out(job, output)


def checked(command: str, arguments: Sequence[str]) -> Job:
    """Read the arguments, and check what can be checked without reading photographs."""
    return check(parse(command, arguments))


def check(job: Job) -> Job:
    """Check of a run what can be checked without reading photographs, and return it."""
    if job.common.view:
        require_viser()
    require_apart(job.out, inputs_of(job))
    prepare_output(job.out, "result", job.common.overwrite)
    for folder in (job.photos, job.inputs.masks):
        if folder is not None:
            for path in list_images(folder):
                require_name(path, InputError)
    present = [image_name(path, job.photos) for path in list_images(job.photos)]
    least = job.config.factorize.min_views
    if len(present) < least:
        raise InputError(
            f"{job.photos}: the number of photographs is {len(present)}; needed: {least} at least, "
            f"better 10 or more: a normal comes from {least} lights or more "
            "(`factorize.min_views`)."
        )
    references = [job.config.coarse_surface.reference]
    if isinstance(job.config, PublishedConfig):
        references.append(job.config.triangulate.reference)
    for name in filter(None, references):
        view_named(name, present)
    pointed = [pointer.name for mark in job.inputs.object_at for pointer in mark.pointers]
    for name in (*given.measured_in(job.inputs.bars, job.inputs.distances), *pointed):
        given.number_of(name, present)
    return job


def inputs_of(job: Job) -> dict[str, Path | None]:
    """Return what a run reads, by what it is called."""
    return {
        "PHOTOS": job.photos,
        "--masks": job.inputs.masks,
        "--sparse": job.inputs.sparse,
        "--mesh": job.inputs.mesh,
        "--silhouettes": job.inputs.silhouettes,
        "--normals": job.inputs.normals,
        "--depth": job.inputs.depth,
        "--cache": job.common.cache,
    }


def bundled_photographs() -> Path:
    """Return the folder of the skull's photographs; their licence lies beside them."""
    return Path(str(resources.files("pimper_torch"))) / "data" / "skull"


def _preset(arguments: Sequence[str]) -> str:
    for index, argument in enumerate(arguments):
        name, equals, value = argument.partition("=")
        if name == "--preset":
            return value if equals else "".join(arguments[index + 1 : index + 2]) or "default"
    return CommonOptions().preset
