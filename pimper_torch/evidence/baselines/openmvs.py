"""OpenMVS, if the user has it: depth maps, Delaunay and graph cut, refinement."""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch

from pimper_torch.cores import usable_cores
from pimper_torch.errors import InputError, MissingProgramError, ReconstructionError
from pimper_torch.exchange.colmap_workspace import write_pinholes
from pimper_torch.exchange.pictures import write_picture
from pimper_torch.geometry.local_frame import NO_OFFSET
from pimper_torch.io.meshes import read_mesh
from pimper_torch.progress import report
from pimper_torch.records import CoarseMesh, Estimate, Mesh, SparseScene
from pimper_torch.stage import Stage

_LAST_LINES = 15


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """An executable that a user may have.

    Attributes:
        name: As it is called on the command line.
        variable: Environment variable that may name it, or the folder it lies in.
        folders: Folders that its installer uses and that are seldom on the PATH.
    """

    name: str
    variable: str
    source: str
    folders: tuple[Path, ...] = ()

    def find(self) -> Path:
        """Find the executable: as the variable says, on the PATH, in its folders."""
        if self.variable in os.environ:
            named = Path(os.environ[self.variable])
            found = _executable(named / self.name if named.is_dir() else named)
            if found is None:
                raise MissingProgramError(
                    f"{self.name} is not installed at {named}, where {self.variable} says; "
                    f"needed: the executable, or the folder it lies in. {self._advice}"
                )
            return found
        on_path = shutil.which(self.name)
        if on_path is not None:
            return Path(on_path).absolute()
        for folder in self.folders:
            found = _executable(folder / self.name)
            if found is not None:
                return found
        raise MissingProgramError(
            f"{self.name} is not installed: it is neither on the PATH nor named by "
            f"{self.variable}. {self._advice}"
        )

    @property
    def _advice(self) -> str:
        return (
            f"Get it from {self.source}, or point {self.variable} to it, or leave this method out."
        )


def _executable(path: Path) -> Path | None:
    # Absolute, for it will run in another folder.
    return path.absolute() if path.is_file() and os.access(path, os.X_OK) else None


@dataclass(frozen=True, slots=True)
class Deadline:
    """A limit of time that several programs share."""

    minutes: float
    began: float = field(default_factory=time.monotonic)

    @property
    def seconds_left(self) -> float:
        """Time until then; negative after it."""
        return 60 * self.minutes - (time.monotonic() - self.began)


def run_program(
    command: Sequence[Path | str], folder: Path, deadline: Deadline, *, threads: int
) -> str:
    """Run a program in a folder, without a shell, and wait for it.

    It and all that it started are stopped at the deadline or when we are interrupted.

    Args:
        folder: Working directory. What the program prints is kept there too.

    Returns:
        What it printed.
    """
    name = Path(command[0]).name
    began = time.monotonic()
    with tempfile.NamedTemporaryFile(
        prefix=f"{name}-", suffix=".log", dir=folder, delete=False
    ) as log:
        try:
            process = subprocess.Popen(
                [str(part) for part in command],
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # COLMAP's Qt asks for a screen otherwise, which a server has not.
                env=os.environ | {"OMP_NUM_THREADS": str(threads), "QT_QPA_PLATFORM": "offscreen"},
                start_new_session=True,
            )
        except OSError as error:
            raise MissingProgramError(
                f"{command[0]} cannot be started ({error.strerror}); needed: an executable for "
                "this machine."
            ) from error
        try:
            status = process.wait(timeout=max(0.0, deadline.seconds_left))
        except subprocess.TimeoutExpired as error:
            _stop(process)
            raise ReconstructionError(
                f"{name} was stopped: {deadline.minutes:g} minutes are over. Raise `max_minutes`, "
                f"or work on smaller photographs.{last_lines(_text(Path(log.name)))}"
            ) from error
        except BaseException:
            _stop(process)
            raise
    printed = _text(Path(log.name))
    if status != 0:
        raise ReconstructionError(
            f"{name} failed after {time.monotonic() - began:.0f} s ({_ending(status)})."
            f"{last_lines(printed)}"
        )
    return printed


def last_lines(printed: str) -> str:
    """Quote the end of what a program printed, ready to follow a message."""
    lines = [line.rstrip() for line in printed.splitlines() if line.strip()][-_LAST_LINES:]
    if not lines:
        return " It printed nothing."
    return "".join(["\nIts last lines:", *(f"\n  {line}" for line in lines)])


def _stop(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")


def _ending(status: int) -> str:
    if status >= 0:
        return f"exit status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = f"signal {-status}"
    often = "; often because memory ran out" if name == "SIGKILL" else ""
    return f"ended by {name}{often}"


def write_photographs(scene: SparseScene, folder: Path) -> tuple[str, ...]:
    """Write the undistorted photographs as 8-bit sRGB colour, saturated at 1.

    Returns:
        The files' names, ``00000000.png`` and so on, in the order of the views.
    """
    names = tuple(f"{index:08d}.png" for index in range(scene.views.num_views))
    colour = scene.views.replace(images=scene.views.images.expand(-1, 3, -1, -1))
    for index, name in enumerate(names):
        write_picture(colour, index, folder / name)
    return names


def write_pinhole_model(scene: SparseScene, names: tuple[str, ...], folder: Path) -> None:
    """Write pinholes, cloud and tracks as a COLMAP model, binary, in the scene's own frame.

    Raises:
        InputError: No view sees a point; stereo programs choose partners and depths by them.
    """
    if not len(scene.observation_point):
        raise InputError(
            "the scene has no sparse points that a view sees; needed: some, for a stereo program "
            "chooses its pairs of views and its range of depth by them."
        )
    here = scene.replace(offset_world=NO_OFFSET).detach().to("cpu")
    write_pinholes(here, here.cameras, names, folder)


def read_surface(path: Path, program: str, printed: str) -> Mesh:
    """Read the mesh or the points that a program wrote.

    Its colours are dropped: they are radiance under this light, no albedo.
    """
    if not path.is_file():
        raise ReconstructionError(
            f"{program} ended without complaint, but left no {path.name}.{last_lines(printed)}"
        )
    try:
        return read_mesh(path).replace(albedo=None, confidence=None)
    except InputError as error:
        raise ReconstructionError(
            f"{program} found no surface: {error}{last_lines(printed)}"
        ) from error


def estimate_of(mesh: Mesh, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
    """Return the estimate of a surface in the scene's frame, with the scene's cameras."""
    like = scene.points_world
    return Estimate(
        mesh=mesh.replace(
            vertices_world=mesh.vertices_world.to(like),
            faces=mesh.faces.to(like.device),
            normals_world=None if mesh.normals_world is None else mesh.normals_world.to(like),
        ),
        names=scene.views.names,
        cameras=scene.cameras,
        reference=scene.views.names[coarse.reference],
    )


def _program(name: str) -> Program:
    return Program(
        name=name,
        variable="PIMPER_OPENMVS",
        source="https://github.com/cdcseacave/openMVS",
        folders=(Path("/usr/local/bin/OpenMVS"), Path("/usr/bin/OpenMVS")),
    )


INTERFACE = _program("InterfaceCOLMAP")
DENSIFY = _program("DensifyPointCloud")
RECONSTRUCT = _program("ReconstructMesh")
REFINE = _program("RefineMesh")

# Names that the programs give their results when they are left the choice; the same in all
# versions, which those after ``-o`` are not.
_SCENE, _DENSE, _MESH = "scene.mvs", "scene_dense.mvs", "scene_dense_mesh.ply"
_REFINED = ("scene_dense_refine.ply", "scene_dense_mesh_refine.ply")
# For all the programs together; then they are stopped.
_MAX_MINUTES = 120.0


class OpenMvs(Stage):
    """Depth maps by patch match, a mesh that explains their visibility, refined.

    All under the programs' own defaults.
    """

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Run OpenMVS on the scene's photographs, cameras and cloud.

        Masks are not handed over: not every version takes them.

        Args:
            scene: Its cloud chooses pairs of views.

        Returns:
            A mesh in the scene's frame.
        """
        found = {program: program.find() for program in (INTERFACE, DENSIFY, RECONSTRUCT, REFINE)}
        with tempfile.TemporaryDirectory(prefix="pimper-openmvs-") as temporary:
            folder = Path(temporary).resolve()
            names = write_photographs(scene, folder / "images")
            write_pinhole_model(scene, names, folder / "sparse")
            mesh = _Run(found, folder).surface()
        return estimate_of(mesh, scene, coarse)


class _Run:
    """The chain of programs in one folder."""

    def __init__(self, found: dict[Program, Path], folder: Path) -> None:
        self._found, self._folder = found, folder
        self._deadline = Deadline(_MAX_MINUTES)
        self._threads = usable_cores()
        self._done = 0

    def surface(self) -> Mesh:
        """Run them all and read the last one's mesh."""
        self._call(INTERFACE, "-i", str(self._folder), leaves=(_SCENE,))
        self._call(DENSIFY, "-i", _SCENE, leaves=(_DENSE,))
        # Since version 2.3 the dense points are not in the scene's file, and must be named;
        # before, the option did not exist.
        points = ("-p", "scene_dense.ply") if self._names_points() else ()
        path, printed = self._call(RECONSTRUCT, "-i", _DENSE, *points, leaves=(_MESH,))
        last = RECONSTRUCT
        if path.is_file():
            path, printed = self._call(REFINE, "-i", _DENSE, "--mesh-file", _MESH, leaves=_REFINED)
            last = REFINE
        return read_surface(path, last.name, printed)

    def _call(self, program: Program, *arguments: str, leaves: tuple[str, ...]) -> tuple[Path, str]:
        """Run one program; give the file that it writes and what it printed."""
        command: list[Path | str] = [self._found[program], *arguments]
        command += ["-w", str(self._folder), "--max-threads", str(self._threads)]
        printed = run_program(command, self._folder, self._deadline, threads=self._threads)
        self._done += 1
        report(self._done, len(self._found))
        there = [self._folder / name for name in leaves if (self._folder / name).is_file()]
        # read_surface says, with the log, that a mesh is not there.
        path = there[0] if there else self._folder / leaves[0]
        if not there and path.suffix == ".mvs":
            read_surface(path, program.name, printed)
        return path, printed

    def _names_points(self) -> bool:
        """Return whether the dense points are passed to the program beside the scene."""
        try:
            help_text = run_program(
                [self._found[RECONSTRUCT], "--help"], self._folder, self._deadline, threads=1
            )
        except ReconstructionError as error:  # some versions fail after showing their help
            help_text = str(error)
        return "--pointcloud-file" in help_text
