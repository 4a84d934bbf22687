"""The page: what is in the scene, and the controls beside it."""

import math
import threading
from collections.abc import Sequence
from contextlib import redirect_stdout
from io import StringIO
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.ground.geometry.pinholes import look_at
from pimper_torch.ground.geometry.rigid import invert_rigid, transform
from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.ground.shapes import Points
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.result.report.predictions import shrunk
from pimper_torch.result.viewer.frame import frame_of_cameras, frame_of_mesh
from pimper_torch.result.viewer.layers import LAYERS, VIRIDIS, layers_of, painted
from pimper_torch.result.viewer.server import HOST, PORT, open_server
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import each

NO_PHOTOGRAPH = "none"
# Of frusta: photographs are a third of a unit wide where cameras are three away, and two dozen of
# them on a ring stand 0.8 apart.
_SCALE = 0.15
_POINT_COLOR = (110, 140, 190)
_AMBIENT = 0.15  # the share of light that comes from everywhere
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
        self._lock = threading.RLock()  # a page's thread repaints what a run adds
        self._surfaces: list[str] = []
        self._newest: tuple[str, Mesh] | None = None
        self._cameras: dict[str, tuple[Float[Tensor, "4 4"], float]] = {}
        self._see_whole(1.0)
        scene, gui = self.server.scene, self.server.gui
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        direct = _BRIGHTNESS * (1 - _AMBIENT)
        self._light = scene.add_light_directional("/light", intensity=direct)
        self._frusta = scene.add_frame("/cameras", show_axes=False)
        scene.add_light_ambient("/ambient", intensity=_BRIGHTNESS * _AMBIENT)
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        self._layer = gui.add_dropdown("layer", LAYERS)
        self._about = gui.add_markdown("No surface yet.")
        self._bar = gui.add_image(VIRIDIS.expand(12, -1, -1).numpy(), visible=False)
        self._chosen = gui.add_dropdown("photograph", (NO_PHOTOGRAPH,))
        # Without a client it is `choose` itself that sets it.
        self._chosen.on_update(
            lambda event: self.choose(self._chosen.value) if event.client else None
        )
        with gui.add_folder("light"):  # at first raking, from up on the reference camera's left
            self._azimuth = gui.add_slider("azimuth", -180.0, 180.0, 1.0, -45.0)
            self._elevation = gui.add_slider("elevation", -90.0, 90.0, 1.0, 40.0)
        self._layer.on_update(lambda _: self._paint())
        for slider in (self._azimuth, self._elevation):
            slider.on_update(lambda _: self._turn_light())
        self._turn_light()

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
        pictures = None if views is None else small_pictures(views)
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
                image=None if pictures is None else pictures[view],
                wxyz=SO3.from_matrix(pose[:3, :3].numpy()).wxyz,
                position=pose[:3, 3].numpy(),
            )
            frustum.on_click(lambda _, name=name: self.choose(name))
        self._chosen.options = (NO_PHOTOGRAPH, *names)

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
        mesh = mesh.detach().to("cpu")
        with self._lock:
            if self._viewer_from_world is None:
                self._viewer_from_world = frame_of_mesh(mesh)
            for before in ("/points", *self._surfaces):  # points lie on the surface
                if node := self.server.scene.get_handle_by_name(before):
                    node.visible = False
            self._surfaces.append(f"/surfaces/{len(self._surfaces)}: {name}")
            self._newest = name, mesh
            vertices = transform(self._viewer_from_world, mesh.vertices_world.double())
            self._see_whole(float(vertices.norm(dim=1).max()))
            self._layer.options = layers_of(mesh)
            self._paint()

    def choose(self, name: str) -> None:
        """Stand, on every open page, where a photograph was taken, without frusta before the eye.

        Args:
            name: Of the photograph; :data:`NO_PHOTOGRAPH` looks at the whole, with all frusta.
        """
        self._chosen.value = name
        self._frusta.visible = name == NO_PHOTOGRAPH
        for client in self.server.get_clients().values():
            with client.atomic():
                _put(client.camera, *self._cameras[name])

    def _paint(self) -> None:
        with self._lock:
            if self._newest is None or self._viewer_from_world is None:
                return
            name, mesh = self._newest
            glb, legend = painted(mesh, self._layer.value, self._viewer_from_world)
            self.server.scene.add_glb(self._surfaces[-1], glb)
            self._about.content = f"**{name}**, {len(mesh.faces):,} faces. {legend}".rstrip()
            self._bar.visible = bool(legend)

    def _turn_light(self) -> None:
        """Let the light come from where the sliders are; it shines on the origin."""
        azimuth, elevation = np.radians((self._azimuth.value, self._elevation.value))
        x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
        self._light.position = x, y, np.sin(elevation)

    def _see_whole(self, radius: float) -> None:
        """Let pages without a photograph look down at all within a radius of the middle."""
        fov, up = math.radians(50), torch.tensor([0.0, 0.0, 1.0])
        eye = radius / math.sin(fov / 2) * torch.tensor([[0.94, 0.0, 0.34]])
        whole = self._cameras[NO_PHOTOGRAPH] = invert_rigid(look_at(eye, 0 * up, up))[0], fov
        _put(self.server.initial_camera, *whole)


def _put(camera: Any, pose: Float[Tensor, "4 4"], fov: float) -> None:  # noqa: ANN401 - viser's
    """Put the camera of a page, or of new pages, at a pose, ``viewer_from_cam``.

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
