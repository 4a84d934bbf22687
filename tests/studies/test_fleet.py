"""The fleet is balanced, its figures are those of known masks, and bad results are announced."""

import ast
import json
from collections import Counter
from pathlib import Path

import fleet as study
import numpy as np
import pytest
import torch
from fleet_captures import MATERIALS, PATHS, SHAPES, SUBSET, fleet, model, plate, stone
from shown import strings

import pimper_torch
from pimper_torch.geometry.topology import open_edges
from pimper_torch.io.meshes import read_mesh
from pimper_torch.runtime.errors import ReconstructionError

TOLD = {"views": 10, "registered": 10, "diagnosis": None, "failures": [], "warnings": []}


def test_every_material_is_on_every_path_and_no_shape_has_it_twice():
    names = [name.rsplit("-", 2) for name in fleet()]
    assert len(names) == len(SHAPES) * len(PATHS)
    assert len({(shape, material) for shape, _, material in names}) == len(names)
    pairs = Counter((path, material) for _, path, material in names)
    assert len(pairs) == len(PATHS) * len(MATERIALS)
    assert set(pairs.values()) == {2, 3}
    assert set(SUBSET) < set(fleet()) < set(fleet(everything=True))
    assert {name.rsplit("-", 1)[1] for name in SUBSET} == set(MATERIALS)


@pytest.mark.parametrize("make", [plate, stone])
def test_low_bodies_are_closed_low_and_on_the_table(make):
    mesh = make()
    size = mesh.vertices_world.amax(dim=0) - mesh.vertices_world.amin(dim=0)
    assert len(open_edges(mesh.faces)) == 0
    assert 0.1 < float(size[2] / size[:2].amin()) < 0.5
    assert abs(float(mesh.vertices_world[:, 2].min())) < 1e-6
    a, b, c = mesh.vertices_world[mesh.faces].unbind(dim=1)
    assert float((a * torch.linalg.cross(b, c)).sum()) > 0  # outward


def test_arrays_of_a_mesh_are_converted(tmp_path):
    corners = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.int32([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    np.savez(tmp_path / "ogre.npz", v=corners, f=faces)
    path, settings = model("ogre", tmp_path, tmp_path / "made")
    assert settings["up"] == "y"
    found = read_mesh(path)
    assert found.vertices_world.tolist() == corners.tolist()
    assert found.faces.tolist() == faces.tolist()
    (tmp_path / "spot.obj").touch()
    assert model("spot", tmp_path, tmp_path / "made")[0] == str(tmp_path / "spot.obj")
    assert model("jar", tmp_path, tmp_path / "made") == ("jar", {})


def test_figures_of_known_masks():
    known = torch.zeros(2, 4, 4, dtype=torch.bool)
    known[:, :2] = True
    found = known.clone()
    found[0, 0] = False  # half is lost
    found[1, 2] = True  # half in excess
    figures = study.compared(found, known)
    assert figures == pytest.approx(
        {"IoU": (1 / 2 + 2 / 3) / 2, "worst": 1 / 2, "lost %": 25.0, "extra %": 25.0}
    )


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, False),
        ({"warnings": ["photos: 3 of 10 are partly saturated"]}, False),
        ({"warnings": ["Everything in the photographs is treated as the object: no"]}, True),
        ({"verdict": {"score": 0.49}}, True),
        ({"verdict": {"score": 0.5}}, False),
        ({"diagnosis": "The cameras are unreliable"}, True),
        ({"registered": 8}, False),
        ({"registered": 7}, True),
        ({"failures": [{"what": "patch", "names": list("abcde")}]}, False),
        ({"failures": [{"what": "view", "names": list("ab")}] * 2}, False),
        ({"failures": [{"what": "view", "names": list("abc")}]}, True),
    ],
)
def test_announced_results(change, expected):
    assert study.announced(TOLD | change) is expected


def test_announcing_warnings_are_in_the_code():
    files = Path(pimper_torch.__file__).parent.rglob("*.py")
    texts = [text for path in files for _, text in strings(ast.parse(path.read_text("utf-8")))]
    missing = [part for part in study.ANNOUNCING if not any(part in text for text in texts)]
    assert missing == []


def raising(error):
    def refuse(*_):
        raise error

    return refuse


@pytest.mark.parametrize(
    ("error", "expected"), [(ReconstructionError("too few"), True), (IndexError("a bug"), False)]
)
def test_a_failure_is_a_row_and_a_refusal_is_announced(monkeypatch, tmp_path, error, expected):
    monkeypatch.setattr(study, "outlines", raising(error))
    row = study.judged({}, tmp_path, None, "default")
    assert (row["good"], row["announced"]) == (False, expected)
    assert str(error) in row["error"]


@pytest.mark.parametrize(
    ("normals", "met", "good"), [(5.9, 96.1, True), (6.1, 99.0, False), (1.0, 95.9, False)]
)
def test_good_results(monkeypatch, tmp_path, normals, met, good):
    figures = {"normals °": normals, "met %": met}
    monkeypatch.setattr(study, "outlines", raising(AssertionError("it has silhouettes")))
    monkeypatch.setattr(study, "reconstructed", lambda *_: {"announced": False})
    monkeypatch.setattr(study, "measured", lambda *_: figures)
    row = study.judged({"IoU": 0.9}, tmp_path, tmp_path, "default")
    assert row == {"IoU": 0.9, "announced": False, **figures, "good": good}


def test_rows_of_two_tags_are_side_by_side():
    good = {"IoU": 0.9, "good": True, "announced": True}
    bad = {"IoU": 0.7, "good": False, "announced": True, "error": "a | b"}
    quiet = {"IoU": 0.8, "good": False, "announced": False}
    lines = list(study.table({"old": {"x": good, "y": bad}, "new": {"y": quiet}}))
    assert lines[0] == "| old / new | IoU | good | announced | error |"
    assert lines[2] == "| x | 0.900 / - | yes / - | yes / - | - / - |"
    assert lines[3] == "| y | 0.700 / 0.800 | no / no | yes / no | a / b / - |"
    assert lines[5] == (
        "old: 2 captures, 1 good (1 announced), 1 bad (1 announced), IoU 0.800, worst 0.700 (y)"
    )
    assert lines[6].startswith("new: 1 captures, 0 good (0 announced), 1 bad (0 announced), IoU")


@pytest.fixture
def meshes(tmp_path):
    """Write the low stone, upright, in place of every mesh file."""
    folder, body = tmp_path / "given", stone()
    folder.mkdir()
    vertices = body.vertices_world[:, [1, 2, 0]].numpy()
    np.savez(folder / "ogre.npz", v=vertices, f=body.faces.numpy())
    for shape in ("spot", "armadillo", "scorpion"):
        np.savez(folder / f"{shape}.npz", v=vertices, f=body.faces.numpy())
    return folder


@pytest.mark.slow
def test_six_captures_are_judged_once_and_printed_again(meshes, tmp_path, capsys, monkeypatch):
    common = ["--out", str(tmp_path / "out"), "--meshes", str(meshes), "--tiny", "--tag", "now"]
    run = [*common, "--outlines", "--preset", "fast"]
    weights = Path(pimper_torch.__file__).parent / "data" / "silhouettes.safetensors"
    study.main([*run, "--subset", "--weights", str(weights)])
    rows = sorted((tmp_path / "out" / "rows" / "now").iterdir())
    assert [path.stem for path in rows] == sorted(SUBSET)
    found = [json.loads(path.read_text(encoding="utf-8")) for path in rows]
    assert sum("IoU" in row for row in found) >= 3  # of eight tiny photographs all round, few
    for row in found:
        assert 0 < row.get("worst", 1) <= row.get("IoU", 1) <= 1
    printed = capsys.readouterr().out
    monkeypatch.setattr(study, "judged", raising(AssertionError("a row exists")))
    study.main([*run, "--all", "--only", "jar-arc-s*", "ogre-round-plain"])
    study.main([*common, "--table", "now", "then"])
    again = capsys.readouterr().out
    assert "now: 2 captures, " in again
    assert "now: 6 captures, " in printed
    assert "now: 6 captures, " in again
    assert "then: 0 captures, " in again
