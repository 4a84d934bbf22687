"""The page in a browser: what it draws, under which light, and what it fetches."""

import base64
import re
import shutil
import time
from io import BytesIO
from itertools import pairwise

import numpy as np
import pytest
import torch
from PIL import Image
from scenes import trusted

from pimper_torch.geometry.visibility import visible_vertices
from pimper_torch.io.assets.gltf import MATTE, gltf_of
from pimper_torch.io.assets.placement import Placement, standing
from pimper_torch.io.assets.write import write_asset
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.radiometry.base_color import base_color
from pimper_torch.records import Materials, Relighting, ViewErrors
from pimper_torch.stages.relighting.held_out import predict
from pimper_torch.stages.texturing.bake import textured
from pimper_torch.viz.maps import view_maps
from pimper_torch.viz.report.openness import openness
from pimper_torch.viz.report.page import write_page
from pimper_torch.viz.report.predictions import predictions, view_images
from tests.relighting.ball import SIDE, ball_mesh, photographed

pytestmark = [pytest.mark.browser, pytest.mark.slow]
sync_api = pytest.importorskip("playwright.sync_api")

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
SOFTWARE = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LEFT_OUT = {"what": "points", "total": 90000, "reason": "without albedo", "names": []}
VIEW = {"name": "a.png", "psnr_db": 31.0, "psnr_matte_db": None}
GOOD = "Good: from 6 of 7 photographs."
SUMMARY = {
    "verdict": {"score": 0.7, "text": GOOD, "scores": {}},
    "diagnosis": None,
    "warnings": ["Lower `factorize.min_views`, or `--masks` and <b>bold</b>."],
    "seconds": 150.4,
    "peak_memory_mb": 900.0,
    "peak_memory_stage": "warp",
    "registered": 6,
    "views": 7,
    "triangles": 2999,
    "vertices": 560140,
    "simplified": {"vertices": 83045, "faces": 166000},
    "stages": [
        {"name": "warp", "seconds": 8.0, "peak_memory_mb": 500.0, "kept": False, "samples": 12345},
        {"name": "fuse", "seconds": 4.0, "peak_memory_mb": 900.0, "kept": False, "missing": None},
        {"name": "sweep", "seconds": 90.0, "peak_memory_mb": 800.0, "kept": True},
    ],
    "left_out": [
        {**LEFT_OUT, "guard": "fuse.albedo", "count": 45000},
        {**LEFT_OUT, "guard": "repair", "count": 0},
    ],
    "failures": [
        {
            "stage": "fuse",
            "what": "patch",
            "names": ["3", "5"],
            "reason": "no light",
            "done": "left",
        }
    ],
    "relighting": {
        "photographs": "held out",
        "psnr_db": 31.0,
        "psnr_matte_db": 29.0,
        "views": [VIEW],
        "materials": [{"vertices": 1.0, "metallic": 0.0, "roughness": 0.35, "specular": 1.2}],
    },
}
LIGHT = [0.3, 0.1, -0.2, 0.4]
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
    worth = ViewErrors(
        psnr_db=torch.full((scene.views.num_views,), 31.0), lights=lights, names=scene.views.names
    )
    relighting = Relighting(
        lights=lights, materials=materials, errors=worth, matte=worth, held_out=False
    )
    folder = tmp_path_factory.mktemp("page")
    asset = textured(mesh, mesh, materials.at_vertices())
    # The page reverts the file's transform: upright, with longest side 1.
    placed = standing(asset.mesh, scene.cameras, 1, torch.tensor([0.0, 0.0, 1.0]), None)
    write_asset(asset, folder / "asset.glb", Placement(name="ball", scene_from_asset=placed))
    views = scene.views.num_views
    across = torch.arange(SIDE) + 0.5 - SIDE / 2
    y, x = torch.meshgrid(across, across, indexing="ij")
    inside = (torch.hypot(x, y) < 0.41 * SIDE).float().expand(views, SIDE, SIDE)
    lights_world = torch.tensor([[torch.nan] * 4, *[LIGHT] * 5])
    parts = {
        "title": "ball",
        "mesh": mesh,
        "asset": (folder / "asset.glb").read_bytes(),
        "openness": openness(asset.mesh),
        "seen": visible_vertices(asset.mesh, scene.cameras).any(dim=0),
        "scene": scene,
        "silhouettes": (silhouettes := trusted(inside, "found")),
        "reference": 0,
        "images": view_images(scene, silhouettes, predictions(mesh, scene, relighting)),
        "summary": SUMMARY,
        "settings": {"zeta": 0.5, "fuse": {"terms": ["normals"]}},
    }
    write_page(folder / "report.html", **parts, lights_world=lights_world)
    quiet = {**SUMMARY, "left_out": [], "failures": [], "warnings": [], "relighting": None}
    parts["summary"] = quiet | {"simplified": None, "scale": {"unit": "mm"}, "verdict": None}
    parts["summary"] |= {"diagnosis": "The cameras only rotated."}
    write_page(folder / "plain.html", **parts)
    text = "Not usable: The cameras only rotated."
    verdict = {"score": 0.0, "text": text}
    parts["summary"] |= {"verdict": verdict, "warnings": [text, "Dark.", "Dark."]}
    write_page(folder / "bad.html", **parts)
    vertices, faces = mesh.vertices_world.numpy(), mesh.faces.flip(1).numpy()
    inside_out = gltf_of({"POSITION": vertices, "NORMAL": vertices}, faces, MATTE)
    parts |= {"asset": inside_out, "openness": openness(mesh), "mesh": mesh}
    parts["seen"] = visible_vertices(mesh, scene.cameras).any(dim=0)
    write_page(folder / "inside_out.html", **parts)
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
    """Open the page in a window; record its errors and requests."""
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
    """Return the canvas without its overlays, once drawing is finished."""
    page.add_style_tag(content="#lamp, #legend { opacity: 0; }")
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done, 60)))")
    return pixels(page.locator("#stage").screenshot())


def pixels(data):
    return np.asarray(Image.open(BytesIO(data)).convert("RGB")).astype(float)


def behind(page, view):
    page.locator("#thumbnails button").nth(view).click()


def photograph_of(picture):
    """Return the middle square of the canvas, at the size of the photographs."""
    height, width = picture.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    square = Image.fromarray(picture[top : top + side, left : left + side].astype(np.uint8))
    return np.asarray(square.resize((SIDE, SIDE), Image.Resampling.BOX)).astype(float)


def inner(scene, mesh, view):
    """Return the pixels of the ball, except at its border."""
    seen = view_maps(mesh, scene.cameras, view).seen
    return (-torch.nn.functional.max_pool2d(-seen[None].float(), 5, 1, 2)[0] > 0).numpy()


@pytest.mark.parametrize("view", [0, 2])
def test_albedo_is_drawn_as_by_our_renderer(opened, shown, view):
    _, mesh, scene, _, _ = shown
    choose(opened, "albedo")
    behind(opened, view)
    drawn = photograph_of(canvas(opened))
    colored = mesh.replace(albedo=base_color(mesh))
    wanted = srgb_from_linear(view_maps(colored, scene.cameras, view).albedo).numpy() * 255
    inside = inner(scene, mesh, view)
    assert np.abs(drawn - wanted)[inside].mean() < 3
    assert np.abs(drawn - wanted)[inside].max() < 40  # interpolation between texels


def test_normals_have_the_colours_of_our_images(opened, shown):
    _, mesh, scene, _, _ = shown
    choose(opened, "normals")
    behind(opened, 1)
    drawn = photograph_of(canvas(opened)) / 255
    normals = view_maps(mesh, scene.cameras, 1).normals_cam.numpy() * [1, -1, -1]
    inside = inner(scene, mesh, 1)
    assert np.abs(drawn - 0.5 - 0.5 * normals)[inside].mean() < 0.01


def test_a_photograph_is_rendered_under_its_fitted_light(opened, shown):
    """The page's renderer and ours share the reflectance and light models."""
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
    # The page's renderer subtracts mirrored ambient light from the diffuse part: 2 levels.
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


def test_the_surface_rotates_with_the_pointer(opened):
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
    print(f"turns at {rate:.0f} frames a second, drawn by software")  # noqa: T201 - a figure for the reader
    assert rate > 1
    assert np.abs(canvas(opened) - before).mean() > 2


def test_layers_of_numbers_have_a_legend(opened):
    choose(opened, "expected error")
    assert opened.locator("#legend").is_visible()
    assert "% of the object's size or more" in opened.locator("#high").inner_text()
    low, high = canvas(opened).reshape(-1, 3).min(axis=0), canvas(opened).reshape(-1, 3).max(axis=0)
    assert (high - low).max() > 100


def test_a_click_on_a_camera_moves_the_viewpoint_there(opened, shown):
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
    assert opened.locator("#compared").is_visible()


def test_the_photograph_fades_in_over_the_surface(opened, shown):
    behind(opened, 4)
    opened.locator("#opacity").evaluate(
        "(slider) => { slider.value = 1; slider.dispatchEvent(new Event('input')); }"
    )
    drawn, taken = photograph_of(canvas(opened)), shown[2].views.images[4].movedim(0, -1)
    wanted = 255 * srgb_from_linear(taken.clamp(0, 1)).numpy()
    assert np.abs(drawn - wanted).mean() < 4


def pressed(page):
    """Return the names of the selected photographs."""
    return page.locator("#thumbnails button[aria-pressed=true] span").all_inner_texts()


def test_keys_and_buttons_step_through_photographs(opened, shown):
    names = shown[2].views.names
    press = opened.keyboard.press
    found = []
    for key in ("ArrowRight", "ArrowRight", "ArrowLeft", "ArrowLeft", "ArrowRight", "Escape"):
        press(key)
        found.append(pressed(opened))
    assert found == [[names[at]] for at in (0, 1, 0, 5, 0)] + [[]]
    opened.get_by_role("button", name="previous photograph").click()
    assert pressed(opened) == [names[5]]
    opened.get_by_role("button", name="next photograph").click()
    assert pressed(opened) == [names[0]]
    for control in ("#lamp", "#ambient"):  # these use arrow keys themselves
        opened.locator(control).focus()
        press("ArrowRight")
        assert pressed(opened) == [names[0]]
    press("Alt+ArrowRight")  # a shortcut of the browser
    assert pressed(opened) == [names[0]]
    opened.locator("#thumbnails button").first.focus()
    press("ArrowRight")
    assert opened.evaluate("document.activeElement.innerText") == names[1]


def test_keys_step_through_photographs_after_a_slider_was_touched(opened, shown):
    names, press = shown[2].views.names, opened.keyboard.press
    opened.locator("#ambient").click()
    press("ArrowRight")
    assert pressed(opened) == [names[0]]
    opened.locator("#opacity").click()
    press("ArrowRight")
    assert pressed(opened) == [names[1]]
    opened.get_by_label("lights").check()  # a checkbox has no use for arrow keys
    press("ArrowRight")
    assert pressed(opened) == [names[2]]
    for control in ("#ambient", "#lamp"):  # Escape returns the arrow keys
        opened.locator(control).focus()
        press("Escape")
        assert pressed(opened) == []
        press("ArrowRight")
        assert pressed(opened) == [names[0]]


def test_the_focus_ring_is_shown_only_for_keys(opened):
    outline = "getComputedStyle(document.getElementById('lamp')).outlineStyle"
    opened.locator("#lamp").click()
    assert opened.evaluate("document.activeElement.id") == "lamp"
    assert opened.evaluate(outline) == "none"
    opened.keyboard.press("Tab")
    opened.keyboard.press("Shift+Tab")
    assert opened.evaluate("document.activeElement.id") == "lamp"
    assert opened.evaluate(outline) == "solid"
    radius = "getComputedStyle(document.getElementById('lamp')).borderRadius"
    assert opened.evaluate(radius) == "50%"


def test_photograph_prediction_and_difference_are_in_one_row_with_decibels(opened):
    behind(opened, 1)
    boxes = [one.bounding_box() for one in opened.locator("#figures figure").all()]
    assert len(boxes) == 3
    assert len({box["y"] for box in boxes}) == 1
    assert boxes[0]["x"] < boxes[1]["x"] < boxes[2]["x"]
    assert boxes[0]["y"] + boxes[0]["height"] <= 800  # visible together with the surface
    words = opened.locator("#worth").inner_text()
    assert words.startswith("31.0 dB (PSNR): the prediction is off by 7.2 of 255 (root")
    assert words.endswith("number 1 of 6.")


def linear(picture):
    level = picture / 255
    return np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)


def first_order(scene, mesh, view, even, along):
    """Return the irradiance of a first-order light at the pixels of a view."""
    normals_cam = view_maps(mesh, scene.cameras, view).normals_cam
    normals = normals_cam @ scene.cameras.cam_from_world[view, :3, :3]
    return (even + normals @ torch.tensor(along)).clamp_min(0).numpy()


def test_the_shape_is_grey_under_a_sky_that_is_brighter_at_the_top(opened, shown):
    _, mesh, scene, _, _ = shown
    choose(opened, "shape")
    behind(opened, 1)
    opened.get_by_label("lamp").uncheck()
    inside = inner(scene, mesh, 1)
    drawn = linear(photograph_of(canvas(opened)))
    up = [0.0, 0.0, 1.0]  # axis of the ring of cameras
    grey, ambient = linear(np.array(0xB8)), 0.3
    wanted = grey * ambient * first_order(scene, mesh, 1, 1.0, [0.6 * one for one in up])
    assert np.abs(drawn - wanted[..., None])[inside].mean() < 0.01
    assert drawn[inside].max() > 2 * drawn[inside].min()  # not a flat cut-out


def test_ambient_occlusion_darkens_hollows(opened, shown, tmp_path):
    _, mesh, scene, _, _ = shown
    page = shown[0].read_text(encoding="utf-8")
    open_to = re.search(r'"openness": "([^"]*)"', page)[1]
    half = base64.b64encode(bytes([128]) * len(base64.b64decode(open_to))).decode()
    (tmp_path / "half.html").write_text(page.replace(open_to, half), encoding="utf-8")
    inside, found = inner(scene, mesh, 1), []
    for path in (shown[0], tmp_path / "half.html"):
        opening(opened, path)
        choose(opened, "shape")
        behind(opened, 1)
        opened.get_by_label("lamp").uncheck()
        found.append(linear(photograph_of(canvas(opened)))[inside].mean())
    opened.asked[:] = opened.asked[:1]
    assert found[1] / found[0] == pytest.approx(128 / 255, abs=0.01)


def test_the_lamp_of_the_shape_is_the_same_for_every_photograph(opened):
    bulb = opened.locator("#lamp .bulb")
    places = []
    for layer in ("shape", "lit"):
        choose(opened, layer)
        for view in (0, 3):
            behind(opened, view)
            canvas(opened)
            places.append((bulb.get_attribute("cx"), bulb.get_attribute("cy")))
    assert places[0] == places[1]
    assert places[2] != places[3]


def bulb(page):
    """Return the place of the lamp in its disc, y upwards."""
    canvas(page)
    point = page.locator("#lamp .bulb")
    return np.array([float(point.get_attribute("cx")), -float(point.get_attribute("cy"))])


# The place of the lamp in its disc, once it is elsewhere than before.
MOVED = """([x, y]) => {
  const { cx, cy } = document.querySelector("#lamp .bulb");
  const place = [cx.baseVal.value, -cy.baseVal.value];
  return Math.hypot(place[0] - x, place[1] - y) > 0.05 && place;
}"""


def test_the_shape_opens_under_raking_light(opened):
    lit = bulb(opened)
    choose(opened, "shape")
    assert 0.9 < np.linalg.norm(bulb(opened)) < 1
    opened.locator("#lamp").click()
    assert np.linalg.norm(bulb(opened)) < 0.1
    choose(opened, "lit")
    np.testing.assert_array_equal(bulb(opened), lit)


def test_the_lamp_orbits_until_it_is_moved(opened):
    choose(opened, "shape")
    button = opened.get_by_role("button", name="lamp orbits")
    places = [bulb(opened)]
    button.click()
    for _ in range(2):
        moved = opened.wait_for_function(MOVED, arg=places[-1].tolist())
        places.append(np.array(moved.json_value()))
    radii = [np.linalg.norm(place) for place in places]
    np.testing.assert_allclose(radii, radii[0], atol=1e-6)
    turns = [np.cross(first, second) for first, second in pairwise(places)]
    assert max(turns) < -0.03  # clockwise
    opened.locator("#lamp").click()
    assert button.get_attribute("aria-pressed") == "false"
    still = bulb(opened)
    opened.wait_for_timeout(300)
    np.testing.assert_array_equal(bulb(opened), still)
    choose(opened, "normals")
    assert not button.is_visible()


def hatched(page, shown, path):
    """Return the pixels of view 1's albedo on a page, over those of the page of the ball."""
    found = []
    for place in (shown[0], path):
        opening(page, place)
        choose(page, "albedo")
        behind(page, 1)
        drawn, side = canvas(page), page.locator("#stage").bounding_box()
        width, height = int(side["width"]), int(side["height"])
        middle = drawn[height // 2 - 40 : height // 2 + 40, width // 2 - 40 : width // 2 + 40]
        found.append(linear(middle).reshape(-1, 3))
    page.asked[:] = page.asked[:1]
    return found


def test_what_no_photograph_shows_is_hatched(opened, shown, tmp_path):
    page = shown[0].read_text(encoding="utf-8")
    seen = re.search(r'"seen": "([^"]*)"', page)[1]
    none = base64.b64encode(bytes(len(base64.b64decode(seen)))).decode()
    (tmp_path / "unseen.html").write_text(page.replace(seen, none), encoding="utf-8")
    plain, drawn = hatched(opened, shown, tmp_path / "unseen.html")
    unchanged = np.abs(drawn - plain).max(axis=1) < 0.01
    assert 0.4 < unchanged.mean() < 0.6
    assert (drawn[~unchanged] < 0.7 * plain[~unchanged] + 0.01).mean() > 0.9


def test_the_inside_is_hatched_in_grey(opened, shown):
    _, drawn = hatched(opened, shown, shown[0].with_name("inside_out.html"))
    assert np.abs(drawn - drawn.mean(axis=1, keepdims=True)).max() < 0.01
    levels, counts = np.unique((255 * drawn[:, 0]).round(), return_counts=True)
    two = np.sort(counts)[-2:].sum()
    assert two > 0.75 * len(drawn)  # the others are at the stripes' borders
    assert len(levels) > 1


def test_the_environment_is_the_first_order_light_of_the_photograph(opened, shown):
    _, mesh, scene, _, _ = shown
    behind(opened, 2)
    opened.get_by_label("environment").check()
    assert not opened.get_by_label("lamp").is_checked()
    assert not opened.locator("#lamp").is_visible()
    strength = LIGHT[0] + np.linalg.norm(LIGHT[1:])  # scaled to a maximum of 1
    shading = first_order(scene, mesh, 2, LIGHT[0], LIGHT[1:]) / strength
    colored = mesh.replace(albedo=base_color(mesh))
    wanted = view_maps(colored, scene.cameras, 2).albedo.numpy() * shading[..., None]
    inside = inner(scene, mesh, 2)
    own = linear(photograph_of(canvas(opened)))
    # The page's renderer subtracts mirrored ambient light from the diffuse part.
    assert np.abs(own - wanted)[inside].mean() < 0.02
    behind(opened, 0)  # has no light: the mean is used
    before = canvas(opened)
    opened.get_by_label("lamp").check()  # in addition
    assert (canvas(opened) - before).mean() > 2


def on_stage(page, x, y):
    """Return the place in the window of a pixel of the selected photograph."""
    stage = page.locator("#canvas").bounding_box()
    side = min(stage["width"], stage["height"])
    left = stage["x"] + (stage["width"] - side) / 2
    top = stage["y"] + (stage["height"] - side) / 2
    return left + x * side / SIDE, top + y * side / SIDE


def on_ball(scene, x, y):
    """Return the point of the ball at a pixel of view 0."""
    pose = scene.cameras.cam_from_world[0].double()
    camera = scene.cameras.intrinsics[0].double()
    ray = pose[:3, :3].mT @ torch.linalg.inv(camera) @ torch.tensor([x, y, 1.0]).double()
    ray, eye = ray / ray.norm(), scene.cameras.centers_world[0].double()
    along = -ray @ eye
    return eye + (along - (along**2 - eye @ eye + 1).sqrt()) * ray


def test_two_clicks_measure_a_distance(opened, shown):
    scene = shown[2]
    behind(opened, 0)
    choose(opened, "measure")
    measured = opened.locator("#measured")
    assert measured.inner_text() == "Click the first point on the surface."

    def click(x, y):
        """Click a pixel of the photograph; return the point of the ball."""
        opened.mouse.click(*on_stage(opened, x, y))
        return on_ball(scene, x, y)

    click(2.0, 2.0)  # beside the ball
    assert measured.inner_text() == "Click the first point on the surface."
    first = click(30.0, 40.0)
    assert measured.inner_text() == "Click the second point on the surface."
    second = click(52.0, 31.0)
    wanted = 100 * float((first - second).norm()) / (2 * 3**0.5)
    value, _, unit = measured.inner_text().partition(" ")
    assert float(value) == pytest.approx(wanted, rel=0.02)  # clicks are integer pixels
    assert unit == "% of the object's size"
    assert len(pressed(opened)) == 1  # no camera was clicked
    click(30.0, 40.0)  # begins anew
    assert measured.inner_text() == "Click the second point on the surface."
    choose(opened, "measure")
    assert not measured.is_visible()


def draw_line(page, start, end):
    page.mouse.move(*on_stage(page, *start))
    page.mouse.down()
    page.mouse.move(*on_stage(page, *end), steps=3)
    page.mouse.up()


def test_a_drawn_line_gives_the_profile_of_the_surface(opened, shown):
    """The section through the middle of a ball is a circle."""
    scene = shown[2]
    behind(opened, 0)
    choose(opened, "measure")
    choose(opened, "profile")  # replaces it
    measured, graph = opened.locator("#measured"), opened.locator("#graph")
    assert measured.inner_text() == "Draw a line over the surface."
    assert opened.locator("#measure").get_attribute("aria-pressed") == "false"
    assert not graph.is_visible()
    draw_line(opened, (28.0, 30.0), (52.0, 50.0))  # through the middle
    assert pressed(opened) == [scene.views.names[0]]  # the view does not turn
    chord = float((on_ball(scene, 28.0, 30.0) - on_ball(scene, 52.0, 50.0)).norm())
    height, scaled = 1 - (1 - chord**2 / 4) ** 0.5, 100 / (2 * 3**0.5)
    value, _, words = measured.inner_text().partition(" ")
    assert float(value) == pytest.approx(scaled * chord, rel=0.02)
    assert words == "% of the object's size from end to end"
    high, low, left, right = (float(one) for one in graph.locator("text").all_text_contents())
    assert (high, low) == (pytest.approx(scaled * height, rel=0.05), pytest.approx(0, abs=0.01))
    assert (left, right) == (pytest.approx(0, abs=1e-6), pytest.approx(scaled * chord, rel=0.02))
    path = graph.locator(".curve").get_attribute("d")
    points = np.array(re.findall(r"[ML]([\d.e-]+) ([\d.e-]+)", path)).astype(float)
    assert path.count("M") == 1
    across = chord * ((points[:, 0] - 52) / 224 - 0.5)
    circle = (1 - across**2) ** 0.5 - (1 - chord**2 / 4) ** 0.5
    assert np.abs((98 - points[:, 1]) / 90 * height - circle).max() < 0.02 * height
    draw_line(opened, (2.0, 2.0), (10.0, 2.0))
    assert measured.inner_text() == "The line misses the surface."
    assert not graph.is_visible()
    choose(opened, "profile")
    assert not measured.is_visible()


def test_the_view_is_saved_as_a_picture(opened, tmp_path):
    behind(opened, 0)
    choose(opened, "albedo")
    drawn = canvas(opened)
    with opened.expect_download() as download:
        choose(opened, "save picture")
    assert download.value.suggested_filename == "ball.png"
    download.value.save_as(tmp_path / "ball.png")
    saved = np.asarray(Image.open(tmp_path / "ball.png").convert("RGBA")).astype(float)
    assert saved.shape[:2] == drawn.shape[:2]
    opaque = saved[..., 3] == 255
    assert 0.05 < opaque.mean() < 0.6
    assert np.abs(saved[..., :3] - drawn)[opaque].mean() < 1
    assert saved[0, 0, 3] == 0


def test_the_surface_is_saved_in_the_frame_of_the_mesh(opened, shown, tmp_path):
    with opened.expect_download() as download:
        choose(opened, "save mesh")
    assert download.value.suggested_filename == "ball.ply"
    download.value.save_as(tmp_path / "ball.ply")
    saved, own = read_mesh(tmp_path / "ball.ply"), shown[1]
    assert len(saved.vertices_world) == len(own.vertices_world)  # without the texture's cuts
    assert len(saved.faces) == len(own.faces)
    assert set(map(tuple, saved.vertices_world.mul(1e4).round().int().tolist())) == set(
        map(tuple, own.vertices_world.mul(1e4).round().int().tolist())
    )
    a, b, c = saved.vertices_world[saved.faces].unbind(dim=1)
    assert (torch.linalg.cross(b - a, c - a) * a).sum(dim=1).min() > 0
    assert saved.normals_world is not None
    assert (saved.normals_world - saved.vertices_world).abs().max() < 0.05


def ball_pixels(picture):
    """Count the coloured pixels in the middle of the canvas."""
    height, width = picture.shape[:2]
    square = picture[height // 4 : -height // 4, (width - height // 2) // 2 :][:, : height // 2]
    return int((square.max(axis=-1) - square.min(axis=-1) > 30).sum())


def test_with_cameras_the_surface_fills_a_third_of_the_canvas(opened):
    choose(opened, "albedo")
    height = opened.locator("#stage").bounding_box()["height"]
    opened.get_by_label("cameras").check()
    drawn = canvas(opened)
    count = ball_pixels(drawn)
    assert count > 0.9 * np.pi / 4 * (height / 3) ** 2
    opened.get_by_label("cameras").uncheck()
    assert np.abs(canvas(opened) - drawn).mean() > 2


def test_the_viewer_fills_the_screen(opened):
    choose(opened, "full screen")
    full = "document.fullscreenElement && document.fullscreenElement.id"
    opened.wait_for_function(full)
    assert opened.evaluate(full) == "viewer"
    box = opened.locator("#stage").bounding_box()
    assert box["width"] > 0.95 * opened.evaluate("innerWidth")
    assert box["height"] > 0.7 * opened.evaluate("innerHeight")
    choose(opened, "full screen")
    opened.wait_for_function("!document.fullscreenElement")


def cells(page, title):
    """Return the rows of a section's table as texts."""
    section = page.locator("#sections > *", has_text=title).first
    return [row.locator("td, th").all_text_contents() for row in section.locator("tr").all()]


def test_headline_and_tables_agree(opened):
    assert opened.locator("#headline").inner_text() == (
        "6 of 7 photographs, 2,999 facets, 83,045 vertices in mesh.ply (560,140 before "
        "simplification), 150 s"
    )
    assert opened.locator("details[open]").count() == 0
    opened.locator("summary", has_text="Stages").click()
    assert opened.get_by_text("150 s up to this page, at most 900 MB, in warp").is_visible()
    assert cells(opened, "Stages")[1:] == [
        ["warp", "8.0", "", "500", "samples 12,345"],
        ["fuse", "4.0", "", "900", ""],
        ["sweep", "kept", "", "800", ""],  # its time belongs to a former run
    ]
    bars = opened.locator("td.bar i").evaluate_all("(all) => all.map((one) => one.style.width)")
    assert bars == ["100%", "50%", "0%"]
    assert opened.locator("li").inner_text() == SUMMARY["warnings"][0].replace("`", "")
    assert opened.locator("li code").all_inner_texts() == ["factorize.min_views", "--masks"]
    assert cells(opened, "Left out")[1:] == [
        ["Pass 1"],
        ["fuse.albedo", "45,000", "90,000", "points", "without albedo"],
    ]
    assert cells(opened, "Failed")[1:] == [["fuse", "patch 3, 5", "no light", "left"]]
    assert cells(opened, "Settings")[1:] == [["zeta", "0.5"], ["fuse"], ["terms", '["normals"]']]
    assert cells(opened, "Photographs predicted")[1:] == [
        ["mean", "31.00", "29.00", ""],
        ["a.png", "31.00", "", ""],
    ]
    predicted = opened.locator("details", has_text="Photographs predicted")
    assert "held out of the run" in predicted.locator("p").text_content()
    assert "roughness 0.35" in predicted.locator("p").text_content()


def test_sections_without_content_are_omitted(opened, shown):
    opening(opened, shown[0].with_name("plain.html"))
    opened.asked[:] = opened.asked[:1]
    titles = opened.locator("#sections h2, #sections summary").all_inner_texts()
    assert titles == ["Warnings", "Stages", "Settings"]
    headline = opened.locator("#headline").inner_text()
    assert headline.startswith("6 of 7 photographs (cameras unreliable), ")
    assert "560,140 vertices, 150 s" in headline
    assert opened.locator("li").inner_text() == "The cameras only rotated."
    assert not opened.get_by_label("environment").is_visible()
    choose(opened, "expected error")
    assert opened.locator("#high").inner_text().endswith(" mm or more")


def test_the_verdict_is_above_everything(opened):
    words = opened.get_by_text(GOOD)
    assert words.count() == 1
    below = [opened.locator(one).bounding_box()["y"] for one in ("header", "#stage")]
    assert words.bounding_box()["y"] + words.bounding_box()["height"] <= min(below)


def test_each_sentence_is_said_once(opened, shown):
    opening(opened, shown[0].with_name("bad.html"))
    opened.asked[:] = opened.asked[:1]
    assert opened.get_by_text("The cameras only rotated.").count() == 1
    assert opened.locator("#verdict.doubtful").inner_text().startswith("Not usable: The cameras")
    assert opened.locator("li").all_inner_texts() == ["Dark."]


@pytest.fixture
def phone(browser, shown):
    context = browser.new_context(
        viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True
    )
    page = context.new_page()
    opening(page, shown[0])
    yield page
    context.close()


def test_the_page_is_usable_on_a_phone(phone):
    for name in ("lit", "shape", "albedo", "normals", "whole surface", "measure", "full screen"):
        button = phone.get_by_role("button", name=name, exact=True)
        box = button.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390
        assert box["height"] >= 32
    for details in phone.locator("details summary").all():
        details.tap()
    assert phone.evaluate("document.documentElement.scrollWidth") <= 390


def test_the_surface_stays_visible_on_a_phone(phone):
    phone.locator("#thumbnails button").nth(1).evaluate("(one) => one.scrollIntoView()")
    phone.locator("#thumbnails button").nth(1).tap()
    assert phone.locator("#photo").is_visible()
    stage, row = (phone.locator(one).bounding_box() for one in ("#stage", "#figures"))
    assert stage["y"] >= 0
    assert 0.3 * 844 < stage["height"] < 0.5 * 844
    assert row["y"] >= stage["y"] + stage["height"]  # visible together with it
    assert row["y"] + row["height"] <= 844


def test_a_phone_is_not_told_of_arrow_keys(phone, opened):
    assert "arrow keys" in opened.locator("body").inner_text()
    assert "arrow keys" not in phone.locator("body").inner_text()


def test_figures_of_a_stage_are_below_it_on_a_phone(phone):
    phone.locator("summary", has_text="Stages").tap()
    row = phone.locator("tr", has_text="samples 12,345")
    name, figures = (row.locator(kind).bounding_box() for kind in ("td.name", "td.text"))
    assert figures["y"] >= name["y"] + name["height"]
    assert figures["x"] + figures["width"] <= 390


def test_a_browser_without_webgl_still_shows_photographs_and_tables(browser, shown):
    blind = ["--disable-gpu", "--disable-3d-apis"]
    plain = browser.browser_type.launch(executable_path=CHROMIUM, args=blind)
    page = plain.new_page()
    page.goto(shown[0].as_uri())
    page.locator("#trouble").wait_for(state="visible")
    assert "cannot be drawn" in page.locator("#trouble").inner_text()
    page.locator("#thumbnails button").first.click()
    page.locator("#prediction img").wait_for(state="visible")
    assert page.get_by_text("Stages", exact=True).is_visible()
    plain.close()
