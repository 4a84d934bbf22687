"""Error if files do not state the encoding of their samples, or if it is ignored.

The linear photographs of a scene are written as PNG in other encodings, with and without the chunks
that state it. Each set is reconstructed with the true cameras and masks and measured.
"""

import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import torch
from bench_runs import figures_of
from declared import Figures, Place, Row, Study, Table, figure, listed
from PIL import Image

from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.metrics.estimates import estimate_of
from pimper_bench.metrics.evaluation import evaluate
from pimper_torch.io.decode import decode, write_deep_png
from pimper_torch.io.photographs import load_views
from pimper_torch.presets.load_chain import load_chain
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.radiometry.primaries import (
    DISPLAY_P3,
    REC_2020,
    primaries_of,
    srgb_from_primaries,
)

# Primaries, whether 16 bits are linear or 8 in sRGB's curve, and PNG's cICP.
ENCODINGS = {
    "sRGB": (None, False, bytes([1, 13, 0, 1])),
    "linear": (None, True, bytes([1, 8, 0, 1])),
    "Display P3": (DISPLAY_P3, False, bytes([12, 13, 0, 1])),
    "BT.2020": (REC_2020, False, bytes([9, 13, 0, 1])),
}

SETS = (
    ("sRGB", True),
    ("linear", True),
    ("linear", False),
    ("Display P3", False),
    ("BT.2020", False),
)


def write_photographs(scene: Path, folder: Path, name: str, *, says: bool) -> None:
    """Write the photographs of a scene in an encoding, with the chunk that says so or without."""
    chromaticities, linear, codes = ENCODINGS[name]
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted((scene / "photos").iterdir()):
        radiance = decode(path).samples.double()
        if chromaticities is not None:
            primaries = primaries_of(chromaticities)
            assert primaries is not None, "they are a standard's"
            matrix = srgb_from_primaries(primaries)
            assert matrix is not None, "they are a standard's"
            mixed = torch.einsum("ij,jhw->ihw", matrix.inverse(), radiance)
            radiance = torch.where(radiance < 1, mixed, radiance)
        target = folder / path.name
        if linear:
            levels = (65535 * radiance).round().movedim(0, -1).numpy().astype(np.uint16)
            write_deep_png(np.ascontiguousarray(levels), target)
        else:
            encoded = 255 * srgb_from_linear(radiance)
            Image.fromarray(encoded.round().byte().movedim(0, -1).numpy()).save(target)
        if says:
            data = target.read_bytes()
            body = b"cICP" + codes
            chunk = struct.pack(">I", len(codes)) + body + struct.pack(">I", zlib.crc32(body))
            target.write_bytes(data[:33] + chunk + data[33:])  # behind the header


def measure(place: Place, name: str, says: bool) -> Figures:
    """Reconstruct and evaluate: mean angles of lights and normals, and errors of albedo."""
    size = {"num_views": 8, "width": 240, "height": 180}
    scene = place.scene("potatoes", bits=16, encoding="linear", **size)
    folder = place.cache / "encodings" / f"{name} {'said' if says else 'silent'}"
    write_photographs(scene, folder / "photos", name, says=says)
    place.photographs(folder, "photos")
    views = load_views(folder / "photos", masks=scene / "masks")
    result = load_chain("default")(views, scene / "truth" / "sparse")
    found = evaluate(estimate_of(result), read_rendered(scene, photographs=False))
    return figures_of(found)


STUDY = Study(
    name="file_encodings",
    rows={
        (name, "yes" if says else "no"): Row(measure=partial(measure, name=name, says=says))
        for name, says in SETS
    },
    tables=[
        Table(
            name="encodings",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["encoding", "declared"],
                [
                    figure("lights, °", "lights", 1),
                    figure("normals, °", "normals", 1),
                    figure("albedo, %", "albedo", 1),
                    figure("median", "albedo, median", 1),
                ],
            ),
        )
    ],
)
