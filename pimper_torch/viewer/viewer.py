"""The viewer's page: the scene, and the controls next to it."""

import math
import threading
from collections.abc import Sequence
from contextlib import AbstractContextManager, redirect_stdout
from io import StringIO
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity, normalize

from pimper_torch.geometry.pinholes import look_at
from pimper_torch.geometry.rigid import invert_rigid, rigid, transform
from pimper_torch.geometry.supporting_plane import fixation
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import each
from pimper_torch.viewer.layers import LAYERS, color_bar, layers_of, painted, pane
from pimper_torch.viewer.server import HOST, PORT, open_server
from pimper_torch.viz.cells import LAMP
from pimper_torch.viz.report.predictions import shrunk_to

NO_PHOTOGRAPH = "none"
# Scale of frusta: photographs are a third of a unit wide if cameras are three units away, and two
# dozen of them on a ring are 0.8 apart.
_SCALE = 0.15
_POINT_COLOR = (110, 140, 190)
_IMAGE_PX = 480  # a choice: 200 photographs take 12 MB, and 120 MB of GPU memory
# The report's light: three.js divides the reflection of a matte surface by pi.
_DIRECT, _AMBIENT = math.pi, 0.2 * math.pi


class Viewer(AbstractContextManager["Viewer", None]):
    """A scene in a browser, to which surfaces can be added while it is displayed.

    Attributes:
        server: viser's server, for adding other items.
        unit: Of lengths, if the scale is known; otherwise they are fractions of the object's size.
    """

    unit: str | None = None

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        self.server = open_server(host, port)
        self._viewer_from_world: Float[Tensor, "4 4"] | None = None
        self._lock = threading.RLock()  # a page's thread repaints surfaces that a run adds
        self._surfaces: list[str] = []
        self._newest: tuple[str, Mesh] | None = None
        # Pose, vertical field of view, and aspect ratio (width over height).
        self._cameras: dict[str, tuple[Float[Tensor, "4 4"], float, float]] = {}
        self._lenses: dict[int, list[float]] = {}  # field of view and aspect ratio of each page
        self._frusta: dict[str, Any] = {}
        self._panes: dict[str, tuple[np.ndarray, np.ndarray]] = {}  # photographs, and corners
        scene, gui = self.server.scene, self.server.gui
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        scene.add_light_ambient("/ambient", intensity=_AMBIENT)
        scene.set_background_image(_ground(), format="png")
        gui.configure_theme(
            dark_mode=True, brand_color=(255, 210, 74), show_logo=False, show_share_button=False
        )
        gui.main_panel.dock_right()
        self._layer = gui.add_dropdown("layer", LAYERS)
        self._bar = gui.add_html("", visible=False)
        self._chosen = gui.add_dropdown("photograph", (NO_PHOTOGRAPH,))
        self._fade = gui.add_slider("photograph opacity", 0.0, 1.0, 0.05, 0.0, visible=False)
        self._light = gui.add_text("light", "-0.45 0.55")  # the disc hides and sets it
        gui.add_html(LAMP)
        self._about = gui.add_markdown("No surface yet.")
        self._see_whole(torch.cat([torch.eye(3), -torch.eye(3)]))
        self._layer.on_update(lambda _: self._paint())
        # Without a client, `choose` itself has set the value.
        self._chosen.on_update(
            lambda event: self.choose(self._chosen.value) if event.client else None
        )
        self._fade.on_update(lambda _: self._lay_photograph())
        self._light.on_update(lambda _: self._turn_lights())
        self.server.on_client_connect(self._welcome)

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def address(self) -> str:
        """Address for a browser."""
        host = self.server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def stop(self) -> None:
        """Close the server with all its connections; open pages no longer respond."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def wait(self) -> None:
        """Block until Ctrl-C, which raises ``KeyboardInterrupt``."""
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
        """Add cameras, the sparse cloud, and the photographs, if given, in the cameras' frusta.

        Args:
            names: Of the photographs, in the order of the cameras.
        """
        from viser.transforms import SO3

        scene = self.server.scene
        frame = self._viewer_from_world = frame_of_cameras(cameras, reference)
        points = transform(frame, points_world.detach().cpu().double()).float().numpy()
        scene.add_point_cloud("/points", points, _POINT_COLOR, point_size=0.004)
        images = [None] * len(names) if views is None else small_images(views)
        poses = frame @ invert_rigid(cameras.cam_from_world.detach().cpu().double())
        for view, (name, pose, image) in enumerate(zip(names, poses, images, strict=True)):
            width, height = cameras.sizes_px[view].tolist()
            K = cameras.intrinsics[view].detach().cpu().double()
            fov = 2 * math.atan(height / 2 / float(K[1, 1]))
            pose[:3, :3] = normalize(pose[:3, :3], dim=0)
            self._cameras[name] = pose, fov, width / height
            if image is not None:
                ends = torch.tensor([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]])
                rays = _SCALE * ends.double() @ K.inverse().mT
                self._panes[name] = image, transform(pose, rays).numpy()
            frustum = self._frusta[name] = scene.add_camera_frustum(
                f"/cameras/{view:05d}",
                fov,
                width / height,
                scale=_SCALE,
                thickness=1.5,
                thickness_units="screen",
                color=(143, 211, 255),
                image=image,
                wxyz=SO3.from_matrix(pose[:3, :3].numpy()).wxyz,
                position=pose[:3, 3].numpy(),
            )
            frustum.on_click(lambda _, name=name: self.choose(name))
        self._chosen.options = (NO_PHOTOGRAPH, *names)
        self._show_frusta()

    def add_pass(self, name: str, mesh: Mesh) -> None:
        """Display a surface and hide earlier ones; the page's scene tree can show them again.

        Args:
            mesh: In the world of the cameras.
        """
        if not len(mesh.faces):
            raise InputError(
                f"the {name} has {len(mesh.vertices_world)} vertices and no faces; needed: a "
                "surface. Open point clouds in a point cloud viewer."
            )
        mesh = mesh.detach().to("cpu")
        with self._lock:
            if self._viewer_from_world is None:
                self._viewer_from_world = frame_of_mesh(mesh)
            for before in ("/points", *self._surfaces):  # points coincide with the surface
                if node := self.server.scene.get_handle_by_name(before):
                    node.visible = False
            self._surfaces.append(f"/surfaces/{len(self._surfaces)}: {name}")
            self._newest = name, mesh
            self._see_whole(transform(self._viewer_from_world, mesh.vertices_world.double()))
            self._layer.options = layers_of(mesh)
            self._paint()
            if len(self._surfaces) == 1:
                self.choose(NO_PHOTOGRAPH)

    def choose(self, name: str) -> None:
        """Move every open page to the viewpoint of a photograph, and hide all frusta.

        Args:
            name: Of the photograph; :data:`NO_PHOTOGRAPH` shows the complete surface, with the
                frusta that do not cover it.
        """
        self._chosen.value = name
        self._fade.visible = name in self._panes
        self._show_frusta()
        self._lay_photograph()
        for client in self.server.get_clients().values():
            self._move_to_camera(client)

    def _welcome(self, client: Any) -> None:  # noqa: ANN401 - viser's
        """Initialize a new page: the same scene, under a light that follows its viewpoint."""
        client.scene.add_light_directional("/light", intensity=_DIRECT)
        self._move_to_camera(client)
        client.camera.on_update(lambda _: self._follow(client))
        self._turn_lights()

    def _move_to_camera(self, client: Any) -> None:  # noqa: ANN401 - viser's
        """Move a page to the selected camera, with its complete image inside the window."""
        pose, *self._lenses[client.client_id] = self._cameras[self._chosen.value]
        with client.atomic():
            _put(client.camera, pose, self._fov_of(client))

    def _fov_of(self, client: Any) -> float:  # noqa: ANN401 - viser's
        """Return the vertical field of view with a page's complete image inside its window."""
        fov, aspect = self._lenses[client.client_id]
        return 2 * math.atan(math.tan(fov / 2) * max(1.0, aspect / client.camera.aspect))

    def _follow(self, client: Any) -> None:  # noqa: ANN401 - viser's
        """Adapt a page to a new viewpoint, or to a new size of its window."""
        client.camera.fov = self._fov_of(client)
        self._turn_lights()

    def _turn_lights(self) -> None:
        """Set the light of every page to the disc's direction, relative to its viewpoint."""
        from viser.transforms import SO3

        right, up = map(float, self._light.value.split())
        towards = np.array([right, -up, -math.sqrt(max(0.0, 1 - right**2 - up**2))])
        for client in self.server.get_clients().values():
            if lamp := client.scene.get_handle_by_name("/light"):
                lamp.position = SO3(client.camera.wxyz).apply(towards)

    def _lay_photograph(self) -> None:
        """Draw the selected photograph over the surface, with the slider's opacity."""
        if overlay := self.server.scene.get_handle_by_name("/photograph"):
            overlay.remove()
        if self._chosen.value in self._panes and self._fade.value:
            glb = pane(*self._panes[self._chosen.value], self._fade.value)
            self.server.scene.add_glb("/photograph", glb)

    def _show_frusta(self) -> None:
        """Hide all frusta at a photograph's viewpoint; otherwise those in front of the surface."""
        (home, fov, aspect), size = self._cameras[NO_PHOTOGRAPH], 2 * _SCALE
        half = math.atan(math.tan(fov / 2) * max(1.0, aspect))
        for name, frustum in self._frusta.items():
            away = self._cameras[name][0][:3, 3] - home[:3, 3]
            angle = cosine_similarity(away, home[:3, 2], dim=0).clamp(-1, 1).acos()
            near = away.norm() < home[:3, 3].norm()
            covers = near & (angle < half + torch.atan(size / away.norm()))
            frustum.visible = self._chosen.value == NO_PHOTOGRAPH and not bool(covers)

    def _paint(self) -> None:
        with self._lock:
            if self._newest is None or self._viewer_from_world is None:
                return
            name, mesh = self._newest
            glb, layer = painted(mesh, self._layer.value, self._viewer_from_world, self.unit)
            self.server.scene.add_glb(self._surfaces[-1], glb)
            about = "" if layer is None else f" {layer.about}."
            self._about.content = f"**{name}**, {len(mesh.faces):,} faces.{about}"
            self._bar.content = "" if layer is None else color_bar(layer)
            self._bar.visible = layer is not None

    def _see_whole(self, points: Points) -> None:
        """Set the initial viewpoint, from above, such that points fill the image."""
        middle, up = (points.amin(dim=0) + points.amax(dim=0)) / 2, points.new_tensor([0.0, 0, 1])
        # A choice: so near that perspective is visible.
        away = 2.4 * (points - middle).norm(dim=1).max() * up.new_tensor([[0.94, 0.0, 0.34]])
        cam_from_viewer = look_at(middle + away, middle, up)[0]
        across, down, depth = transform(cam_from_viewer, points).unbind(dim=1)
        half = [1.05 * float((side / depth).abs().max()) for side in (across, down)]
        pose, fov = invert_rigid(cam_from_viewer[None])[0].double(), 2 * math.atan(half[1])
        self._cameras[NO_PHOTOGRAPH] = pose, fov, half[0] / half[1]
        _put(self.server.initial_camera, pose, fov)
        self._show_frusta()


def frame_of_cameras(cameras: Cameras, reference: int) -> Float[Tensor, "4 4"]:
    """Return ``viewer_from_world``, a similarity in float64 on the CPU.

    The origin is the cameras' fixation point, about three units away. z is the mean up direction of
    the photographs.

    Args:
        reference: View towards which the x axis points.
    """
    poses = cameras.cam_from_world.detach().cpu().double()
    up = normalize(-poses[:, 1, :3].mean(dim=0), dim=0)
    center = fixation(poses)
    away = invert_rigid(poses)[reference, :3, 3] - center.fixation_world
    x = normalize(away - (away @ up) * up, dim=0)
    scaled = 3 / center.distance * torch.stack([x, torch.linalg.cross(up, x), up])
    return rigid(scaled, -scaled @ center.fixation_world)


def frame_of_mesh(mesh: Mesh) -> Float[Tensor, "4 4"]:
    """Centre a mesh without cameras, keeping its axes; see :func:`frame_of_cameras`."""
    low, high = mesh.vertices_world.detach().cpu().double().aminmax(dim=0)
    scaled = 3 / (high - low).norm() * torch.eye(3).double()
    return rigid(scaled, -scaled @ (low + high) / 2)


def _put(camera: Any, pose: Float[Tensor, "4 4"], fov: float) -> None:  # noqa: ANN401 - viser's
    """Set the camera of a page, or of new pages, to a pose, ``viewer_from_cam``.

    It orbits a point as far away as the scene's origin. Up is the viewer's, corrected for the
    photograph's roll.
    """
    right, position = pose[:3, 0], pose[:3, 3]
    up = torch.tensor([0.0, 0.0, 1.0]).to(right) - right[2] * right
    camera.fov, camera.position = fov, position.numpy()
    camera.look_at = (position + position.norm() * pose[:3, 2]).numpy()
    setattr(camera, "up_direction" if hasattr(camera, "up_direction") else "up", up.numpy())


def _ground() -> np.ndarray:
    """Return the report's background image: darker towards the corners."""
    away = np.hypot(*np.mgrid[-1:1:128j, -1:1:128j])[..., None] / math.sqrt(2)
    return ((1 - away) * (74, 78, 87) + away * (35, 38, 44)).round().astype(np.uint8)


def small_images(views: Views) -> list[np.ndarray]:
    """Return shrunk photographs as 8-bit sRGB, without the raster's padding."""
    images = []
    for (image,), (width, height) in zip(each(views.images), views.sizes_px.tolist(), strict=True):
        small = shrunk_to(image[:, :height, :width].detach().cpu().clamp(0, 1), _IMAGE_PX)
        images.append(to_bytes(small.expand(3, -1, -1)).movedim(0, -1).contiguous().numpy())
    return images
