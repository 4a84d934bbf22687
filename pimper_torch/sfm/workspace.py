"""COLMAP's files of one run: photographs, masks, and the database of features and matches.

Photographs go by their number there: ``000007.png`` is view 7, and image 8 of the database.
"""

import shutil
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from pimper_torch.mapped import drop_pages
from pimper_torch.memory import release_memory
from pimper_torch.radiometry import to_bytes
from pimper_torch.records import Views


@dataclass(frozen=True, slots=True, kw_only=True)
class Workspace:
    """A folder with the files of one run.

    Attributes:
        files: Names of the photographs in ``images``, in the order of the views.
        masked: Whether ``masks`` holds a mask for each, under its name with another ``.png``
            behind, as COLMAP wants them.
    """

    folder: Path
    files: tuple[str, ...]
    masked: bool
    database_name: str = "database.db"

    @property
    def images(self) -> Path:
        """Folder of the photographs."""
        return self.folder / "images"

    @property
    def masks(self) -> Path:
        """Folder of the masks."""
        return self.folder / "masks"

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return self.folder / self.database_name

    def with_copied_database(self, name: str) -> "Workspace":
        """Copy the database to another file of the folder, for matches of another hypothesis."""
        copied = replace(self, database_name=name)
        shutil.copyfile(self.database, copied.database)
        return copied


@contextmanager
def workspace(views: Views, threads: int) -> Iterator[Workspace]:
    """Write photographs and masks to a temporary folder, which goes when the block ends."""
    with tempfile.TemporaryDirectory(prefix="pimper_") as folder:
        space = Workspace(
            folder=Path(folder),
            files=tuple(f"{index:06d}.png" for index in range(views.num_views)),
            masked=views.masks is not None,
        )
        space.images.mkdir()
        space.masks.mkdir()
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda index: _write(views, index, space), range(views.num_views)))
        release_memory()
        yield space


def _write(views: Views, index: int, space: Workspace) -> None:
    """Write a photograph in 8-bit sRGB without its padding, and its mask if there is one."""
    width, height = (int(side) for side in views.sizes_px[index])
    pixels = to_bytes(views.images[index, :, :height, :width].detach()).cpu()
    array = pixels.permute(1, 2, 0).numpy()
    gray = array.shape[-1] == 1
    picture = Image.fromarray(np.ascontiguousarray(array[..., 0] if gray else array))
    # Fast compression: the files live for seconds. COLMAP looks for features in luma alone.
    picture.convert("L").save(space.images / space.files[index], compress_level=1)
    if views.masks is not None:
        mask = views.masks[index, :height, :width].cpu().numpy().astype(np.uint8) * 255
        Image.fromarray(mask).save(space.masks / f"{space.files[index]}.png", compress_level=1)
    drop_pages()
