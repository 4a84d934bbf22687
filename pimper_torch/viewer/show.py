"""Display of results in a browser or a notebook, from Python."""

from pathlib import Path

from pimper_torch.chains.chain import Step
from pimper_torch.export.result import Result, read_reference, read_result
from pimper_torch.geometry.lens_models import pinholes_of
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import Mesh, Reconstruction, SparseScene
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.torch_settings import isolated
from pimper_torch.viewer.server import HOST, PORT
from pimper_torch.viewer.viewer import Viewer

COARSE, RESULT = "coarse surface", "result"


def add_folder(viewer: Viewer, path: Path | str, photographs: Path | str | None = None) -> None:
    """Add a folder that ``pimper reconstruct`` wrote, or a mesh file.

    If its photographs are missing, a warning is given, and the rest is displayed.

    Args:
        photographs: Their folder; by default the one named in the result.

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
        mesh = read_mesh(path / "mesh.ply" if path.is_dir() else path)
        if path.is_dir():
            caution(f"{error} The viewer shows no photographs.", stacklevel=2)
        if (path / "sparse").is_dir():
            model, reference = read_model(path / "sparse"), read_reference(path / "depth.npz")
            index = model.names.index(reference) if reference in model.names else 0
            viewer.add_cameras(model.names, pinholes_of(model), model.points_world, index)
        viewer.add_pass(RESULT, mesh)
    else:
        add_found(viewer, result)


def add_found(
    viewer: Viewer, result: SparseScene | Step | Mesh | Result | Reconstruction, reference: int = 0
) -> None:
    """Add cameras, photographs and points, a surface, or a complete result."""
    if isinstance(result, SparseScene):
        names = result.views.names
        viewer.add_cameras(names, result.cameras, result.points_world, reference, result.views)
    elif isinstance(result, Step):
        viewer.add_pass(f"pass at {result.scale:g} of the photographs", result.surface.mesh)
    elif isinstance(result, Mesh):
        viewer.add_pass("surface", result)
    else:
        if isinstance(result, Reconstruction):
            add_found(viewer, result.scene, result.coarse.reference)
            viewer.add_pass(COARSE, result.coarse.mesh)
        else:
            add_found(viewer, result.scene, result.scene.views.names.index(result.reference))
        viewer.add_pass(RESULT, result.mesh)


@isolated
def show(
    result: Reconstruction | Result | Mesh | Path | str, *, host: str = HOST, port: int = PORT
) -> Viewer:
    """Open a surface in the viewer, with its cameras, photographs and points if it has some.

    As the last expression of a notebook cell, it displays the page there; elsewhere, open
    :attr:`~pimper_torch.viewer.viewer.Viewer.address` in a browser. The page works while the
    process runs: scripts end with :meth:`~pimper_torch.viewer.viewer.Viewer.wait`.

    Args:
        result: The result of a chain or of :func:`~pimper_torch.export.result.read_result`,
            a mesh, or the path of a result folder or of a mesh.
        host: Address of this machine at which the page is served.
        port: The next free one is used if it is in use; 0 selects any.

    Raises:
        PimperError: viser, the extra ``view``, is missing, ``host`` or ``port`` is invalid, or the
            folder contains no surface.
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
