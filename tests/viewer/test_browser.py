"""The page in a browser that draws in software."""

import io
import shutil
import time

import numpy as np
import pytest
from PIL import Image

from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.records import Mesh
from pimper_torch.result.viewer.show import add_found

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRAWN_IN_SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# A busy machine draws a first picture after half a minute.
PATIENCE_SECONDS = 120.0
LARGE = 2_000  # pixels

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium"),
]


@pytest.fixture
def page():
    sync_api = pytest.importorskip("playwright.sync_api")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=[*DRAWN_IN_SOFTWARE, "--no-sandbox"]
        )
        yield browser.new_page(viewport={"width": 640, "height": 400})
        browser.close()


def scene_of(page):
    """The picture left of the controls and below the browser's notices, 0 to 1."""
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        return np.asarray(picture.convert("L"), dtype=float)[200:, :300] / 255


def until(page, true):
    """Look at the page until something holds of its picture."""
    end = time.monotonic() + PATIENCE_SECONDS
    while not true(picture := scene_of(page)):
        assert time.monotonic() < end
        page.wait_for_timeout(500)
    return picture


def side(picture):
    """How much brighter the object is on the left than on the right."""
    columns = np.broadcast_to(np.arange(picture.shape[1]), picture.shape)
    there = picture < 0.99
    left = there & (columns < np.median(columns[there]))
    return picture[left].mean() - picture[there & ~left].mean()


def test_the_object_is_there_and_the_light_moves_its_shading(viewer, page):
    fetched, errors = [], []
    page.on("request", lambda request: fetched.append(request.url))
    page.on("pageerror", lambda error: errors.append(error.message))
    page.on("console", lambda told: errors.append(told.text) if told.type == "error" else None)
    vertices, faces = icosphere(3)
    viewer.add_pass("ball", Mesh(vertices_world=vertices, faces=faces))
    viewer._layer.value = "shape"
    viewer._azimuth.value, viewer._elevation.value = -45.0, 0.0  # the page looks from 45 degrees
    page.goto(viewer.address)
    until(page, lambda picture: (picture < 0.99).sum() > LARGE and side(picture) > 0.1)
    viewer._azimuth.value = 135.0
    until(page, lambda picture: side(picture) < -0.1)
    viewer._surface.value = False
    until(page, lambda picture: (picture < 0.99).sum() < LARGE / 10)
    elsewhere = [url for url in fetched if not url.startswith((viewer.address, "data:", "blob:"))]
    assert not elsewhere
    assert not errors


def test_a_click_on_a_frustum_stands_there(viewer, page, reconstruction):
    add_found(viewer, reconstruction.scene)
    viewer.choose("none")
    viewer.add_pass("result", reconstruction.mesh)
    page.goto(viewer.address)
    until(page, lambda picture: (picture < 0.99).sum() > LARGE)
    (client,) = viewer.server.get_clients().values()
    name = reconstruction.scene.views.names[1]
    stand = viewer._stands[name]
    client.camera.position = 3 * stand.position.numpy()
    client.camera.look_at = stand.position.numpy()  # in the middle of the page
    page.wait_for_timeout(3000)
    box = page.locator("canvas").first.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.wait_for_timeout(1000)
    page.mouse.click(*middle)
    until(page, lambda _: viewer._chosen.value == name)
    until(page, lambda _: np.allclose(client.camera.position, stand.position, atol=1e-3))
