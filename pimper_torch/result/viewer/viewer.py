"""The page: what is in the scene, and the controls beside it."""

import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.radiometry import to_bytes
from pimper_torch.records import Cameras, Mesh, Views
from pimper_torch.result.asset.gltf import MATTE, gltf_of
from pimper_torch.result.report.predictions import shrunk
from pimper_torch.result.viewer.frame import Frame, Stand, frame_of_cameras, frame_of_mesh, stand_of
from pimper_torch.result.viewer.layers import LAYERS, painted
from pimper_torch.result.viewer.server import HOST, PORT, address, close_server, open_server
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.mapped import each

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

NO_PHOTOGRAPH = "none"
# Of frusta: photographs are a third of a unit wide where cameras are three away, and two dozen of
# them on a ring stand 0.8 apart.
_SCALE = 0.15
_POINT_COLOR = (110, 140, 190)
# Raking light from up on the left, and how much of it is round about; degrees.
_AZIMUTH, _ELEVATION, _AMBIENT = -45.0, 40.0, 0.15
# Of light that falls straight on: three.js divides by pi what a matte surface reflects.
_BRIGHTNESS = math.pi


class Viewer:
    """A scene in a browser, which grows while it is looked at.

    Attributes:
        server: viser's own, for whatever else is to be shown.
    """

    def __init__(self, server: "ViserServer") -> None:
        self.server = server
        self._lock = threading.RLock()
        self._frame: Frame | None = None
        self._passes: list[tuple[str, Mesh]] = []
        self._stands: dict[str, Stand] = {}
        scene = server.scene
        scene.configure_default_lights(enabled=False)
        scene.configure_environment_map(hdri=None)
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        self._sun = scene.add_light_directional("/light", intensity=_BRIGHTNESS)
        self._sky = scene.add_light_ambient("/ambient", intensity=_BRIGHTNESS * _AMBIENT)
        self._add_controls()
        self._light()

    @property
    def address(self) -> str:
        """Address for a browser."""
        return address(self.server)

    def stop(self) -> None:
        """Close the server; the page stays as it was."""
        close_server(self.server)

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
        points_world: Float[Tensor, "point 3"],
        reference: int = 0,
        views: Views | None = None,
    ) -> None:
        """Show cameras and the sparse cloud, and photographs in frusta where they are at hand.

        Args:
            names: Of the photographs, in the order of the cameras.
        """
        frame = self._frame = frame_of_cameras(cameras, reference, points_world)
        scene = self.server.scene
        points = frame.points(points_world).float().numpy()
        scene.add_point_cloud("/points", points, _POINT_COLOR, point_size=0.004)
        self._points.disabled = False
        scene.add_frame("/cameras", show_axes=False)
        pictures = None if views is None else small_pictures(views)
        for view, name in enumerate(names):
            self._add_camera(view, name, cameras, None if pictures is None else pictures[view])
        self._chosen.options = (NO_PHOTOGRAPH, *names)
        _stand_at(self.server.initial_camera, self._stands[names[reference]])
        self.choose(names[reference])

    def _add_camera(
        self, view: int, name: str, cameras: Cameras, picture: np.ndarray | None
    ) -> None:
        from viser.transforms import SO3

        assert self._frame is not None
        stand = self._stands[name] = stand_of(cameras, view, self._frame)
        width, height = cameras.sizes_px[view].tolist()
        frustum = self.server.scene.add_camera_frustum(
            f"/cameras/{view:05d}",
            stand.fov,
            width / height,
            scale=_SCALE,
            thickness=1.5,
            thickness_units="screen",
            image=picture,
            wxyz=SO3.from_matrix(stand.rotation.numpy()).wxyz,
            position=stand.position.numpy(),
        )
        frustum.on_click(lambda event: self.choose(name, event.client))

    def add_pass(self, name: str, mesh: Mesh) -> None:
        """Show a surface; the slider goes back to those before.

        Args:
            mesh: In the world of the cameras.
        """
        if not len(mesh.faces):
            raise InputError(
                f"the {name} has {len(mesh.vertices_world)} vertices and no faces; needed: a "
                "surface, as a viewer of point clouds shows clouds."
            )
        with self._lock:
            if self._frame is None:
                self._frame = frame_of_mesh(mesh)
            if not self._passes:
                self._points.value = False  # they lie on the surface
            self._passes.append((name, mesh.detach().to("cpu")))
            last = len(self._passes) - 1
            self._pass.max, self._pass.visible = max(1, last), last > 0
            if self._pass.value == last:
                self._paint()
            else:
                self._pass.value = last  # paints

    def choose(self, name: str, client: "ClientHandle | None" = None) -> None:
        """Stand where a photograph was taken.

        Its own frustum is hidden meanwhile, as it is before the object.

        Args:
            name: Of the photograph; :data:`NO_PHOTOGRAPH` stays where one is.
            client: Page that stands there; all of them unless given.
        """
        self._chosen.value = name
        for view, other in enumerate(self._stands):
            self.server.scene.get_handle_by_name(f"/cameras/{view:05d}").visible = other != name
        if name not in self._stands:
            return
        for one in self.server.get_clients().values() if client is None else (client,):
            with one.atomic():
                _stand_at(one.camera, self._stands[name])

    def _add_controls(self) -> None:
        gui, scene = self.server.gui, self.server.scene
        self._layer = gui.add_dropdown("layer", tuple(LAYERS))
        self._pass = gui.add_slider("pass", 0, 1, 1, 0, visible=False)
        self._about = gui.add_markdown("No surface yet.")
        self._chosen = gui.add_dropdown("photograph", (NO_PHOTOGRAPH,))
        with gui.add_folder("light"):
            self._azimuth = gui.add_slider("azimuth", -180.0, 180.0, 1.0, _AZIMUTH)
            self._elevation = gui.add_slider("elevation", -90.0, 90.0, 1.0, _ELEVATION)
            self._ambient = gui.add_slider("ambient", 0.0, 1.0, 0.01, _AMBIENT)
        with gui.add_folder("show"):
            self._surface = gui.add_checkbox("surface", True)
            self._cameras = gui.add_checkbox("cameras", True)
            self._points = gui.add_checkbox("points", True, disabled=True)
        for control in (self._layer, self._pass):
            control.on_update(lambda _: self._paint())
        for slider in (self._azimuth, self._elevation, self._ambient):
            slider.on_update(lambda _: self._light())
        # Without a client it is `choose` itself that sets it.
        self._chosen.on_update(
            lambda event: self.choose(self._chosen.value, event.client) if event.client else None
        )
        for name in ("surface", "cameras", "points"):
            box = getattr(self, f"_{name}")

            def show(_: object, name: str = name, box: Any = box) -> None:  # noqa: ANN401 - viser's
                node = scene.get_handle_by_name(f"/{name}")
                if node is not None:
                    node.visible = box.value

            box.on_update(show)

    def _paint(self) -> None:
        """Colour the chosen surface by the chosen layer."""
        with self._lock:
            if not self._passes or self._frame is None:
                return
            name, mesh = self._passes[round(self._pass.value)]
            wanted = self._layer.value
            bare = mesh.albedo is None and wanted in ("lit", "albedo")
            layer = painted(mesh, "shape" if bare else wanted, self._frame)
            attributes = {
                "POSITION": self._frame.points(mesh.vertices_world),
                "NORMAL": self._frame.directions(layer.normals_world),
                "COLOR_0": layer.colors,
            }
            data = gltf_of(
                {key: values.numpy() for key, values in attributes.items()},
                mesh.faces.numpy(),
                MATTE if layer.lit else MATTE | {"extensions": {"KHR_materials_unlit": {}}},
            )
            self.server.scene.add_glb("/surface", data, visible=self._surface.value)
            legend = "It has no albedo: grey clay." if bare else LAYERS[wanted]
            self._about.content = f"**{name}**, {len(mesh.faces):,} faces. {legend}"

    def _light(self) -> None:
        """Move the light where the sliders are."""
        azimuth, elevation = math.radians(self._azimuth.value), math.radians(self._elevation.value)
        flat = math.cos(elevation)
        direction = (flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation))
        self._sun.position = tuple(10 * one for one in direction)  # it shines on the origin
        self._sun.intensity = _BRIGHTNESS * (1 - self._ambient.value)
        self._sky.intensity = _BRIGHTNESS * self._ambient.value


def _stand_at(camera: Any, stand: Stand) -> None:  # noqa: ANN401 - a page's, or of new pages
    """Put the camera of a page where a photograph was taken."""
    up = "up_direction" if hasattr(camera, "up_direction") else "up"
    camera.fov, camera.position = stand.fov, stand.position.numpy()
    camera.look_at = stand.ahead.numpy()
    setattr(camera, up, stand.up.numpy())


@contextmanager
def opened(host: str = HOST, port: int = PORT) -> Iterator[Viewer]:
    """Have an empty page in the ``with`` block, see :func:`open_server`."""
    viewer = Viewer(open_server(host, port))
    try:
        yield viewer
    finally:
        viewer.stop()


def small_pictures(views: Views) -> list[np.ndarray]:
    """Shrink photographs, without the padding of the raster, to 8-bit sRGB."""
    pictures = []
    for (image,), (width, height) in zip(each(views.images), views.sizes_px.tolist(), strict=True):
        small = shrunk(image[:, :height, :width].detach().cpu().clamp(0, 1), 256)
        pictures.append(to_bytes(small.expand(3, -1, -1)).movedim(0, -1).contiguous().numpy())
    return pictures
