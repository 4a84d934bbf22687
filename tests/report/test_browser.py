"""The page in a browser: what it draws, under which light, and what it asks for."""

import shutil
import time
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.records import Judged, Materials, Relighting, Silhouettes
from pimper_torch.result.asset.make import textured
from pimper_torch.result.asset.write import write_asset
from pimper_torch.result.relighting.held_out import predict
from pimper_torch.result.report.page import write_page
from pimper_torch.result.report.predictions import predictions
from pimper_torch.result.report.vertex_layers import surface_layers
from pimper_torch.result.viz.maps import base_color, view_maps
from tests.relighting.ball import SIDE, ball_mesh, photographed

pytestmark = [pytest.mark.browser, pytest.mark.slow]
sync_api = pytest.importorskip("playwright.sync_api")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
SUMMARY = {
    "doubt": None,
    "warnings": ["Two photographs are blurred."],
    "seconds": 12.0,
    "peak_memory_mb": 900.0,
    "stages": [{"name": "warp", "seconds": 4.0, "peak_memory_mb": 500.0, "kept": False}],
    "left_out": [],
    "failures": [],
}
GLOSSY = (0.0, 0.35, 1.0)  # metallic, roughness, specular


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A glossy ball, photographed from six sides, and its page."""
    scene, lights = photographed(GLOSSY)
    mesh = ball_mesh()
    count = len(mesh.vertices_world)
    mesh = mesh.replace(
        expected_error=0.01 + 0.005 * mesh.vertices_world[:, 2], confidence=torch.ones(count)
    )
    materials = Materials.of(torch.zeros(count, dtype=torch.long), torch.tensor([GLOSSY]))
    worth = Judged(
        psnr_db=torch.full((scene.views.num_views,), 31.0), lights=lights, names=scene.views.names
    )
    relighting = Relighting(
        lights=lights, materials=materials, judged=worth, matte=worth, held_out=False
    )
    folder = tmp_path_factory.mktemp("page")
    asset = textured(mesh, mesh, materials.at_vertices())
    write_asset(asset, folder / "asset.glb")
    views = scene.views.num_views
    across = torch.arange(SIDE) + 0.5 - SIDE / 2
    y, x = torch.meshgrid(across, across, indexing="ij")
    silhouettes = Silhouettes(
        inside=(torch.hypot(x, y) < 0.41 * SIDE).float().expand(views, SIDE, SIDE),
        reliable=torch.ones(views, dtype=torch.bool),
        source="found",
    )
    write_page(
        folder / "report.html",
        title="ball",
        headline="6 of 6 photographs",
        asset=(folder / "asset.glb").read_bytes(),
        scene=scene,
        silhouettes=silhouettes,
        reference=0,
        predictions=predictions(mesh, scene, relighting),
        layers=surface_layers(asset.mesh),
        summary=SUMMARY,
        settings="zeta: 0.5",
    )
    return folder / "report.html", mesh, scene, lights, materials


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no Chromium is installed")
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE)
        yield started
        started.close()


@pytest.fixture
def opened(browser, shown):
    """Open the page in a window; whatever goes wrong in it, or is fetched, is noted."""
    context = browser.new_context(viewport={"width": 1200, "height": 800})
    page = context.new_page()
    page.faults, page.asked = [], []
    page.on("console", lambda message: page.faults.append(message.text))
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    opening(page, shown[0])
    yield page
    assert not page.faults
    assert [one for one in page.asked if not one.startswith(("data:", "blob:"))] == [
        shown[0].as_uri()
    ]
    context.close()


def opening(page, path):
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-ready]", state="attached", timeout=60_000)


def choose(page, layer):
    page.get_by_role("button", name=layer, exact=True).click()


def canvas(page):
    """The canvas as it is seen, without what lies over it, once nothing is left to draw."""
    page.add_style_tag(content="#lamp, #legend { opacity: 0; }")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 60)))")
    return pixels(page.locator("#stage").screenshot())


def pixels(data):
    return np.asarray(Image.open(BytesIO(data)).convert("RGB")).astype(float)


def behind(page, view):
    page.locator("#thumbnails button").nth(view).click()


def photograph_of(picture):
    """The middle square of the canvas, as large as the photographs."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = Image.fromarray(picture[top : top + side, left : left + side].astype(np.uint8))
    return np.asarray(square.resize((SIDE, SIDE), Image.Resampling.BOX)).astype(float)


def inner(scene, mesh, view):
    """Pixels of the ball, but for those at its border."""
    seen = view_maps(mesh, scene.cameras, view).seen
    return (-torch.nn.functional.max_pool2d(-seen[None].float(), 5, 1, 2)[0] > 0).numpy()


@pytest.mark.parametrize("view", [0, 2])
def test_albedo_is_drawn_where_our_own_renderer_sees_it(opened, shown, view):
    _, mesh, scene, _, _ = shown
    choose(opened, "albedo")
    behind(opened, view)
    drawn = photograph_of(canvas(opened))
    colored = mesh.replace(albedo=base_color(mesh))
    wanted = srgb_from_linear(view_maps(colored, scene.cameras, view).albedo).numpy() * 255
    inside = inner(scene, mesh, view)
    assert np.abs(drawn - wanted)[inside].mean() < 3
    assert np.abs(drawn - wanted)[inside].max() < 40  # somewhere between texels


def test_normals_have_the_colours_of_our_pictures(opened, shown):
    _, mesh, scene, _, _ = shown
    choose(opened, "normals")
    behind(opened, 1)
    drawn = photograph_of(canvas(opened)) / 255
    normals = view_maps(mesh, scene.cameras, 1).normals_cam.numpy() * [1, -1, -1]
    inside = inner(scene, mesh, 1)
    assert np.abs(drawn - 0.5 - 0.5 * normals)[inside].mean() < 0.01


def test_a_photograph_is_drawn_as_its_fitted_light_makes_it(opened, shown):
    """The renderer of the page and ours have one model of reflectance and one of light."""
    _, mesh, scene, lights, materials = shown
    choose(opened, "lit")
    behind(opened, 3)
    drawn = photograph_of(canvas(opened))
    inside = inner(scene, mesh, 3)

    def encoded(radiance):
        return 255 * srgb_from_linear(radiance.nan_to_num(0).clamp(0, 1)).numpy()

    own = encoded(predict(mesh, scene.cameras.take([3]), lights.take([3]), materials))
    taken = encoded(scene.views.images[3].movedim(0, -1))
    dull = encoded(predict(mesh, scene.cameras.take([3]), lights.take([3])))
    # The page's renderer takes from ambient light what the surface mirrors of it: 2 levels.
    assert np.abs(drawn - own)[inside].mean() < 3.5
    assert np.abs(drawn - taken)[inside].mean() < 4
    bright = inside & (taken.mean(axis=-1) > dull.mean(axis=-1) + 15)  # the highlight
    assert bright.sum() > 50
    assert np.abs(drawn - taken)[bright].mean() < 0.4 * np.abs(dull - taken)[bright].mean()


def test_the_light_follows_the_pointer(opened):
    choose(opened, "shape")
    lamp = opened.locator("#lamp").bounding_box()
    across = []
    for place in (0.2, 0.8):
        opened.mouse.move(lamp["x"] + 0.5 * lamp["width"], lamp["y"] + 0.5 * lamp["height"])
        opened.mouse.down()
        opened.mouse.move(lamp["x"] + place * lamp["width"], lamp["y"] + 0.5 * lamp["height"])
        opened.mouse.up()
        tone = canvas(opened).mean(axis=-1)
        across.append((tone**2 * np.arange(tone.shape[1])).sum() / (tone**2).sum())
    assert across[1] > across[0] + 20


def test_the_surface_turns_under_the_pointer(opened):
    choose(opened, "albedo")
    before, stage = canvas(opened), opened.locator("#canvas").bounding_box()
    x, y = stage["x"] + stage["width"] / 2, stage["y"] + stage["height"] / 2
    count = "Number(document.documentElement.dataset.frames)"
    frames, began = opened.evaluate(count), time.perf_counter()
    opened.mouse.move(x, y)
    opened.mouse.down()
    for step in range(1, 31):
        opened.mouse.move(x + 6 * step, y + step)
    opened.mouse.up()
    rate = (opened.evaluate(count) - frames) / (time.perf_counter() - began)
    print(f"turns at {rate:.0f} frames a second, drawn by software")  # noqa: T201 - a figure to read
    assert rate > 1
    assert np.abs(canvas(opened) - before).mean() > 2


def test_layers_of_numbers_have_a_legend(opened):
    choose(opened, "expected error")
    assert opened.locator("#legend").is_visible()
    assert "units or more" in opened.locator("#high").inner_text()
    low, high = canvas(opened).reshape(-1, 3).min(axis=0), canvas(opened).reshape(-1, 3).max(axis=0)
    assert (high - low).max() > 100


def test_a_click_on_a_camera_stands_behind_it(opened, shown):
    scene = shown[2]
    opened.get_by_label("cameras").check()
    canvas(opened)
    stage = opened.locator("#canvas").bounding_box()
    center = stage["x"] + stage["width"] / 2, stage["y"] + stage["height"] / 2
    opened.mouse.click(*center)  # the reference camera, from behind
    assert opened.locator("#thumbnails button[aria-pressed=true]").count() == 1
    name = opened.locator("#thumbnails button[aria-pressed=true] span").inner_text()
    assert name == scene.views.names[0]
    assert "31.0 dB" in opened.locator("#hint").inner_text()
    assert opened.locator("#pair").is_visible()


def test_the_photograph_fades_in_over_the_surface(opened, shown):
    behind(opened, 4)
    opened.locator("#opacity").evaluate(
        "(slider) => { slider.value = 1; slider.dispatchEvent(new Event('input')); }"
    )
    drawn, taken = photograph_of(canvas(opened)), shown[2].views.images[4].movedim(0, -1)
    wanted = 255 * srgb_from_linear(taken.clamp(0, 1)).numpy()
    assert np.abs(drawn - wanted).mean() < 4


def test_the_page_is_usable_on_a_phone(browser, shown):
    context = browser.new_context(
        viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True
    )
    page = context.new_page()
    opening(page, shown[0])
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    for name in ("lit", "shape", "albedo", "normals", "whole surface"):
        button = page.get_by_role("button", name=name, exact=True)
        box = button.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["height"] >= 32
        button.tap()
    page.locator("#thumbnails button").first.tap()
    assert page.locator("#photo").is_visible()
    context.close()


def test_a_browser_without_webgl_still_shows_photographs_and_tables(browser, shown):
    blind = ["--disable-gpu", "--disable-3d-apis"]
    plain = browser.browser_type.launch(executable_path=CHROMIUM, args=blind)
    page = plain.new_page()
    page.goto(shown[0].as_uri())
    page.locator("#trouble").wait_for(state="visible")
    assert "cannot be drawn here" in page.locator("#trouble").inner_text()
    page.locator("#thumbnails button").first.click()
    page.locator("#prediction img").wait_for(state="visible")
    assert page.get_by_role("heading", name="Stages").is_visible()
    plain.close()
