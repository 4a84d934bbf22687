"""The page in a browser with software rendering."""

import io
import shutil
import time

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import ball
from sparse_models import views_of

from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.viewer.show import add_found

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DRAWN_IN_SOFTWARE = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# A busy machine takes half a minute for the first image.
PATIENCE_SECONDS = 120.0
LARGE = 2_000  # pixels
LAYER, PHOTOGRAPH = 0, 1  # drop-down lists of the page, from the top
GROUND = 80 / 255  # the background is darker, and the surface brighter

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


def colors(page):
    """Return the image left of the controls and below the browser's notices, 0 to 1."""
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        return np.asarray(picture.convert("RGB"), dtype=float)[200:580, :500] / 255


def drawn(picture):
    """Return whether a surface is drawn; the page is white until then."""
    return min((picture > GROUND).sum(), (picture < GROUND).sum()) > LARGE


def violet(page):
    """Return the fraction of the image with photographs of :func:`close_cameras`."""
    red, green, blue = colors(page).transpose(2, 0, 1)
    return float(((red > 0.5) & (blue > 0.5) & (green < 0.4)).mean())


def choose(page, control, option):
    """Select an option of a list with the mouse."""
    page.locator("input.mantine-Select-input:visible").nth(control).click()
    page.get_by_role("option", name=option, exact=True).click()


@pytest.fixture
def close_cameras(viewer):
    """Show violet photographs near a large ball; the second is between it and the first."""
    towards, up = torch.tensor([0.94, 0.0, 0.34]), torch.tensor([0.0, 0.0, 1.0])
    eyes = torch.stack([3.2 * towards, 2.8 * towards, torch.tensor([0.0, 2.8, 1.0])])
    cameras = pinholes(look_at(eyes, torch.zeros(3), up), 300.0, 400, 300)
    images = torch.tensor([1.0, 0.0, 1.0])[None, :, None, None].expand(3, 3, 300, 400)
    names = ("far.jpg", "near.jpg", "aside.jpg")
    views = views_of(images, names=names, focals_px=torch.full((3,), 300.0))
    viewer.add_cameras(names, cameras, torch.zeros(1, 3), 0, views)
    mesh = ball(1.5, level=4).to(torch.float32)
    viewer.add_pass("ball", mesh.replace(confidence=torch.rand(len(mesh.vertices_world))))


@pytest.mark.usefixtures("close_cameras")
def test_photographs_do_not_cover_the_surface_unless_faded_in(viewer, page):
    page.set_viewport_size({"width": 900, "height": 600})
    page.goto(viewer.address)
    until(page, drawn)
    (client,) = viewer.server.get_clients().values()
    home, far = (viewer._cameras[name][0][:3, 3].numpy() for name in ("none", "far.jpg"))
    until(page, lambda _: np.allclose(client.camera.position, home, atol=1e-3))
    page.wait_for_timeout(3000)
    assert violet(page) == 0
    choose(page, PHOTOGRAPH, "far.jpg")
    until(page, lambda _: np.allclose(client.camera.position, far, atol=1e-3))
    until(page, lambda _: violet(page) == 0)
    plain = colors(page)
    assert (plain.mean(axis=2) > GROUND).mean() > 0.5
    choose(page, LAYER, "support")
    until(page, lambda _: np.abs(colors(page) - plain).mean() > 0.1)
    viewer._fade.value = 1.0
    until(page, lambda _: violet(page) > 0.5)
    choose(page, PHOTOGRAPH, "none")
    until(page, lambda _: np.allclose(client.camera.position, home, atol=1e-3))
    until(page, lambda picture: violet(page) == 0 and drawn(picture))


@pytest.mark.usefixtures("close_cameras")
def test_a_phone_shows_the_complete_surface_above_the_controls(viewer, page):
    page.set_viewport_size({"width": 390, "height": 760})
    page.goto(viewer.address)

    def bright():
        with Image.open(io.BytesIO(page.screenshot())) as picture:
            return np.asarray(picture.convert("L"), dtype=float)[180:520] / 255 > 0.3

    until(page, drawn)
    page.wait_for_timeout(5000)
    shown = bright()
    assert not shown[:, [0, 1, -2, -1]].any()  # no side is cropped
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    choose(page, LAYER, "support")
    bar = page.get_by_text("full", exact=True)
    bar.wait_for(timeout=1000 * PATIENCE_SECONDS)
    box = bar.bounding_box()
    assert 0 <= box["x"] < box["x"] + box["width"] <= 390
    assert 380 < box["y"] < 760


def until(page, true):
    """Wait until a condition on the image left of the controls, 0 to 1, is true."""
    end = time.monotonic() + PATIENCE_SECONDS
    while True:
        with Image.open(io.BytesIO(page.screenshot())) as picture:
            # Below the browser's notices.
            if true(np.asarray(picture.convert("L"), dtype=float)[200:, :300] / 255):
                return
        assert time.monotonic() < end
        page.wait_for_timeout(500)


def filled(page):
    """Return the larger fraction of the canvas' width or height that a surface takes."""
    box = page.locator("canvas").first.bounding_box()
    left, top = int(box["x"]), int(box["y"])
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        colored = np.asarray(picture.convert("RGB"), dtype=float)
    inside = colored[top : top + int(box["height"]), left : left + int(box["width"])]
    shown = np.ptp(inside, axis=2) > 60  # the ground is grey
    return max(shown.any(axis=1).mean(), shown.any(axis=0).mean())


def test_the_surface_fills_the_window_also_after_its_resize(viewer, page):
    viewer.add_pass("ball", ball(0.3, level=4).to(torch.float32))
    viewer._layer.value = "normals"
    page.set_viewport_size({"width": 900, "height": 600})
    page.goto(viewer.address)
    for width, height in ((900, 600), (500, 900), (1000, 500)):
        page.set_viewport_size({"width": width, "height": height})
        until(page, lambda _: 0.85 < filled(page) < 1)


def test_the_light_is_set_by_a_disc(viewer, page):
    viewer.add_pass("ball", ball(1.0, level=4).to(torch.float32))
    page.set_viewport_size({"width": 900, "height": 600})
    page.goto(viewer.address)
    until(page, drawn)
    assert not page.get_by_text("light", exact=True).is_visible()  # the text field of the disc
    disc = page.locator("#lamp").bounding_box()
    middle = disc["x"] + disc["width"] / 2, disc["y"] + disc["height"] / 2
    for side in (-1, 1):
        page.mouse.move(*middle)
        page.mouse.down()
        page.mouse.move(middle[0] + 0.4 * side * disc["width"], middle[1], steps=3)
        page.mouse.up()
        until(page, lambda _, side=side: side * brighter_right(page) > 0.05)
    right, up = map(float, viewer._light.value.split())
    assert (right, up) == (pytest.approx(0.92, abs=0.03), pytest.approx(0, abs=0.03))
    page.locator("#lamp").focus()
    page.keyboard.press("ArrowUp")
    until(page, lambda _: float(viewer._light.value.split()[1]) > 0.05)


def brighter_right(page):
    """Return by how much the right half of the canvas is brighter, 0 to 1."""
    box = page.locator("canvas").first.bounding_box()
    with Image.open(io.BytesIO(page.screenshot())) as picture:
        grey = np.asarray(picture.convert("L"), dtype=float)[200:, int(box["x"]) :] / 255
    half = int(box["width"]) // 2
    return grey[:, half : 2 * half].mean() - grey[:, :half].mean()


def test_a_click_on_a_frustum_moves_the_viewpoint_there(viewer, page, reconstruction):
    fetched, errors = [], []
    page.on("request", lambda request: fetched.append(request.url))
    page.on("pageerror", lambda error: errors.append(error.message))
    page.on("console", lambda entry: errors.append(entry.text) if entry.type == "error" else None)
    add_found(viewer, reconstruction)
    page.goto(viewer.address)
    until(page, drawn)
    (client,) = viewer.server.get_clients().values()
    name = reconstruction.scene.views.names[1]
    position = viewer._cameras[name][0][:3, 3].numpy()
    client.camera.position = 3 * position
    client.camera.look_at = position  # at the centre of the page
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
