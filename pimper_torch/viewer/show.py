"""Results in a browser or a notebook, from Python."""

from pathlib import Path

from pimper_torch.exchange.result import Result
from pimper_torch.records import Mesh, Reconstruction
from pimper_torch.viewer.live_results import COARSE, add_found, add_outcome
from pimper_torch.viewer.result_folder import add_folder, add_result
from pimper_torch.viewer.server import HOST, PORT, open_server
from pimper_torch.viewer.viewer import Viewer


def show(
    result: Reconstruction | Result | Mesh | Path | str, *, host: str = HOST, port: int = PORT
) -> Viewer:
    """Open a surface, with cameras, photographs and points where it has some, in the viewer.

    Needs viser, the extra ``view``. As the last line of a notebook's cell it shows the page there;
    elsewhere :attr:`Viewer.address` opens in a browser. The page lives as long as the process:
    scripts end with :meth:`Viewer.wait`.

    Args:
        result: What a chain or :func:`~pimper_torch.exchange.result.read_result` returned, a mesh,
            or the path of a folder of results or of a mesh.
        host: Address of this machine that the page is served at.
        port: The next free one is taken where another program has it; 0 takes any.

    Returns:
        With the server itself as ``server``.

    Raises:
        PimperError: viser is missing, no such host or port, or the folder holds no surface.
    """
    viewer = Viewer(open_server(host, port))
    try:
        if isinstance(result, Reconstruction):
            add_found(viewer, result.scene, result.coarse.reference)
            viewer.add_pass(COARSE, result.coarse.mesh)
            add_outcome(viewer, result)
        elif isinstance(result, Result):
            add_result(viewer, result)
        elif isinstance(result, Mesh):
            viewer.add_pass("surface", result)
        else:
            add_folder(viewer, result)
    except BaseException:
        viewer.stop()
        raise
    return viewer
