import math

import pytest
import torch

from pimper_bench.datasets import read_camera_file
from pimper_torch.runtime.errors import InputError, PimperWarning

# `hand_camera` from camera to chunk, row by row: columns are its right, down, forward, centre.
TRANSFORM = "0 0 1 -4 1 0 0 2 0 1 0 3 0 0 0 1"
# f + b1 = 20 along x, 30 along y; principal point (7, 5) of 16 x 12.
LENS = "<f>30</f><b1>-10</b1><cx>-1</cx><cy>-1</cy>"
XML = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="0" label="lens" type="frame"><resolution width="16" height="12"/>
<calibration type="frame" class="initial"><resolution width="16" height="12"/><f>7</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="16" height="12"/>{lens}</calibration>
</sensor></sensors>
<components next_id="1"><component id="0">{component}</component></components>
<cameras next_id="4"><group id="0" label="side">
<camera id="0" sensor_id="0" component_id="0" label="a"><transform>{transform}</transform></camera>
</group>
<camera id="1" sensor_id="0" component_id="0" label="b.png"{b}><transform>{transform}</transform>
</camera>
<camera id="2" sensor_id="0" label="c"/>
<camera id="3" sensor_id="0" component_id="0" label="c" enabled="false">
<transform>{transform}</transform></camera>
</cameras>{chunk}</chunk></document>
"""


@pytest.fixture
def save(tmp_path, paint):
    for name in ("a.png", "b.png"):
        paint(tmp_path / "images" / name, 100)

    def write(**pieces):
        defaults = {"kind": "frame", "lens": LENS, "transform": TRANSFORM}
        defaults |= {"component": "", "chunk": "", "b": ""}
        (tmp_path / "cameras.xml").write_text(XML.format(**(defaults | pieces)))
        return tmp_path

    return write


def test_the_transform_maps_the_camera_to_the_chunk(save, sees, hand_camera):
    capture = read_camera_file(save())
    assert capture.views.names == ("a.png", "b.png")  # `c` is not aligned, or disabled
    assert sees(capture) == pytest.approx([9, 11])
    assert torch.allclose(capture.cameras.cam_from_world[0], hand_camera)


@pytest.mark.parametrize("where", ["component", "chunk"])
def test_the_similarity_of_the_chunk_is_applied(save, where):
    # A quarter turn about z, twice the size, then a step.
    similarity = (
        "<transform><rotation>0 -1 0 1 0 0 0 0 1</rotation><translation>10 20 30</translation>"
        "<scale>2</scale></transform>"
    )
    cameras = read_camera_file(save(**{where: similarity})).cameras
    # The camera's centre (-4, 2, 3) maps to 2 (-2, -4, 3) + (10, 20, 30).
    assert cameras.centers_world[0].tolist() == pytest.approx([6, 12, 36])
    # Its forward, the chunk's x, is now the world's y.
    assert cameras.cam_from_world[0, 2, :3].tolist() == pytest.approx([0, 1, 0])


def test_a_skew_is_kept(save, sees):
    capture = read_camera_file(save(lens=LENS + "<b2>5</b2>"))
    assert sees(capture) == pytest.approx([10, 11])


POLYNOMIAL = 1 + 0.1 * 0.05 - 0.3 * 0.05**2 + 2 * 0.05**3
ANGLE = math.atan(math.sqrt(0.05))


@pytest.mark.parametrize(
    ("kind", "terms", "x", "y"),
    [
        (
            "frame",
            "<k1>0.1</k1><k2>-0.3</k2><k3>2</k3><p1>0.4</p1><p2>-0.5</p2>",
            0.1 * POLYNOMIAL + 0.4 * (0.05 + 2 * 0.01) - 2 * 0.5 * 0.02,
            0.2 * POLYNOMIAL - 0.5 * (0.05 + 2 * 0.04) + 2 * 0.4 * 0.02,
        ),
        (
            "fisheye",
            "<k1>0.1</k1><k4>3</k4>",
            0.1 / math.sqrt(0.05) * ANGLE * (1 + 0.1 * ANGLE**2 + 3 * ANGLE**8),
            0.2 / math.sqrt(0.05) * ANGLE * (1 + 0.1 * ANGLE**2 + 3 * ANGLE**8),
        ),
    ],
)
def test_the_distortion_model_is_that_of_the_manual(save, lens_of, kind, terms, x, y):
    at = lens_of(read_camera_file, save(kind=kind, lens=LENS + terms), 0.1, 0.2)
    assert at == pytest.approx([8 - 1 + 30 * x - 10 * x, 6 - 1 + 30 * y])


@pytest.mark.parametrize(
    ("pieces", "needed"),
    [
        ({"lens": LENS + "<k4>1</k4>"}, "a frame camera with f, b1, cx, cy, k4"),
        ({"lens": LENS + "<k1>1</k1><b2>1</b2>"}, "with f, b1, cx, cy, k1, b2"),
        ({"kind": "spherical"}, "a spherical camera"),
        ({"kind": "fisheye", "lens": LENS + "<p1>1</p1>"}, "a fisheye camera with"),
        ({"lens": ""}, "a positive f"),
        ({"lens": "<fx>20</fx><fy>30</fy>"}, "old PhotoScan"),
        ({"lens": "<f>wide</f>"}, "1 finite number as f"),
        ({"transform": "1 0 0"}, "16 finite numbers as transform of a"),
        ({"transform": TRANSFORM.replace("0 0 1 -4", "0 0 -1 -4")}, "a reflection"),
        ({"b": ' master_id="0"'}, "a camera of a rig"),
        ({"component": "<transform><scale>0</scale></transform>"}, "a positive scale"),
        ({"chunk": "<"}, "cannot be read as XML"),
    ],
)
def test_an_unknown_file_is_refused(save, pieces, needed):
    with pytest.raises(InputError, match=needed):
        read_camera_file(save(**pieces))


def test_several_chunks_with_cameras_are_refused(save):
    camera = '<camera sensor_id="0" label="z"><transform/></camera>'
    other = f'</chunk><chunk label="roof"><cameras>{camera}</cameras>'
    message = r"has 2 chunks: Chunk 1 \(2 cameras\), roof \(1 cameras\); needed: one.*Export the"
    with pytest.raises(InputError, match=message):
        read_camera_file(save(chunk=other))
    unaligned = other.replace("<transform/>", "")
    assert read_camera_file(save(chunk=unaligned)).views.names == ("a.png", "b.png")


def test_the_largest_of_several_components_is_read(save):
    third = f'<camera sensor_id="0" component_id="1" label="d"><transform>{TRANSFORM}</transform>'
    folder = save()
    text = (folder / "cameras.xml").read_text().replace("</cameras>", f"{third}</camera></cameras>")
    (folder / "cameras.xml").write_text(text)
    message = "2 components with separate frames. The component of 2 cameras is used, not that of 1"
    with pytest.warns(PimperWarning, match=message):
        assert read_camera_file(folder).views.names == ("a.png", "b.png")


def test_a_label_without_a_photograph_is_refused(save):
    folder = save()
    (folder / "images" / "a.png").unlink()
    with pytest.raises(InputError, match=r"one photograph named a.*b\.png"):
        read_camera_file(folder)


def test_entities_are_not_expanded(save):
    folder = save()
    bomb = '<!DOCTYPE document [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
    text = (folder / "cameras.xml").read_text().replace("?>", "?>" + bomb, 1)
    (folder / "cameras.xml").write_text(text.replace("Chunk 1", "&b;"))
    with pytest.raises(InputError, match="declares the document type document"):
        read_camera_file(folder)
