"""Models kept from run to run, so that a change of a later stage costs only the later stages."""

import hashlib
import json
import os
import tempfile
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pimper_torch.errors import OutputError
from pimper_torch.records import Lens, Record, Views
from pimper_torch.sfm.model import SparseModel

_TENSORS = (
    "cam_from_world",
    "points_world",
    "observation_point",
    "observation_view",
    "observation_pixels",
    "background_from_view",
)
_DIGEST_BYTES = hashlib.sha256().digest_size


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class KeptModel(Record):
    """A model and what it cost.

    Attributes:
        model: As structure from motion found it.
        seconds: Wall clock when it was found.
    """

    model: SparseModel
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelCache:
    """A folder with one file a model, named by a hash of all that the model depends on.

    A file holds its own hash before its contents: what was damaged or cut short is not believed.
    Files are renamed into place when they are whole, so that runs can share the folder.

    Attributes:
        folder: Made when the first model is kept.
    """

    folder: Path | str

    def find(self, key: str) -> KeptModel | None:
        """Read a model; ``None`` where there is none, or a damaged one."""
        try:
            whole = self._path(key).read_bytes()
        except OSError:
            return None
        digest, contents = whole[:_DIGEST_BYTES], whole[_DIGEST_BYTES:]
        return _unpacked(contents) if hashlib.sha256(contents).digest() == digest else None

    def keep(self, key: str, kept: KeptModel) -> None:
        """Write a model in place of one of the same key.

        Raises:
            OutputError: The folder cannot be written.
        """
        contents = _packed(kept)
        try:
            Path(self.folder).mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=self.folder) as folder:
                whole = Path(folder) / "whole"
                whole.write_bytes(hashlib.sha256(contents).digest() + contents)
                whole.replace(self._path(key))
        except OSError as error:
            raise OutputError(
                f"The model cannot be kept in the cache {self.folder}: {error}. Give a folder "
                "that may be written, or none."
            ) from error

    def _path(self, key: str) -> Path:
        return Path(self.folder) / f"{key}.sfm"


def user_cache() -> Path:
    """Give the folder for caches of this package: ``pimper_torch`` in ``$XDG_CACHE_HOME``.

    Where that is not set, in ``~/.cache``. Source: XDG Base Directory Specification 0.8.
    """
    home = os.environ.get("XDG_CACHE_HOME", "")
    base = Path(home) if Path(home).is_absolute() else Path.home() / ".cache"
    return base / "pimper_torch"


def model_key(views: Views, settings: Any) -> str:  # noqa: ANN401 - any dataclass
    """Hash all that a model depends on: photographs, settings, and the code that finds it.

    Args:
        views: Radiance, masks, sizes, names and focal lengths count.
        settings: A dataclass of numbers and words, without what cannot change the model.
    """
    about = {
        "names": views.names,
        "shape": tuple(views.images.shape),
        "dtype": str(views.images.dtype),
        "masked": views.masks is not None,
        "settings": asdict(settings),
        "code": _code(),
    }
    digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode())
    masks = () if views.masks is None else (views.masks,)
    for tensor in (views.sizes_px, views.focals_px, *masks, *views.images):
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).data)
    return digest.hexdigest()


def _code() -> dict[str, str]:
    """Hash the rooms that find a model, and tell the versions of what they run on."""
    files, package = hashlib.sha256(), Path(__file__).parents[1]
    for room in ("geometry", "kernels", "radiometry", "records", "sfm"):
        for path in sorted((package / room).glob("*.py")):
            files.update(path.read_bytes())
    return {"rooms": files.hexdigest()} | {name: _version(name) for name in ("pycolmap", "torch")}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _packed(kept: KeptModel) -> bytes:
    model = kept.model
    about = {
        "names": model.names,
        "lenses": [asdict(lens) for lens in model.lenses],
        "seconds": kept.seconds,
    }
    arrays = {name: getattr(model, name).numpy() for name in _TENSORS}
    buffer = BytesIO()
    np.savez(buffer, allow_pickle=False, about=np.array(json.dumps(about)), **arrays)
    return buffer.getvalue()


def _unpacked(contents: bytes) -> KeptModel:
    with np.load(BytesIO(contents), allow_pickle=False) as arrays:
        about = json.loads(str(arrays["about"]))
        tensors: dict[str, Tensor] = {name: torch.from_numpy(arrays[name]) for name in _TENSORS}
    lenses = (Lens(**{**lens, "params": tuple(lens["params"])}) for lens in about["lenses"])
    model = SparseModel(names=tuple(about["names"]), lenses=tuple(lenses), **tensors)
    return KeptModel(model=model, seconds=float(about["seconds"]))
