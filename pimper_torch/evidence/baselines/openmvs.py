"""OpenMVS, if the user has it: depth maps, Delaunay and graph cut, refinement."""

import tempfile
from pathlib import Path

import torch

from pimper_torch.cores import usable_cores
from pimper_torch.errors import ReconstructionError
from pimper_torch.evidence.baselines.exchange import (
    estimate_of,
    read_surface,
    write_photographs,
    write_pinhole_model,
)
from pimper_torch.evidence.baselines.external import Deadline, Program, run_program
from pimper_torch.progress import report
from pimper_torch.records import CoarseMesh, Estimate, Mesh, SparseScene
from pimper_torch.stage import Stage


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
