"""Results in a browser or a notebook, from Python."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from pimper_torch.camera_files.layout import DataSetPath
from pimper_torch.chains.chain import Step
from pimper_torch.errors import InputError, caution
from pimper_torch.exchange.result import Result, read_result
from pimper_torch.geometry.local_frame import NO_OFFSET
from pimper_torch.io.estimates import read_estimate
from pimper_torch.outputs.marker import STAGES
from pimper_torch.records import CoarseMesh, Mesh, Reconstruction, Silhouettes, SparseScene, Surface
from pimper_torch.relighting.fit_lights import fit_lights
from pimper_torch.sfm.colmap import read_model
from pimper_torch.store import Store
from pimper_torch.viewer.server import HOST, PORT, open_server
from pimper_torch.viewer.viewer import Viewer

_KEPT: Mapping[str, type[CoarseMesh] | type[Surface]] = {
    "coarse_surface": CoarseMesh,
    "fuse": Surface,
}


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
        result = read_result(path, photographs)
    except InputError as error:
        _add_without_photographs(viewer, path, error)
    else:
        add_result(viewer, result, tuple(passes_kept(path, result.summary)))


def add_result(viewer: Viewer, result: Result, passes: tuple[tuple[str, Mesh], ...] = ()) -> None:
    """Show a result that was read, and surfaces before it."""
    scene, names = result.scene, result.scene.views.names
    scale = result.summary.get("scale")
    if isinstance(scale, Mapping):
        viewer.unit = str(scale["unit"])
    add_lights(viewer, result.mesh, scene, result.silhouettes)
    viewer.add_cameras(
        names, scene.cameras, scene.points_world, names.index(result.reference), scene.views
    )
    for name, mesh in (*passes, (RESULT, result.mesh)):
        viewer.add_pass(name, mesh)


def _add_without_photographs(viewer: Viewer, path: Path, error: InputError) -> None:
    """Show what there is beside photographs."""
    estimate = read_estimate(path)
    if path.is_dir():
        caution(f"{error} The viewer shows no photographs.", stacklevel=4)
    names, reference = estimate.names, estimate.reference
    if estimate.cameras is not None and names:
        file = path / "summary.json"
        summary = DataSetPath(file, "figures of a result").read_json() if file.is_file() else {}
        place = names.index(reference) if reference in names else 0
        points = read_model(path / "sparse").points_world
        if estimate.lights_world is not None:
            directed = estimate.lights_world[:, 1:]
            ambient = estimate.lights_world[:, 0].clamp_min(0)
            viewer.set_lights(names, directed, ambient / (ambient + directed.norm(dim=1)))
        viewer.add_cameras(names, estimate.cameras, points, place)
        for name, mesh in passes_kept(path, summary):
            vertices = mesh.vertices_world.double()
            offset = vertices.new_tensor(summary.get("offset_world") or NO_OFFSET)
            viewer.add_pass(name, mesh.replace(vertices_world=vertices + offset))
    viewer.add_pass(RESULT, estimate.mesh)


def passes_kept(folder: Path, summary: Mapping[str, Any]) -> Iterator[tuple[str, Mesh]]:
    """Read the surfaces before the result, coarse first, from what its run kept to go on from.

    A record is the result's where the report of the stage that found it is in the summary. The
    surface of the last pass is the result itself.

    Yields:
        What each is called, and the surface in the frame of the result's scene.
    """
    scale = summary.get("scale") or {}
    factor = float(scale.get("factor", 1.0))
    stages = [one for one in summary.get("stages") or () if isinstance(one, Mapping)]
    kept = Store(folder=folder / STAGES)
    found: dict[int, Mesh] = {}
    for key in kept.sizes():
        cls = _KEPT.get(key.rpartition("-")[0])
        read = None if cls is None else kept.find(key, cls)
        if read is None:
            continue
        record, about = read
        mesh = record.mesh
        for place in _places(stages, about.get("events", ())):
            error = mesh.expected_error
            found[place] = mesh.replace(
                vertices_world=factor * mesh.vertices_world,
                expected_error=None if error is None else factor * error,
            )
    fused = [place for place, one in enumerate(stages) if one.get("name") == "fuse"]
    for place in sorted(found):
        if place not in fused[-1:]:
            name = f"pass {fused.index(place) + 1}" if place in fused else COARSE
            yield name, found[place]


def _places(stages: list[Mapping[str, Any]], events: Sequence[Any]) -> list[int]:
    """Return where in a summary the reports of a record stand."""
    reports = [one for one in events if isinstance(one, Mapping) and one["kind"] == "StageReport"]
    told = {(one["name"], one["seconds"], one["peak_memory_mb"]) for one in reports}
    return [
        place
        for place, one in enumerate(stages)
        if (one.get("name"), one.get("seconds"), one.get("peak_memory_mb")) in told
    ]


COARSE, RESULT = "coarse surface", "result"


def add_found(viewer: Viewer, found: SparseScene | Step, reference: int = 0) -> None:
    """Show cameras, photographs and points, or the surface of a pass, as soon as it is there."""
    if isinstance(found, Step):
        viewer.add_pass(f"pass at {found.scale:g} of the photographs", found.surface.mesh)
    else:
        names = found.views.names
        viewer.add_cameras(names, found.cameras, found.points_world, reference, found.views)


def add_outcome(viewer: Viewer, result: Reconstruction) -> None:
    """Show the surface of a run, and know the lights of its photographs."""
    viewer.add_pass(RESULT, result.mesh)
    add_lights(viewer, result.mesh, result.scene, result.silhouettes)


def add_lights(viewer: Viewer, mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes) -> None:
    """Fit the light of every photograph, as the report does, for the viewer to set."""
    with torch.no_grad():
        lights = fit_lights(mesh.to("cpu"), scene.to("cpu"), silhouettes.to("cpu"))
    ambient, directed = lights.ambient.mean(dim=1), lights.directed.mean(dim=1)
    share = ambient / (ambient + directed).clamp_min(torch.finfo(ambient.dtype).tiny)
    viewer.set_lights(scene.views.names, lights.direction_world, share)


def show(
    result: Reconstruction | Result | Mesh | Path | str, *, host: str = HOST, port: int = PORT
) -> Viewer:
    """Open a surface, with cameras, photographs and points where it has some, in the viewer.

    Needs viser, the extra ``view``. As the last line of a notebook's cell it shows the page there;
    elsewhere :attr:`~pimper_torch.viewer.viewer.Viewer.address` opens in a browser. The page lives
    as long as the process: scripts end with :meth:`~pimper_torch.viewer.viewer.Viewer.wait`.

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
