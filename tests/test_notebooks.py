"""Notebooks are stored with their outputs, and reproduce them."""

import base64
import doctest
import importlib.util
import io
from pathlib import Path

import nbformat
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
MAX_BYTES = 600_000


spec = importlib.util.spec_from_file_location("run_notebooks", ROOT / "notebooks" / "run.py")
run = importlib.util.module_from_spec(spec)
spec.loader.exec_module(run)

every = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def notebook(*cells):
    return nbformat.v4.new_notebook(cells=list(cells))


def cell(said="", drawn=None, **metadata):
    made = nbformat.v4.new_code_cell("1", metadata=metadata)
    if said:
        made.outputs.append(nbformat.v4.new_output("stream", name="stdout", text=said))
    if drawn is not None:
        file = io.BytesIO()
        Image.new("RGB", (64, 64), drawn).save(file, format="png")
        data = {"image/png": base64.b64encode(file.getvalue()).decode()}
        made.outputs.append(nbformat.v4.new_output("display_data", data=data))
    return made


def differ(before, after):
    return len(list(run.differences(notebook(before), notebook(after))))


def test_outputs_differ_in_words_numbers_and_images():
    said = cell("3.00 degrees off")
    assert differ(said, cell("3.05 degrees off")) == 0  # within the tolerance
    assert differ(said, cell("3.20 degrees off")) == 1
    assert differ(said, cell("3.00 percent off")) == 1
    assert differ(said, cell("")) == 1
    assert differ(cell("100 facets"), cell("103 facets")) == 1
    assert differ(cell("100 facets", tolerance=0.05), cell("103 facets")) == 0
    assert differ(cell("0.01 of it"), cell("0.02 of it")) == 0  # one unit of the last digit
    assert differ(cell("0.01 of it"), cell("0.03 of it")) == 1
    pieces = cell("3.00 degrees")
    pieces.outputs += cell(" off").outputs
    assert differ(said, pieces) == 0
    assert differ(cell(drawn="red"), cell(drawn="red")) == 0
    assert differ(cell(drawn="red"), cell(drawn="blue")) == 1
    assert differ(cell(drawn="red"), cell()) == 1
    assert list(run.differences(notebook(said), notebook(said, cell())))


def test_the_example_of_the_comparison_is_correct():
    ran = doctest.testmod(run)
    assert ran.attempted > 0
    assert ran.failed == 0


def test_the_digest_covers_only_code():
    text = nbformat.v4.new_markdown_cell("words")
    one, other = nbformat.v4.new_code_cell("1"), nbformat.v4.new_code_cell("2")
    assert run.digest(notebook(one, text)) == run.digest(notebook(text, one))
    assert run.digest(notebook(one, other)) != run.digest(notebook(other, one))
    assert run.digest(notebook(one, other)) != run.digest(notebook(one))


@every
def test_a_notebook_has_the_outputs_of_its_source(path):
    kept = run.read(path)
    cells = run.code_cells(kept)
    assert kept.metadata["pimper_torch"]["ran"] == run.digest(kept), (
        f"the source has changed since it ran: python notebooks/run.py {path.stem}"
    )
    assert [one.execution_count for one in cells] == list(range(1, len(cells) + 1))
    outputs = [output for one in cells for output in one.outputs]
    assert all(output.output_type != "error" for output in outputs)
    assert all(output.get("name") != "stderr" for output in outputs)  # contains local paths
    assert any(run.pictures(one) for one in cells)
    assert path.stat().st_size < MAX_BYTES


@pytest.mark.slow
@every
def test_a_notebook_reproduces_its_outputs(path):
    kept = run.read(path)
    assert list(run.differences(kept, run.executed(kept))) == []
