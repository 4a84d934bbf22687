"""A scene as files that multi-view stereo programs read, and their surface as an estimate.

Photographs go by their number in the files: programs stumble over spaces and folders in
names. What SfM undistorted is written, with its pinholes, so that no program has lenses to
model: all see the very photographs and cameras that our own stages see.
"""

from pathlib import Path

from pimper_torch.errors import InputError, ReconstructionError
from pimper_torch.evidence.baselines.external import last_lines
from pimper_torch.exchange.colmap_workspace import write_pinholes
from pimper_torch.exchange.pictures import write_picture
from pimper_torch.geometry.local_frame import NO_OFFSET
from pimper_torch.io.meshes import read_mesh
from pimper_torch.records import CoarseMesh, Estimate, Mesh, SparseScene


def write_photographs(scene: SparseScene, folder: Path) -> tuple[str, ...]:
    """Write the undistorted photographs as 8-bit sRGB colour, saturated at 1.

    Args:
        scene: Any; padding is cut off.

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

    Args:
        folder: Gets ``cameras.bin``, ``images.bin`` and ``points3D.bin``.

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
