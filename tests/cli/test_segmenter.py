"""The option ``--segmenter`` from the command line to the photographs' priors."""

import json

import numpy as np
import pytest
import torch

import pimper_torch as pt
from pimper_torch.cli.batches.objects import read_objects
from pimper_torch.cli.main import main
from pimper_torch.cli.options import inputs_of, parse
from pimper_torch.priors import salient_networks, segmenter
from tests.priors.onnx_files import brightness


@pytest.fixture
def network(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "bright.onnx"
    path.write_bytes(brightness())
    return path


def test_masks_exclude_a_segmenter():
    message = "--silhouettes, --segmenter or --object-at is 'u2net'; needed: no value together"
    with pytest.raises(pt.ConfigError, match=message):
        parse("reconstruct", ["photos", "-o", "out", "--masks", "drawn", "--segmenter", "u2net"])


def test_a_file_is_an_input_of_the_run_and_a_name_is_none(network):
    line = ["photos", "-o", "out", "--segmenter"]
    given = [inputs_of(parse("reconstruct", [*line, word])) for word in (str(network), "u2net")]
    assert [each["--segmenter"] for each in given] == [network, None]


def test_a_file_in_the_table_of_a_batch_is_beside_it(network, tmp_path):
    table = tmp_path / "list.csv"
    table.write_text("photos,segmenter\na,bright.onnx\nb,u2net\n")
    settings = [each.settings for each in read_objects(table)]
    assert settings == [("--segmenter", str(network)), ("--segmenter", "u2net")]


@pytest.mark.parametrize("word", ["u2net", "missing.onnx"])
def test_an_unusable_network_is_refused_before_photographs_are_read(
    word, photos, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(salient_networks, "find_spec", lambda _: None)
    assert main(["reconstruct", str(photos), "-o", str(tmp_path / "out"), "--segmenter", word]) == 2
    refused = "pip install 'pimper_torch[segment]'" if word == "u2net" else "found nothing; needed"
    assert refused in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_its_soft_masks_add_to_those_of_a_folder_and_are_kept(
    photos, chain, network, tmp_path, monkeypatch
):
    (tmp_path / "soft").mkdir()
    np.save(tmp_path / "soft" / "2.npy", np.full((48, 64), 0.7))
    line = ["reconstruct", str(photos), "--cache", str(tmp_path / "kept")]
    line += ["--silhouettes", str(tmp_path / "soft"), "--segmenter", str(network)]
    assert main([*line, "-o", str(tmp_path / "out")]) == 0
    _, views, _ = chain.given
    read, made = views.priors  # silhouettes add up the log odds of all priors of a photograph
    assert isinstance(made, pt.SilhouettePrior)
    assert (read.names, made.names) == (("2.png",), views.names)
    assert torch.equal(made.inside, pt.segment(views, network).inside)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["segmenter"] == str(network)
    monkeypatch.setattr(segmenter, "_silhouette", None)  # a call would fail
    assert main([*line, "-o", str(tmp_path / "again")]) == 0
    assert torch.equal(chain.given[1].priors[1].inside, made.inside)
