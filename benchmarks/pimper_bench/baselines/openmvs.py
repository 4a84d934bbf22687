"""OpenMVS, if installed: depth maps, Delaunay and graph cut, refinement."""

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from pimper_bench.baselines.missing import MissingProgramError
from pimper_bench.metrics.estimates import Estimate
from pimper_torch.export.colmap_workspace import write_pinholes
from pimper_torch.export.picture_files import write_picture
from pimper_torch.geometry.local_frame import NO_OFFSET
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import CoarseMesh, Mesh, SparseScene
from pimper_torch.runtime.cores import usable_cores
from pimper_torch.runtime.errors import InputError, ReconstructionError
from pimper_torch.runtime.progress import report
from pimper_torch.stages.stage import Stage

# Folders of OpenMVS's installer.
_FOLDERS = ("/usr/local/bin/OpenMVS", "/usr/bin/OpenMVS")
_ADVICE = (
    "Install it from https://github.com/cdcseacave/openMVS and put its folder on the PATH, or omit "
    "this method."
)
PROGRAMS = ("InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh")

# Default names of the programs' results: the same in all versions, unlike those after ``-o``.
_SCENE, _DENSE, _MESH = "scene.mvs", "scene_dense.mvs", "scene_dense_mesh.ply"
_REFINED = ("scene_dense_refine.ply", "scene_dense_mesh_refine.ply")
# Time limit of all programs together.
_MAX_MINUTES = 120.0


class OpenMvs(Stage):
    """Depth maps by patch match, a mesh that is consistent with their visibility, refined.

    Needs version 2.3 or later, in which the dense points have to be named. All programs use their
    defaults. Masks are not used, because not every version supports them.
    """

    @torch.no_grad()
    def forward(self, scene: SparseScene, coarse: CoarseMesh) -> Estimate:
        """Run OpenMVS on the scene's photographs, cameras and cloud, which selects pairs of views.

        Raises:
            InputError: No view sees a point.
            MissingProgramError: A program is not installed.
            ReconstructionError: A program failed.
        """
        programs = {name: find_program(name) for name in PROGRAMS}
        with tempfile.TemporaryDirectory(prefix="pimper-openmvs-") as temporary:
            folder = Path(temporary).resolve()
            _write_scene(scene, folder)
            mesh = _run_all(programs, folder)
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


def find_program(name: str) -> Path:
    """Return the path of an executable: on the PATH, or in the usual folders."""
    path = shutil.which(name) or shutil.which(name, path=os.pathsep.join(_FOLDERS))
    if path is None:
        raise MissingProgramError(f"{name} is not installed: it is not on the PATH. {_ADVICE}")
    return Path(path).absolute()  # because it runs in another folder


def _write_scene(scene: SparseScene, folder: Path) -> None:
    """Write undistorted photographs and a COLMAP model of pinholes, in the scene's local frame.

    Photographs are named by their numbers: programs fail on spaces and folders in names.
    """
    if not len(scene.observation_point):
        raise InputError(
            "the scene has no sparse points observed by a view; needed: at least one, because "
            "OpenMVS selects pairs of views and depth ranges by them."
        )
    names = tuple(f"{index:08d}.png" for index in range(scene.views.num_views))
    colour = scene.views.replace(images=scene.views.images.expand(-1, 3, -1, -1))
    for index, name in enumerate(names):
        write_picture(colour, index, folder / "images" / name)
    local = scene.replace(offset_world=NO_OFFSET).detach().to("cpu")
    write_pinholes(local, local.cameras, names, folder / "sparse")


def _run_all(programs: dict[str, Path], folder: Path) -> Mesh:
    """Run the programs in turn, and read the last one's mesh."""
    deadline, threads = time.monotonic() + 60 * _MAX_MINUTES, usable_cores()

    def call(name: str, *arguments: str, outputs: tuple[str, ...]) -> tuple[Path, str]:
        """Run a program; return the path of the file that it writes, and its output."""
        options = ["-w", str(folder), "--max-threads", str(threads)]
        printed = run_program([programs[name], *arguments, *options], folder, deadline, threads)
        report(PROGRAMS.index(name) + 1, len(PROGRAMS))
        written = [folder / name for name in outputs if (folder / name).is_file()]
        path = written[0] if written else folder / outputs[0]
        if not written:
            raise ReconstructionError(
                f"{name} reported no error, but did not write {path.name}.{_last_lines(printed)}"
            )
        return path, printed

    call("InterfaceCOLMAP", "-i", str(folder), outputs=(_SCENE,))
    call("DensifyPointCloud", "-i", _SCENE, outputs=(_DENSE,))
    call("ReconstructMesh", "-i", _DENSE, "-p", "scene_dense.ply", outputs=(_MESH,))
    path, printed = call("RefineMesh", "-i", _DENSE, "--mesh-file", _MESH, outputs=_REFINED)
    try:
        # Its colours are radiance under the photographs' light, not albedo.
        return read_mesh(path).replace(albedo=None, confidence=None)
    except InputError as error:
        raise ReconstructionError(
            f"RefineMesh gave no surface: {error}{_last_lines(printed)}"
        ) from error


def run_program(command: Sequence[Path | str], folder: Path, deadline: float, threads: int) -> str:
    """Run a program in a folder, without a shell, and return its output, also logged there.

    The program and its children are stopped at the deadline (of ``time.monotonic()``) or on an
    interrupt.
    """
    name = Path(command[0]).name
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
                env=os.environ | {"OMP_NUM_THREADS": str(threads)},
                start_new_session=True,
            )
        except OSError as error:
            raise MissingProgramError(
                f"{command[0]} cannot be started ({error.strerror}); needed: an executable for "
                "this machine."
            ) from error
        try:
            status = process.wait(timeout=max(0.0, deadline - time.monotonic()))
        except BaseException as error:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            raise ReconstructionError(
                f"{name} was stopped: the time limit of {_MAX_MINUTES:g} minutes for all programs "
                f"was exceeded. Use smaller photographs.{_last_lines(_text(log.name))}"
            ) from error
    printed = _text(log.name)
    if status != 0:
        ending = f"exit status {status}" if status > 0 else f"ended by signal {-status}"
        hint = "; often because memory ran out" if status == -signal.SIGKILL else ""
        raise ReconstructionError(f"{name} failed ({ending}{hint}).{_last_lines(printed)}")
    return printed


def _last_lines(printed: str) -> str:
    """Return the end of a program's output, to be appended to a message."""
    lines = [line.rstrip() for line in printed.splitlines() if line.strip()][-15:]
    if not lines:
        return " It printed nothing."
    return "".join(["\nIts last lines:", *(f"\n  {line}" for line in lines)])


def _text(path: str) -> str:
    return Path(path).read_text(encoding="utf-8", errors="replace")
