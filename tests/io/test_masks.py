"""Masks of photographs: their names, polarity and orientation."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from photographs import save_image as save
from PIL import Image

from pimper_torch.io.decode import rotated
from pimper_torch.io.photographs import load_views, read_mask
from pimper_torch.runtime.errors import InputError, PimperWarning

NAMES = ("1", "2", "10")


def box(value=255):
    drawn = np.zeros((8, 12), dtype=np.uint8)
    drawn[2:5, 3:9] = value
    return drawn


def in_alpha(bright=0):
    """Return RGBA that is opaque on the object, and black, or bright in part of it."""
    drawn = np.zeros((8, 12, 4), dtype=np.uint8)
    drawn[2:5, 3:9, 3], drawn[2:5, 3:6, :3] = 255, bright
    return drawn


SHOWN, FULL = box() > 0, np.pad(np.zeros((2, 3), bool), ((0, 6), (0, 9)), constant_values=True)
PART = SHOWN & (np.arange(12) < 6)
COLOUR = np.stack([box(0), box(200), box(1)], axis=-1)


@pytest.mark.parametrize(
    ("masks", "wanted"),
    [
        ({"1.png": box(1), "2.tif": box(), "10.png.png": COLOUR}, [SHOWN] * 3),
        ({f"{name}_mask.png": box() for name in NAMES}, [SHOWN] * 3),
        ({f"{name}.png": in_alpha() for name in NAMES}, [SHOWN] * 3),
        (
            {"1.png": in_alpha(), "2.png": in_alpha(bright=255), "10.png": in_alpha()},
            [SHOWN, PART, SHOWN],
        ),
        # An object that fills its photographs is also bright along their borders.
        ({f"{name}.png": FULL.astype(np.uint8) * 255 for name in NAMES}, [FULL] * 3),
    ],
)
def test_masks_are_found_by_name_and_mark_bright_or_opaque_pixels(photos, tmp_path, masks, wanted):
    for name, array in masks.items():
        save(tmp_path / "masks" / name, array)
    found = load_views(photos, masks=tmp_path / "masks").masks
    assert torch.equal(found, torch.from_numpy(np.stack(wanted)))
    alone = [read_mask(tmp_path / "masks" / name) for name in masks]
    assert torch.equal(torch.stack(alone), found)


@pytest.mark.parametrize("polarity", ["auto", "dark", "bright"])
def test_masks_with_a_dark_object_are_inverted(photos, tmp_path, polarity):
    for name in NAMES:
        save(tmp_path / "masks" / f"{name}_mask.png", 255 - box())
    message = "masks: the masks are bright.*dark pixels are treated"
    warned = pytest.warns(PimperWarning, match=message)
    with warned if polarity == "auto" else nullcontext():
        masks = load_views(photos, masks=tmp_path / "masks", mask_object=polarity).masks
    shown = torch.from_numpy((polarity == "bright") != SHOWN)
    assert torch.equal(masks, shown.expand(3, 8, 12))


def soft_disc():
    """Return the coverage of pixels by a disc, 0 to 1, and the pixels covered by half."""
    rows, columns = np.mgrid[:384, :512] / 8
    fine = np.hypot(rows - 23, columns - 31) < 15
    coverage = fine.reshape(48, 8, 64, 8).mean(axis=(1, 3))
    return coverage, torch.from_numpy(coverage >= 0.5)


@pytest.mark.parametrize(
    "form", ["8", "16", "grey", "jpg", "alpha", "cut out", "labels", "0 and 1"]
)
def test_masks_mark_half_covered_pixels_in_any_format(tmp_path, form):
    coverage, truth = soft_disc()
    bytes_ = (255 * coverage).round().astype(np.uint8)
    texture = np.random.default_rng(3).integers(1, 255, (48, 64, 3), dtype=np.uint8)
    array = {
        "16": (65535 * coverage).round().astype(np.uint16),
        "grey": bytes_ // 2,
        "alpha": np.stack([bytes_ * 0] * 3 + [bytes_], axis=-1),
        "cut out": np.concatenate([texture, bytes_[..., None]], axis=-1),
        "labels": (coverage >= 0.5) * np.where(np.arange(64) < 30, np.uint8(1), np.uint8(7)),
        "0 and 1": (coverage >= 0.5).astype(np.uint8),
    }.get(form, bytes_)
    suffix, options = ("jpg", {"quality": 60}) if form == "jpg" else ("png", {})
    for name in NAMES:
        save(tmp_path / "photos" / f"{name}.png", texture)
        save(tmp_path / "masks" / f"{name}.{suffix}", array, **options)
    masks = load_views(tmp_path / "photos", masks=tmp_path / "masks").masks
    # The border has 94 pixels; counting all pixels above zero gives 0.88, rounding 0.998.
    overlap = float((masks[1] & truth).sum() / (masks[1] | truth).sum())
    assert overlap > (0.98 if form == "jpg" else 0.995)
    assert torch.equal(read_mask(tmp_path / "masks" / f"10.{suffix}"), masks[2])


def test_faint_masks_are_scaled_by_the_brightest_level_of_all(photos, tmp_path):
    """A soft edge at the photograph's border is not a separate object."""
    edge = box(0)
    edge[:, 0], edge[:3, 0] = 100, 200
    for name in NAMES:
        save(tmp_path / "masks" / f"{name}.png", edge if name == "10" else box())
    masks = load_views(photos, masks=tmp_path / "masks").masks
    assert torch.equal(masks[2].nonzero(), torch.tensor([[0, 0], [1, 0], [2, 0]]))
    assert torch.equal(masks[0], torch.from_numpy(SHOWN))


def test_masks_are_resized_with_their_photographs_and_exclude_padding(tmp_path):
    drawn = np.zeros((32, 48), dtype=np.uint8)
    drawn[:, :24] = 255
    for name, high in zip(NAMES, (24, 32, 32), strict=True):
        save(tmp_path / "photos" / f"{name}.png", np.full((high, 48, 3), 200, dtype=np.uint8))
        save(tmp_path / "masks" / f"{name}.png", drawn[:high])
    views = load_views(tmp_path / "photos", masks=tmp_path / "masks", max_size_px=24)
    assert views.masks[1].sum() == 12 * 16
    assert views.masks[1, :, :12].all()
    assert not (views.masks & ~views.inside).any()


def test_alpha_is_the_mask_unless_masks_are_given(photos, tmp_path, pixels):
    alpha = np.full((8, 12, 1), 255, dtype=np.uint8)
    save(photos / "2.png", np.concatenate([pixels, alpha], axis=-1))
    assert load_views(photos).masks is None  # a fully opaque alpha is not a mask
    alpha[:4] = 0
    save(photos / "2.png", np.concatenate([pixels, alpha], axis=-1))
    with pytest.warns(PimperWarning, match=r"1 of 3 photographs.*\(2\.png\).*used as masks"):
        masks = load_views(photos).masks
    assert masks[0].all()
    assert torch.equal(masks[1], torch.from_numpy(alpha[..., 0] > 0))
    for name in NAMES:
        save(tmp_path / "masks" / f"{name}.png", np.full((8, 12), 9, dtype=np.uint8))
    assert load_views(photos, masks=tmp_path / "masks").masks.all()


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (None, r"no mask for 2\.png.*such as 2\.png"),
        (np.full((4, 6), 255, dtype=np.uint8), r"2\.png: is 6 x 4, but the photograph 2\.png is 1"),
        (box(0), r"masks of 2\.png mark no pixel"),
    ],
)
def test_masks_that_do_not_match_are_refused_by_name(photos, tmp_path, second, message):
    for name, array in zip(NAMES, (box(), second, box()), strict=True):
        if array is not None:
            save(tmp_path / "masks" / f"{name}.png", array)
    with pytest.raises(InputError, match=message):
        load_views(photos, masks=tmp_path / "masks")
    with pytest.raises(InputError, match="nowhere: found nothing"):
        load_views(photos, masks=tmp_path / "nowhere")


def disc(width=90, height=60):
    """Return the mask of an object that is not centred."""
    rows, columns = np.mgrid[:height, :width]
    return (columns - 0.35 * width) ** 2 + (rows - 0.4 * height) ** 2 < (0.22 * height) ** 2


def tagged(orientation):
    exif = Image.Exif()
    exif[274] = orientation
    return exif


def write_photographs(folder, tags):
    """Write photographs of a disc on a dark background, with EXIF orientations."""
    for number, tag in enumerate(tags):
        noise = np.random.default_rng(number).integers(0, 40, (60, 90, 3))
        picture = (noise + 90 * disc()[..., None]).astype(np.uint8)
        save(folder / f"{number}.png", picture, exif=tagged(tag))


@settings(max_examples=15, deadline=None)
@given(tags=st.lists(st.integers(1, 8), min_size=3, max_size=3), tag=st.integers(1, 8))
def test_masks_are_rotated_by_their_exif_or_to_match_sizes(tmp_path_factory, tags, tag):
    """Masks are of the upright photograph, or of stored pixels if only that size matches."""
    shown = disc()
    stored = [rotated(shown, one) for one in tags]
    for way in ("upright", "with EXIF", "stored pixels"):
        root = tmp_path_factory.mktemp("turned")
        write_photographs(root / "photos", tags)
        for number, (upright, one) in enumerate(zip(stored, tags, strict=True)):
            drawn, exif = upright, tagged(1)
            if way == "with EXIF":
                inverse = {6: 8, 8: 6}.get(tag, tag)
                drawn, exif = rotated(upright, inverse), tagged(tag)
            elif way == "stored pixels" and one >= 5:
                drawn = shown
            save(root / "masks" / f"{number}.png", drawn.astype(np.uint8) * 255, exif=exif)
        views = load_views(root / "photos", masks=root / "masks")
        assert views.orientations.tolist() == tags
        for mask, wanted in zip(views.masks, stored, strict=True):
            assert torch.equal(mask[: wanted.shape[0], : wanted.shape[1]], torch.from_numpy(wanted))


@pytest.mark.parametrize(
    ("photograph", "mask"),
    [
        ("IMG_1.JPG", "img_1.png"),
        ("IMG 1.png", "IMG_1_Mask.png"),
        ("IMG 1.png", "img 1.png.png"),
        ("Fu\u0308\u00df.png", "F\u00fc\u00df.png"),
    ],
)
def test_masks_are_found_by_rewritten_names(photos, tmp_path, pixels, photograph, mask):
    for name in ("1.png", "2.png", mask):
        save(tmp_path / "masks" / name, box())
    (photos / "10.png").unlink()
    save(photos / photograph, pixels)
    masks = load_views(photos, masks=tmp_path / "masks").masks
    assert torch.equal(masks, torch.from_numpy(SHOWN).expand(3, 8, 12))


def test_masks_that_match_a_name_equally_well_are_refused_with_both(photos, tmp_path, pixels):
    for name in ("1.png", "2.png", "10.png", "A_b.png", "a_B.png"):
        save(tmp_path / "masks" / name, box())
    save(photos / "a b.png", pixels)
    with pytest.raises(InputError, match=r"a b\.png may be any of A_b\.png, a_B\.png"):
        load_views(photos, masks=tmp_path / "masks")
