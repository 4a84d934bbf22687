"""Masks of the pixels that files store, and those turned already, beside turned photographs."""

import numpy as np
import pytest
import torch
from PIL import Image

from pimper_torch.doors.io.decode import rotated
from pimper_torch.doors.io.photographs import load_views
from pimper_torch.runtime.errors import InputError


def disc(width, height):
    """An object off the middle."""
    rows, columns = np.mgrid[:height, :width]
    return (columns - 0.35 * width) ** 2 + (rows - 0.4 * height) ** 2 < (0.22 * height) ** 2


def write_photographs(folder, tags, width=90, height=60):
    """Photographs of a disc before something dark, stored with EXIF's tags."""
    folder.mkdir()
    shown = disc(width, height)
    for number, tag in enumerate(tags):
        noise = np.random.default_rng(number).integers(0, 40, (height, width, 3))
        exif = Image.Exif()
        exif[274] = tag
        picture = Image.fromarray((noise + 90 * shown[..., None]).astype(np.uint8))
        picture.save(folder / f"{number}.png", exif=exif)
    return shown


def write_masks(folder, drawn, tags, *, turned):
    folder.mkdir()
    for number, tag in enumerate(tags):
        mask = rotated(drawn, tag) if turned else drawn
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / f"{number}.png")


@pytest.mark.parametrize("tags", [[3, 3, 3, 3], [2, 4, 3, 1], [6, 3, 8, 1]])
def test_masks_are_drawn_on_photographs_as_they_stand(tmp_path, tags):
    shown = write_photographs(tmp_path / "photos", tags)
    write_masks(tmp_path / "masks", shown, tags, turned=True)
    views = load_views(tmp_path / "photos", masks=tmp_path / "masks")
    for view, tag in enumerate(tags):
        width, height = views.sizes_px[view].tolist()
        wanted = torch.from_numpy(rotated(shown, tag))
        assert torch.equal(views.masks[view, :height, :width], wanted)
    assert views.orientations.tolist() == tags


def test_masks_whose_size_tells_that_they_are_of_stored_pixels_are_turned(tmp_path):
    tags = [6, 8, 6]
    shown = write_photographs(tmp_path / "photos", tags)
    write_masks(tmp_path / "masks", shown, tags, turned=False)
    views = load_views(tmp_path / "photos", masks=tmp_path / "masks")
    for mask, tag in zip(views.masks, tags, strict=True):
        assert torch.equal(mask, torch.from_numpy(rotated(shown, tag)))


def test_masks_with_an_exif_of_their_own_are_turned_by_that_alone(tmp_path):
    tags = [3, 3, 3]
    shown = write_photographs(tmp_path / "photos", tags)
    (tmp_path / "masks").mkdir()
    exif = Image.Exif()
    exif[274] = 3
    for number in range(3):
        mask = Image.fromarray(shown.astype(np.uint8) * 255)
        mask.save(tmp_path / "masks" / f"{number}.png", exif=exif)
    masks = load_views(tmp_path / "photos", masks=tmp_path / "masks").masks
    assert torch.equal(masks[0], torch.from_numpy(rotated(shown, 3)))


@pytest.mark.parametrize(
    ("photograph", "mask"),
    [
        ("IMG_1.JPG", "img_1.png"),
        ("IMG 1.png", "IMG_1_Mask.png"),
        ("IMG 1.png", "img 1.png.png"),
        ("Fu\u0308\u00df.png", "F\u00fc\u00df.png"),
    ],
)
def test_masks_are_found_whatever_a_program_made_of_the_name(tmp_path, photograph, mask):
    shown = write_photographs(tmp_path / "photos", [1, 1, 1])
    write_masks(tmp_path / "masks", shown, [1, 1, 1], turned=True)
    kind = "JPEG" if photograph.endswith("JPG") else "PNG"
    Image.open(tmp_path / "photos" / "0.png").save(tmp_path / "photos" / photograph, kind)
    (tmp_path / "photos" / "0.png").unlink()
    (tmp_path / "masks" / "0.png").rename(tmp_path / "masks" / mask)
    masks = load_views(tmp_path / "photos", masks=tmp_path / "masks").masks
    assert torch.equal(masks, torch.from_numpy(shown).expand(3, 60, 90))


def test_masks_that_fit_a_name_equally_well_are_refused_with_both(tmp_path):
    shown = write_photographs(tmp_path / "photos", [1, 1, 1])
    write_masks(tmp_path / "masks", shown, [1, 1, 1], turned=True)
    (tmp_path / "photos" / "0.png").rename(tmp_path / "photos" / "a b.png")
    (tmp_path / "masks" / "0.png").rename(tmp_path / "masks" / "A_b.png")
    Image.fromarray(shown).save(tmp_path / "masks" / "a_B.png")
    with pytest.raises(InputError, match=r"a b\.png may be any of A_b\.png, a_B\.png"):
        load_views(tmp_path / "photos", masks=tmp_path / "masks")


def test_a_folder_is_known_by_the_path_that_was_given(tmp_path, monkeypatch):
    write_photographs(tmp_path / "photos", [1, 6, 1])
    (tmp_path / "cam1").symlink_to(tmp_path / "photos")
    monkeypatch.chdir(tmp_path / "photos")
    assert load_views(".").folder == (tmp_path / "photos").as_posix()
    assert load_views("../cam1").folder == (tmp_path / "cam1").as_posix()
