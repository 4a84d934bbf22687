"""A result's page with its errors relative to ground truth."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.metrics.in_view import angles_deg
from pimper_bench.metrics.similarity import transfer
from pimper_torch.export.result import read_result
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.surfaces import unit_face_normals
from pimper_torch.geometry.visibility import visible_vertices
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.io.assets.write import write_asset
from pimper_torch.records import Mesh
from pimper_torch.runtime.config import read_mapping
from pimper_torch.stages.meshing.finish import Simplify
from pimper_torch.stages.relighting.held_out import Relight
from pimper_torch.stages.texturing.bake import Texture
from pimper_torch.viz.report.openness import openness
from pimper_torch.viz.report.page import write_page
from pimper_torch.viz.report.predictions import predictions, view_images
from pimper_torch.viz.report.vertex_layers import LengthUnit, length_layer

_DISTANCE, _ANGLE = "_DISTANCE_TO_TRUTH", "_NORMAL_ERROR_DEG"
# Titles and units by the asset's attributes.
_LAYERS = {
    _DISTANCE: ("distance to the truth", "units of the truth"),
    _ANGLE: ("error of normals", "degrees"),
}
_ABOUT = "At every vertex, relative to the nearest point of the truth"


def write_compared_page(
    folder: Path, truth: Mesh, truth_from_world: Float[Tensor, "4 4"], path: Path | str
) -> None:
    """Write the page of a result with layers of its errors.

    Args:
        truth: A mesh, or points without faces, which have no normals.

    Raises:
        InputError: The folder is not a result, or its photographs are missing.
    """
    result = read_result(folder)
    few = Simplify()(result.mesh, MeshFiles(faces="all")).few
    scene = result.scene
    relighting = Relight()(few, scene, result.silhouettes)
    asset = Texture()(result.mesh, few, relighting)
    errors = errors_of(asset.mesh.replace(normals_world=asset.normals), truth, truth_from_world)
    layers = [
        length_layer(name.lower(), title, _ABOUT, errors[name], LengthUnit(factor=1, name=unit))
        for name, (title, unit) in _LAYERS.items()
        if name in errors
    ]
    with TemporaryDirectory(prefix="pimper_page_") as scratch:
        glb = Path(scratch) / "asset.glb"
        write_asset(asset, glb, more=errors)
        write_page(
            path,
            title=f"{folder.absolute().name}, compared with the truth",
            mesh=result.mesh,
            asset=glb.read_bytes(),
            openness=openness(asset.mesh),
            seen=visible_vertices(asset.mesh, scene.cameras).any(dim=0),
            scene=scene,
            silhouettes=result.silhouettes,
            reference=scene.views.names.index(result.reference),
            images=view_images(scene, result.silhouettes, predictions(few, scene, relighting)),
            summary=result.summary,
            settings=read_mapping(folder / "config.yaml"),
            lights_world=result.lights_world,
            layers=layers,
        )


def errors_of(
    mesh: Mesh, truth: Mesh, truth_from_world: Float[Tensor, "4 4"]
) -> Mapping[str, Float[Tensor, " vertex"]]:
    """Return the distance of every vertex to the truth, and the angle between normals in degrees.

    Args:
        truth: Its normals are those of its faces; without faces, no angles are returned.
    """
    moved = transfer(mesh, truth_from_world)
    near = NearestSurface(truth).query(moved.vertices_world)
    errors = {_DISTANCE: near.distance.float()}
    if len(truth.faces) and moved.normals_world is not None:
        normals = unit_face_normals(truth.vertices_world.double(), truth.faces)[near.face]
        errors[_ANGLE] = angles_deg(normalize(moved.normals_world, dim=-1), normals).float()
    return errors
