"""Each check finds the introduced defects, and reports none in good photographs."""

import json
import math
import re

import pytest
import torch
from PIL import Image
from scenes import write_ball
from scipy.ndimage import gaussian_filter, uniform_filter1d

from pimper_torch.cli.doctor import cost as module
from pimper_torch.cli.doctor.checks import (
    blur,
    examine_views,
    exposure,
    number,
    saturation,
)
from pimper_torch.cli.doctor.cost import (
    DETAIL_PX,
    cost,
    estimate,
    megapixels_at,
    working_size,
)
from pimper_torch.cli.doctor.findings import available_gb, machine, total_gb
from pimper_torch.cli.doctor.pairs import match_copies, overlap
from pimper_torch.cli.doctor.photograph import Photograph, edge_blur_px, summarize, summarize_views
from pimper_torch.cli.main import main
from pimper_torch.io.photographs import load_views
from pimper_torch.stages.sfm.matching import VerifiedPair


def photograph(**changes):
    plain = Photograph(
        name="a.jpg",
        width=900,
        height=600,
        saturated=0.0,
        bright=0.6,
        blur_px=0.8,
        small=torch.zeros(2, 2),
    )
    return plain.replace(**changes)


def squares(side=400, cell=40):
    """Bright and dark squares, rotated for various edge orientations."""
    v, u = torch.meshgrid(torch.arange(side) + 0.5, torch.arange(side) + 0.5, indexing="ij")
    turned = torch.stack([0.9 * u + 0.4 * v, 0.9 * v - 0.4 * u])
    upright = torch.stack([u, v])
    where = torch.where(u > side / 2, turned, upright)
    return 0.2 + 0.6 * ((where // cell).sum(dim=0) % 2)


@pytest.mark.parametrize("sigma", [1.0, 2.0, 3.0])
def test_the_blur_of_edges_is_found_in_pixels(sigma):
    generator = torch.Generator().manual_seed(44)
    image = torch.from_numpy(gaussian_filter(squares().numpy(), sigma))
    noise = 0.003 * torch.randn(image.shape, generator=generator)
    # A pixel's area adds a twelfth to the variance; aliased edges add a little.
    assert edge_blur_px(image + noise) == pytest.approx(sigma, rel=0.15)


def test_motion_blur_is_measured_in_its_direction():
    moved = torch.from_numpy(uniform_filter1d(squares().numpy(), 9, axis=1))
    assert edge_blur_px(moved) > 2.0  # a box of 9 has a standard deviation of 2.6
    assert edge_blur_px(moved) == pytest.approx(edge_blur_px(moved.T.contiguous()), rel=0.1)
    assert edge_blur_px(squares()) < 0.6


def test_an_image_without_edges_has_no_blur_figure():
    assert math.isnan(edge_blur_px(torch.full((50, 50), 0.5)))
    assert blur([photograph(blur_px=math.nan)]) is None


def test_blurred_photographs_are_named():
    sharp = [photograph(name=f"{n}.jpg") for n in range(9)]
    found = blur([*sharp, photograph(name="moved.jpg", blur_px=2.4)])
    assert found.severity == "warning"
    assert "1 of 10 are blurred: moved.jpg (2.4 px)" in found.found
    assert blur(sharp).severity == blur([photograph(blur_px=2.5)] * 5).severity == "ok"


def test_saturated_and_dark_photographs_are_named():
    image = 0.3 * torch.rand(3, 40, 50, generator=torch.Generator().manual_seed(1))
    image[0, :4] = 1.0  # a tenth of the pixels, in one channel
    burnt = summarize("burnt.png", image)
    assert burnt.saturated == pytest.approx(0.1)
    assert "1 of 2 are partly saturated: burnt.png (10%)" in saturation([burnt, photograph()]).found
    mask = torch.zeros(40, 50, dtype=torch.bool)
    mask[4:] = True
    assert summarize("a", image, mask).saturated == 0
    dark = summarize("dark.png", 0.03 * torch.rand(3, 40, 50))
    assert dark.bright == pytest.approx(0.03, rel=0.05)
    assert "dark.png" in exposure([dark, photograph()]).found
    assert saturation([photograph()]).severity == exposure([photograph()]).severity == "ok"


def test_too_few_photographs_are_reported():
    assert number([photograph()] * 5).severity == "warning"
    assert number([photograph()] * 12).severity == "ok"


def test_photographs_without_matches_are_named():
    def match(*pair):
        return VerifiedPair(views=pair, first=torch.zeros(1, 2), second=torch.zeros(1, 2))

    names = ("a", "b", "c", "d")
    assert overlap(names, [match(0, 1), match(1, 2), match(2, 3)]).severity == "ok"
    found = overlap(names, [match(0, 1), match(1, 2)])
    assert found.severity == "warning"
    assert "1 of 4 are not connected to the rest: d" in found.found


# Megapixels, photographs, seconds, GB: benchmarks/README.md, "How cost grows"; and the demo.
RUNS = (
    *((4.8, 10, 80, 1.4), (14.4, 30, 204, 1.5), (19.2, 10, 133, 2.3), (57.6, 30, 292, 2.6)),
    (13.0, 24, 128, 1.6),
)


@pytest.mark.parametrize(("megapixels", "views", "seconds", "gigabytes"), RUNS)
def test_estimated_costs_are_within_half_of_measured_runs(megapixels, views, seconds, gigabytes):
    for found, measured in zip(estimate(megapixels, views), (seconds, gigabytes), strict=True):
        assert 1 / 1.5 < found / measured < 1.5


def test_memory_depends_on_the_surface_and_on_many_photographs():
    assert estimate(576.0, 300)[1] < 4 < estimate(576.0, 500)[1]
    large = [photograph(width=4000, height=3000)] * 30
    assert cost(large, 100.0).severity == cost(large, None).severity == "ok"
    assert "10.1 GB with `default`, an estimate; 8.0 GB are free" in cost(large, 8.0).found


PHONE, CAMERA = (4032, 3024), (6000, 4000)


@pytest.mark.parametrize("free_gb", [1.0, 2.2, 2.8, 3.5, 100.0, None])
@pytest.mark.parametrize("sizes_px", [[CAMERA] * 12, [PHONE] * 3 + [(4000, 6000)] * 30])
def test_the_working_size_is_the_largest_that_fits(sizes_px, free_gb, monkeypatch):
    monkeypatch.setattr(module, "available_gb", lambda: free_gb)
    chosen, _ = working_size(sizes_px, None)
    assert 600 <= chosen <= DETAIL_PX

    def fits(longest):
        needed = estimate(megapixels_at(sizes_px, longest), len(sizes_px))[1]
        return free_gb is None or needed <= 0.6 * free_gb

    assert fits(chosen) or chosen == 600
    assert chosen == DETAIL_PX or not fits(chosen + 100)


def test_a_given_working_size_or_limit_counts(monkeypatch):
    monkeypatch.setattr(module, "available_gb", lambda: 3.0)
    sizes_px = [CAMERA] * 12

    def size(*given):
        return working_size(sizes_px, *given)[0]

    assert [size(given) for given in (0, 77, 4000)] == [0, 77, 4000]
    assert size(None, 1.5) < size(None) < DETAIL_PX == size(None, 4.0)
    assert working_size([(900, 600)] * 9, None) == (DETAIL_PX, "")  # they fit, and none is shrunk


def test_memory_that_no_size_lowers_does_not_shrink(monkeypatch):
    monkeypatch.setattr(module, "available_gb", lambda: 2.0)
    assert working_size([CAMERA] * 500, None)[0] == DETAIL_PX  # depth maps of 500 views: 4.8 GB


def test_the_working_size_is_reported_if_it_shrinks():
    text = "photographs of up to 6000x4000 are shrunk to 1600 px (`--max-size-px`)"
    assert working_size([PHONE, CAMERA], 1600) == (1600, text)
    assert working_size([PHONE, CAMERA], 0)[1] == working_size([PHONE], 4032)[1] == ""
    assert text in cost([photograph()], None, text).found


def test_the_machine_is_described():
    found = {one.check: one for one in machine()}
    assert torch.__version__ in found["installed"].found
    assert f"{torch.get_num_threads()} threads" in found["device"].found
    if available_gb() is not None:
        assert 0 < available_gb() <= total_gb()


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Photographs of a ball."""
    folder = tmp_path_factory.mktemp("scenes")
    write_ball(folder / "ball.ply")
    small = "--num-views 5 --width 320 --height 240 --span-deg 25 --supersample 1 --processes 1 -q"
    assert main(["render", str(folder / "ball.ply"), "-o", str(folder / "a"), *small.split()]) == 0
    return folder / "a" / "photos"


def test_every_check_of_a_folder_reports_once(photos):
    found = {one.check: one for one in examine_views(load_views(photos), together=True)}
    assert found["overlap"].severity == "ok"
    checks = ["number", "blur", "saturation", "exposure", "overlap", "cost"]
    assert list(found) == checks
    assert [one.check for one in examine_views(load_views(photos))] == [*checks[:4], "cost"]


def test_large_photographs_are_examined_small_for_their_size_in_the_run(tmp_path, capsys):
    image = 255 * gaussian_filter(squares(2000, 160).numpy(), 6.0)
    for index in range(3):
        shifted = image[40 * index : 40 * index + 1500].round().astype("uint8")
        Image.fromarray(shifted).save(tmp_path / f"{index}.jpg", quality=95)
    assert main(["doctor", str(tmp_path), "--max-size-px", "0", "--json"]) == 0
    whole = found_in(capsys)
    assert main(["doctor", str(tmp_path), "--json"]) == 0
    shrunk = found_in(capsys)
    assert "3 of 2000x1500" in whole["number"]
    assert "3 of 1600x1200" in shrunk["number"]
    assert "of up to 2000x1500 are shrunk to 1600 px" in shrunk["cost"]
    assert "shrunk" not in whole["cost"]
    # Shrinking adds little to a blur of six pixels.
    assert number_in(whole["blur"]) == pytest.approx(6.0, rel=0.15)
    assert number_in(shrunk["blur"]) == pytest.approx(0.8 * number_in(whole["blur"]), abs=0.1)


def found_in(capsys):
    lines = map(json.loads, capsys.readouterr().out.splitlines())
    return {line["check"]: line["found"] for line in lines if line["event"] == "finding"}


def number_in(text):
    return float(re.search(r"[\d.]+(?= px)", text)[0])


def test_matches_are_of_the_same_points(photos):
    """All matches between a photograph and its shifted copy differ by the shift."""
    one = summarize_views(load_views(photos))[0]
    shifted = one.replace(small=one.small.roll((3, 5), dims=(0, 1)))
    (match,) = match_copies([one.small, shifted.small])
    assert len(match.first) > 50
    off = (match.second - match.first).median(dim=0).values
    torch.testing.assert_close(off, torch.tensor([5.0, 3.0]).to(off), atol=0.1, rtol=0)


def test_a_file_that_cannot_be_read_is_refused_as_by_a_run(photos, tmp_path, capsys):
    for path in sorted(photos.iterdir()):
        Image.open(path).save(tmp_path / path.name)
    (tmp_path / "broken.png").write_bytes(b"no image")
    assert main(["doctor", str(tmp_path)]) == 2
    assert "broken.png: is not a readable JPEG, PNG or TIFF image" in capsys.readouterr().err


def test_without_photographs_only_the_machine_is_examined(capsys):
    assert main(["doctor"]) == 0
    assert "threads" in capsys.readouterr().out
    assert main(["doctor", "nowhere"]) == 2
