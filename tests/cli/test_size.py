"""The real size of a result, from the command line to the files."""

import json
import re

import numpy as np
import pytest
import torch
from PIL import Image

import pimper_torch as pt
from pimper_torch.cli.main import main
from pimper_torch.cli.options import parse
from pimper_torch.cli.run import bars_in_files, scale_message
from pimper_torch.io.cameras.model_files import read_model
from pimper_torch.scale.marks import place_of

# The surface of the small result has a random confidence.
UNSURE = "ignore:.*hardly determine the surface:pimper_torch.runtime.errors.PimperWarning"
TURNED = {1: lambda picture: picture, 6: lambda picture: np.rot90(picture), 3: np.flip}


def saved(folder, orientation):
    """Write photographs twice as large as those of the result, with an EXIF orientation."""
    folder.mkdir()
    noise = np.random.default_rng(5).integers(0, 256, (80, 120), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    for name in "abcd":
        stored = np.ascontiguousarray(TURNED[orientation](noise))
        Image.fromarray(stored).save(folder / f"{name}.png", exif=exif)
    return folder


@pytest.fixture
def photos(tmp_path):
    return saved(tmp_path / "photos", 1)


def line(photos, out, *more):
    return ["reconstruct", str(photos), "-o", str(out), "--max-size-px", "60", *more]


@pytest.mark.filterwarnings(UNSURE)
@pytest.mark.parametrize("orientation", TURNED)
def test_marks_in_files_agree_with_marks_in_views(orientation, reconstruction, tmp_path):
    photos = saved(tmp_path / "photos", orientation)
    more = ["--max-size-px", "60", "--scale-bar", "a,55,40", "c.png,66,50+b,60,45", "80"]
    job = parse("reconstruct", [str(photos), "-o", "out", *more])
    views = pt.load_views(photos, max_size_px=60)
    assert views.sizes_px[0].tolist() == [60, 40]
    (bar,) = bars_in_files(job)
    assert bar.first.pointers[0].size_px == (120, 80)
    assert (str(bar.first), str(bar.second)) == ("a,55,40", "c.png,66,50+b,60,45")
    wanted = place_of(pt.Mark.read("a,27.5,20"), reconstruction)
    torch.testing.assert_close(place_of(bar.first, reconstruction), wanted)


@pytest.mark.filterwarnings(UNSURE)
@pytest.mark.usefixtures("chain")
def test_a_result_is_written_in_the_unit_of_its_scale_bar(photos, reconstruction, tmp_path):
    out = tmp_path / "out"
    bar = ["--scale-bar", "a,50,36", "b,70,44", "120", "--unit", "cm", "--faces", "all"]
    assert main(line(photos, out, *bar)) == 0
    message = json.loads((out / "summary.json").read_text())["scale"]
    job = parse("reconstruct", line(photos, out, *bar)[1:])
    (loaded,) = bars_in_files(job)
    ends = [place_of(mark, reconstruction) for mark in loaded.ends]
    factor = 120 / float((ends[0] - ends[1]).norm())
    assert message == {
        "factor": pytest.approx(factor),
        "unit": "cm",
        "source": "scale bars",
        "residual": None,
        "count": 1,
    }
    mesh = pt.read_mesh(out / "mesh.ply")
    wanted = factor * reconstruction.mesh.vertices_world
    torch.testing.assert_close(mesh.vertices_world, wanted.double(), rtol=1e-5, atol=1e-4)
    model = read_model(out / "sparse")
    pose = reconstruction.cameras.cam_from_world.double()
    torch.testing.assert_close(
        model.cam_from_world[:, :3, 3], factor * pose[:, :3, 3], rtol=1e-5, atol=1e-4
    )
    depth = np.load(out / "depth.npz")
    moved = factor * pose[1, :3, 3]
    np.testing.assert_allclose(depth["cam_from_world"][:3, 3], moved, rtol=1e-5, atol=1e-4)
    seen = depth["depth"][np.isfinite(depth["depth"])]
    assert 0.8 < np.median(seen) / (6 * factor) < 1.2  # the cameras are at distance 6


@pytest.mark.usefixtures("chain")
def test_without_a_reference_length_the_size_is_unknown(photos, tmp_path):
    assert main(line(photos, tmp_path / "out", "--stl")) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["scale"] is None
    assert any("its longest side in mesh.stl is 100 mm" in text for text in summary["warnings"])


@pytest.mark.usefixtures("chain")
@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--scale-bar", "a,500,40", "b,60,40", "8"], "is outside .* 120 x 80 pixels"),
        (
            ["--scale-bar", "a,60,40", "b,60,40", "wide"],
            "--scale-bar is 'a,60,40 b,60,40 wide'; needed: A,x,y B",
        ),
        (["--camera-distance", "a", "e", "8"], "'e': no photographs have this name"),
        (["--camera-distance", "a", "b", "x"], "--camera-distance is 'a b x'; needed: A B LENGTH"),
        (["--markers", "-3"], "markers is -3"),
        (["--markers", "some"], "--markers is 'some'; needed: auto.off.MM"),
    ],
)
def test_invalid_lengths_are_refused(more, message, photos, tmp_path, capsys):
    assert main(line(photos, tmp_path / "out", *more)) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert re.search(message, said), said
    assert not (tmp_path / "out" / "summary.json").exists()


@pytest.mark.parametrize(
    ("count", "message"),
    [
        (1, "Lengths are in m, by one camera distance."),
        (3, "Lengths are in m, by 3 camera distances, which agree to 0.12%."),
    ],
)
def test_the_source_of_the_scale_is_reported(count, message):
    scale = pt.Scale(factor=2.0, unit="m", source="camera distances", residual=0.0012, count=count)
    assert scale_message(scale) == message


def test_a_marker_sheet_is_replaced_only_on_request(tmp_path, capsys):
    sheet = tmp_path / "sheet.pdf"
    assert main(["markers", "-o", str(tmp_path / "sheet.png")]) == 2
    assert "needed: a name ending in .pdf" in capsys.readouterr().err
    assert main(["markers", "-o", str(sheet)]) == 0
    first = sheet.read_bytes()
    assert first.startswith(b"%PDF-")
    assert b"/MediaBox [ 0 0 595.27" in first  # 210 mm
    assert main(["markers", "-o", str(sheet)]) == 2
    assert main(["markers", "-o", str(sheet), "--overwrite"]) == 0
    assert sheet.read_bytes() == first
    sheet.write_text("of somebody else")
    assert main(["markers", "-o", str(sheet), "--overwrite"]) == 2
    assert "was not written by this command" in capsys.readouterr().err
    assert main(["markers", "-o", str(tmp_path / "b.pdf"), "--side-mm", "9"]) == 2
    assert "side_mm is 9; needed: 10 to 36 whole millimetres" in capsys.readouterr().err
