"""Results in a browser or a notebook, from Python."""

from pathlib import Path

from pimper_torch.doors.camera_files.layout import DataSetPath
from pimper_torch.doors.export.result import Result, read_result
from pimper_torch.doors.io.estimates import read_estimate
from pimper_torch.method.chains.chain import Step
from pimper_torch.method.sfm.model_files import read_model
from pimper_torch.records import Mesh, Reconstruction, SparseScene
from pimper_torch.result.viewer.server import HOST, PORT
from pimper_torch.result.viewer.viewer import Viewer
from pimper_torch.runtime.errors import InputError, caution

COARSE, RESULT = "coarse surface", "result"


def add_folder(viewer: Viewer, path: Path | str, photographs: Path | str | None = None) -> None:
    """Show a folder that ``pimper reconstruct`` wrote, or a mesh file alone.

    Where its photographs are gone, a warning says so, and the rest is shown.

    Args:
        photographs: Their folder; by default the one that the result names.

    Raises:
        InputError: There is no surface, or it cannot be read.
    """
    path = Path(path)
    try:
        if (summary := path / "summary.json").is_file():
            scale = DataSetPath(summary, "result").read_json().get("scale")
            viewer.unit = str(scale["unit"]) if isinstance(scale, dict) else None
        result = read_result(path, photographs)
    except InputError as error:
        estimate = read_estimate(path)
        if path.is_dir():
            caution(f"{error} The viewer shows no photographs.", stacklevel=2)
        names, reference = estimate.names, estimate.reference
        if estimate.cameras is not None and names:
            place = names.index(reference) if reference in names else 0
            points = read_model(path / "sparse").points_world
            viewer.add_cameras(names, estimate.cameras, points, place)
        viewer.add_pass(RESULT, estimate.mesh)
    else:
        add_found(viewer, result)


def add_found(
    viewer: Viewer, found: SparseScene | Step | Mesh | Result | Reconstruction, reference: int = 0
) -> None:
    """Show cameras, photographs and points, a surface, or a whole result."""
    if isinstance(found, SparseScene):
        names = found.views.names
        viewer.add_cameras(names, found.cameras, found.points_world, reference, found.views)
    elif isinstance(found, Step):
        viewer.add_pass(f"pass at {found.scale:g} of the photographs", found.surface.mesh)
    elif isinstance(found, Mesh):
        viewer.add_pass("surface", found)
    else:
        if isinstance(found, Reconstruction):
            add_found(viewer, found.scene, found.coarse.reference)
            viewer.add_pass(COARSE, found.coarse.mesh)
        else:
            add_found(viewer, found.scene, found.scene.views.names.index(found.reference))
        viewer.add_pass(RESULT, found.mesh)


def show(
    result: Reconstruction | Result | Mesh | Path | str, *, host: str = HOST, port: int = PORT
) -> Viewer:
    """Open a surface, with cameras, photographs and points where it has some, in the viewer.

    As the last line of a notebook's cell it shows the page there; elsewhere
    :attr:`~pimper_torch.result.viewer.viewer.Viewer.address` opens in a browser. The page lives as
    long as the process: scripts end with :meth:`~pimper_torch.result.viewer.viewer.Viewer.wait`.

    Args:
        result: What a chain or :func:`~pimper_torch.doors.export.result.read_result` returned, a
            mesh, or the path of a folder of results or of a mesh.
        host: Address of this machine that the page is served at.
        port: The next free one is taken where another program has it; 0 takes any.

    Raises:
        PimperError: viser, the extra ``view``, is missing, there is no such host or port, or the
            folder holds no surface.
    """
    viewer = Viewer(host, port)
    try:
        if isinstance(result, Path | str):
            add_folder(viewer, result)
        else:
            add_found(viewer, result)
    except BaseException:
        viewer.stop()
        raise
    return viewer
