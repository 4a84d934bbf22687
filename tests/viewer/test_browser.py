"""The page in a browser that draws in software."""

import io
import shutil
import time

import numpy as np
import pytest
from PIL import Image

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


def until(page, true):
    """Wait until something holds of the picture left of the controls, 0 to 1."""
    end = time.monotonic() + PATIENCE_SECONDS
    while True:
        with Image.open(io.BytesIO(page.screenshot())) as picture:
            # Below the browser's notices.
            if true(np.asarray(picture.convert("L"), dtype=float)[200:, :300] / 255):
                return
        assert time.monotonic() < end
        page.wait_for_timeout(500)


def test_the_object_is_there_and_a_click_on_a_frustum_stands_there(viewer, page, reconstruction):
    fetched, errors = [], []
    page.on("request", lambda request: fetched.append(request.url))
    page.on("pageerror", lambda error: errors.append(error.message))
    page.on("console", lambda told: errors.append(told.text) if told.type == "error" else None)
    add_found(viewer, reconstruction)
    page.goto(viewer.address)
    until(page, lambda picture: (picture < 0.99).sum() > LARGE)
    (client,) = viewer.server.get_clients().values()
    name = reconstruction.scene.views.names[1]
    position = viewer._cameras[name][0][:3, 3].numpy()
    client.camera.position = 3 * position
    client.camera.look_at = position  # in the middle of the page
    page.wait_for_timeout(3000)
    box = page.locator("canvas").first.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(*middle)
    page.wait_for_timeout(1000)
    page.mouse.click(*middle)
    until(page, lambda _: viewer._chosen.value == name)
    until(page, lambda _: np.allclose(client.camera.position, position, atol=1e-3))
    elsewhere = [url for url in fetched if not url.startswith((viewer.address, "data:", "blob:"))]
    assert not elsewhere
    assert not errors
