"""Error if files do not state the encoding of their samples, or if it is ignored.

Run as ``python benchmarks/studies/file_encodings.py SCENE -o FOLDER``, with a scene from ``pimper
render`` with ``--bits 16 --encoding linear``. Its photographs are written as PNG in other
encodings, with and without the chunks that state it. Each set is reconstructed with the true
cameras and masks and measured. Prints rows of a table.
"""

import argparse
import io
import json
import struct
import sys
import warnings
import zlib
from contextlib import redirect_stdout
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from pimper_torch.cli.main import main as pimper
from pimper_torch.io.decode import decode, write_deep_png
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
COLUMNS = ("encoding", "says so", "lights", "normals", "albedo, mean", "median")


def main() -> None:
    """Read the command line, run every encoding with its chunk and without, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="folder of a scene, linear and of 16 bits")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for all files")
    parser.add_argument("--encodings", nargs="+", choices=ENCODINGS, default=list(ENCODINGS))
    options = parser.parse_args()
    sys.stdout.write("| " + " | ".join(COLUMNS) + " |\n|---|---|--:|--:|--:|--:|\n")
    for name in options.encodings:
        for says in (True, False):
            folder = options.out / f"{name} {'said' if says else 'silent'}"
            write_photographs(options.scene, folder / "photos", name, says=says)
            cells = measure(options.scene, folder)
            sys.stdout.write("| " + " | ".join([name, "yes" if says else "no", *cells]) + " |\n")
            sys.stdout.flush()


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


def measure(scene: Path, folder: Path) -> list[str]:
    """Reconstruct and evaluate: mean angles of lights and normals, and errors of albedo."""
    truth, report = scene / "truth", folder / "evaluation.json"
    run = [folder / "photos", "--sparse", truth / "sparse", "--masks", scene / "masks"]
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        for line in (
            ["reconstruct", *run, "-o", folder / "out", "--overwrite", "--quiet"],
            ["evaluate", folder / "out", scene, "-o", report, "--overwrite", "--quiet"],
        ):
            if pimper([str(one) for one in line]) != 0:
                return ["failed", "", "", ""]
    told = json.loads(report.read_text(encoding="utf-8"))
    view = told["views"][0]
    return [
        f"{told['lights']['mean_rotated_deg']:.1f}°",
        f"{view['shape_normals']['mean_deg']:.1f}°",
        f"{view['albedo']['one_scale_percent']:.1f} %",
        f"{view['albedo']['one_scale_median_percent']:.1f} %",
    ]


if __name__ == "__main__":
    main()
