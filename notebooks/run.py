"""Run the notebooks, and keep their outputs: ``python notebooks/run.py [NAME ...]``.

A notebook is kept with a digest of the source that ran. ``tests/test_notebooks.py`` runs it again
and compares: words exactly, numbers within a tolerance, pictures at the size of a stamp.
"""

import base64
import hashlib
import io
import re
import sys
import time
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import nbformat
import numpy as np
from nbclient import NotebookClient
from nbformat import NotebookNode
from PIL import Image

FOLDER = Path(__file__).parent

# Time limit of a cell in seconds: ten times the longest cell on two cores.
TIMEOUT = 600

# Numbers differ by less than this fraction, or in their last digit: threads sum in any order. A
# cell whose figures vary more has its tolerance in its metadata.
TOLERANCE = 0.02

# Mean difference of two pictures, reduced to thumbnails; 1 is white on black.
STAMP_PX, STAMP_TOLERANCE = 48, 0.03

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def read(path: Path) -> NotebookNode:
    """Read a notebook."""
    return nbformat.read(path, as_version=4)  # type: ignore[no-untyped-call]


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    """Return the cells that run."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def digest(notebook: NotebookNode) -> str:
    """Return a name to the source of all cells that run."""
    source = "\0".join(cell.source for cell in code_cells(notebook))
    return hashlib.sha256(source.encode()).hexdigest()


def executed(notebook: NotebookNode) -> NotebookNode:
    """Run a notebook in a kernel of its own; give it with its outputs and its digest."""
    fresh = nbformat.from_dict(notebook)  # type: ignore[no-untyped-call]
    client = NotebookClient(
        fresh,
        timeout=TIMEOUT,
        kernel_name="python3",
        record_timing=False,
        coalesce_streams=True,
        resources={"metadata": {"path": str(FOLDER)}},
    )
    client.execute()
    for data in (output.get("data", {}) for cell in code_cells(fresh) for output in cell.outputs):
        if "image/png" in data:
            data["image/png"] = quantized(data["image/png"])
            data.pop("image/jpeg", None)  # Pillow shows an image in both formats
    fresh.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
        "pimper_torch": {"ran": digest(fresh)},
    }
    return fresh


def quantized(picture: str) -> str:
    """Reduce a picture, PNG in Base64, to 256 colours: a third of the bytes."""
    file = io.BytesIO()
    image = Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB")
    image.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return base64.b64encode(file.getvalue()).decode()


def texts(cell: NotebookNode) -> str:
    """Return the text that a cell printed and returned; a stream may be split into pieces."""
    said = ""
    for output in cell.outputs:
        if output.output_type == "stream":
            said += output.text
        elif "text/plain" in output.get("data", {}):
            said += output.data["text/plain"] + "\n"
    return said


def pictures(cell: NotebookNode) -> list[Image.Image]:
    """Return the pictures that a cell drew."""
    drawn = [output.get("data", {}).get("image/png") for output in cell.outputs]
    return [Image.open(io.BytesIO(base64.b64decode(one))) for one in drawn if one]


def differences(kept: NotebookNode, fresh: NotebookNode) -> Iterator[str]:
    """List the differences between two runs of a notebook."""
    pairs = zip_longest(code_cells(kept), code_cells(fresh))
    for number, (before, after) in enumerate(pairs, start=1):
        if before is None or after is None:
            yield f"cell {number} is in one of them alone"
            continue
        tolerance = before.metadata.get("tolerance", TOLERANCE)
        if not alike(texts(before), texts(after), tolerance):
            yield f"cell {number} said\n{texts(before)}\nand says\n{texts(after)}"
        for old, new in zip_longest(pictures(before), pictures(after)):
            if old is None or new is None or not look_alike(old, new):
                yield f"cell {number} draws a different picture"


def alike(before: str, after: str, tolerance: float) -> bool:
    """Compare words exactly, and numbers within a fraction or one unit of the last digit.

    >>> alike("off by 1.20 degrees", "off by 1.21 degrees", 0.001)
    True
    >>> alike("off by 1.2 degrees", "off by 1.2 radians", 0.1)
    False
    """
    if NUMBER.sub("#", before) != NUMBER.sub("#", after):
        return False
    pairs = zip(NUMBER.findall(before), NUMBER.findall(after), strict=True)
    return all(
        abs(float(old) - float(new)) <= max(tolerance * abs(float(old)), 1.001 * unit(old))
        for old, new in pairs
    )


def unit(number: str) -> float:
    """Return the value of one in the last digit of a number as it is written; 0 of an integer."""
    mantissa, _, exponent = number.lower().partition("e")
    _, point, decimals = mantissa.partition(".")
    return float(10.0 ** (int(exponent or 0) - len(decimals))) if point else 0.0


def look_alike(before: Image.Image, after: Image.Image) -> bool:
    """Compare two pictures as thumbnails."""
    old, new = (
        np.asarray(one.convert("RGB").resize((STAMP_PX, STAMP_PX), Image.Resampling.BOX)) / 255
        for one in (before, after)
    )
    return bool(np.abs(old - new).mean() < STAMP_TOLERANCE)


def main(names: list[str]) -> None:
    """Run notebooks, all unless named by the beginning of their names, and keep them."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and not path.name.startswith(tuple(names)):
            continue
        began = time.monotonic()
        notebook = executed(read(path))
        nbformat.write(notebook, path)  # type: ignore[no-untyped-call]
        sys.stdout.write(
            f"{path.name}: {time.monotonic() - began:.0f} s, {path.stat().st_size / 1e3:.0f} kB\n"
        )
        sys.stdout.flush()


if __name__ == "__main__":
    main(sys.argv[1:])
