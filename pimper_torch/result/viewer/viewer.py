"""The page: what is in the scene, and the controls beside it."""

import math
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.rigid import invert_rigid, rotate, transform
from pimper_torch.ground.geometry.surfaces import vertex_normals
from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.ground.shapes import Points
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.result.asset.gltf import MATTE, gltf_of
from pimper_torch.result.report.predictions import shrunk
from pimper_torch.result.viewer.frame import frame_of_cameras, frame_of_mesh
from pimper_torch.result.viewer.server import HOST, PORT, open_server
from pimper_torch.result.viz.maps import base_color
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import each

NO_PHOTOGRAPH = "none"
# Of frusta: photographs are a third of a unit wide where cameras are three away, and two dozen of
# them on a ring stand 0.8 apart.
_SCALE = 0.15
_POINT_COLOR = (110, 140, 190)
# Towards a raking light up on the left of the reference camera, and the share of light that comes
# from everywhere.
_TO_LIGHT = (0.54, -0.54, 0.64)
_AMBIENT = 0.15
# Of light that falls straight on: three.js divides by pi what a matte surface reflects.
_BRIGHTNESS = math.pi


class Viewer:
    """A scene in a browser, which grows while it is looked at.

    Attributes:
        server: viser's own, for whatever else is to be shown.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self.server = open_server(host, port)
        self._viewer_from_world: Float[Tensor, "4 4"] | None = None
        self._surfaces: list[str] = []
        self._cameras: dict[str, tuple[Float[Tensor, "4 4"], float]] = {}
        scene, gui = self.server.scene, self.server.gui
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        direct = _BRIGHTNESS * (1 - _AMBIENT)
        scene.add_light_directional("/light", intensity=direct, position=_TO_LIGHT)
        scene.add_light_ambient("/ambient", intensity=_BRIGHTNESS * _AMBIENT)
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._about = gui.add_markdown("No surface yet.")
        self._chosen = gui.add_dropdown("photograph", (NO_PHOTOGRAPH,))
        # Without a client it is `choose` itself that sets it.
        self._chosen.on_update(
            lambda event: self.choose(self._chosen.value) if event.client else None
        )

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def address(self) -> str:
        """Address for a browser."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """Close the server with all its connections; the page stays as it was."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def wait(self) -> None:
        """Go on until Ctrl-C, which raises ``KeyboardInterrupt``."""
        self.server.sleep_forever()

    def _repr_html_(self) -> str:
        """Show the page in a notebook."""
        return f'<iframe src="{self.address}" width="100%" height="600"></iframe>'

    def add_cameras(
        self,
        names: Sequence[str],
        cameras: Cameras,
        points_world: Points,
        reference: int = 0,
        views: Views | None = None,
    ) -> None:
        """Show cameras and the sparse cloud, and photographs in frusta where they are at hand.

        Args:
            names: Of the photographs, in the order of the cameras.
        """
        from viser.transforms import SO3

        scene = self.server.scene
        frame = self._viewer_from_world = frame_of_cameras(cameras, reference)
        points = transform(frame, points_world.detach().cpu().double()).float().numpy()
        scene.add_point_cloud("/points", points, _POINT_COLOR, point_size=0.004)
        scene.add_frame("/cameras", show_axes=False)
        pictures = [None] * len(names) if views is None else small_pictures(views)
        poses = frame @ invert_rigid(cameras.cam_from_world.detach().cpu().double())
        for view, (name, pose) in enumerate(zip(names, poses, strict=True)):
            width, height = cameras.sizes_px[view].tolist()
            fov = 2 * math.atan(height / 2 / float(cameras.intrinsics[view, 1, 1]))
            pose[:3, :3] = normalize(pose[:3, :3], dim=0)
            self._cameras[name] = pose, fov
            frustum = scene.add_camera_frustum(
                f"/cameras/{view:05d}",
                fov,
                width / height,
                scale=_SCALE,
                thickness=1.5,
                thickness_units="screen",
                image=pictures[view],
                wxyz=SO3.from_matrix(pose[:3, :3].numpy()).wxyz,
                position=pose[:3, 3].numpy(),
            )
            frustum.on_click(lambda _, name=name: self.choose(name))
        self._chosen.options = (NO_PHOTOGRAPH, *names)
        _put(self.server.initial_camera, *self._cameras[names[reference]])
        self.choose(names[reference])

    def add_pass(self, name: str, mesh: Mesh) -> None:
        """Show a surface in place of those before, which the page's list of the scene brings back.

        Args:
            mesh: In the world of the cameras.
        """
        if not len(mesh.faces):
            raise InputError(
                f"the {name} has {len(mesh.vertices_world)} vertices and no faces; needed: a "
                "surface, as a viewer of point clouds shows clouds."
            )
        mesh, scene = mesh.detach().to("cpu"), self.server.scene
        if self._viewer_from_world is None:
            self._viewer_from_world = frame_of_mesh(mesh)
        normals = mesh.normals_world
        if normals is None:
            normals = vertex_normals(mesh.vertices_world, mesh.faces)
        attributes = {
            "POSITION": transform(self._viewer_from_world, mesh.vertices_world.double()),
            "NORMAL": normalize(rotate(self._viewer_from_world, normals.double()), dim=1),
            "COLOR_0": base_color(mesh).expand(-1, 3).float(),
        }
        arrays = {key: values.numpy() for key, values in attributes.items()}
        for before in ("/points", *self._surfaces):  # points lie on the surface
            if node := scene.get_handle_by_name(before):
                node.visible = False
        self._surfaces.append(f"/surfaces/{len(self._surfaces)}: {name}")
        scene.add_glb(self._surfaces[-1], gltf_of(arrays, mesh.faces.numpy(), MATTE))
        self._about.content = f"**{name}**, {len(mesh.faces):,} faces."

    def choose(self, name: str) -> None:
        """Stand, on every open page, where a photograph was taken.

        Its own frustum is hidden meanwhile, as it is before the object.

        Args:
            name: Of the photograph; :data:`NO_PHOTOGRAPH` shows all frusta and moves no page.
        """
        self._chosen.value = name
        for view, other in enumerate(self._cameras):
            self.server.scene.get_handle_by_name(f"/cameras/{view:05d}").visible = other != name
        for client in self.server.get_clients().values() if name in self._cameras else ():
            with client.atomic():
                _put(client.camera, *self._cameras[name])


def _put(camera: Any, pose: Float[Tensor, "4 4"], fov: float) -> None:  # noqa: ANN401 - viser's
    """Put the camera of a page, or of new pages, where a photograph was taken.

    It turns about a point as far away as the middle of the scene. Up stays that of the viewer, but
    for the roll of the picture.
    """
    right, position = pose[:3, 0], pose[:3, 3]
    up = torch.tensor([0.0, 0.0, 1.0]).to(right) - right[2] * right
    camera.fov, camera.position = fov, position.numpy()
    camera.look_at = (position + position.norm() * pose[:3, 2]).numpy()
    setattr(camera, "up_direction" if hasattr(camera, "up_direction") else "up", up.numpy())


def small_pictures(views: Views) -> list[np.ndarray]:
    """Shrink photographs, without the padding of the raster, to 8-bit sRGB."""
    pictures = []
    for (image,), (width, height) in zip(each(views.images), views.sizes_px.tolist(), strict=True):
        small = shrunk(image[:, :height, :width].detach().cpu().clamp(0, 1), 256)
        pictures.append(to_bytes(small.expand(3, -1, -1)).movedim(0, -1).contiguous().numpy())
    return pictures
