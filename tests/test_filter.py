"""The page on failures hides the rows that do not match a text."""

import shutil
from pathlib import Path

import pytest

pytestmark = [pytest.mark.browser, pytest.mark.slow]
sync_api = pytest.importorskip("playwright.sync_api")

SCRIPT = Path(__file__).parents[1] / "docs" / "static" / "filter.js"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
PAGE = """<article><section><h1>When it fails</h1><div id="filter"></div>
<section><h2>Cameras</h2><table><tbody>
<tr><td>… of … photographs were registered; excluded: ….</td><td>too few features</td></tr>
<tr><td>No features were found in …: ….</td><td>blurred photographs</td></tr>
</tbody></table></section>
<section><h2>Memory</h2><table><tbody>
<tr><td>memory ran out; no result was written.</td><td>large photographs</td></tr>
</tbody></table></section></section></article>"""


@pytest.fixture(scope="module")
def page():
    with sync_api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        opened = started.new_page()
        opened.set_content(f"{PAGE}<script>{SCRIPT.read_text(encoding='utf-8')}</script>")
        yield opened
        started.close()


@pytest.mark.parametrize(
    ("text", "rows", "sections"),
    [
        ("", [0, 1, 2], 2),
        ("Features", [0, 1], 1),  # of any column, in any case
        ("photographs blurred", [1], 1),  # words in any order
        ("24 of 30  photographs were registered; excluded: a.jpg, b.jpg.", [0], 1),
        ("registered", [0], 1),
        ("turntable", [], 0),
    ],
)
def test_rows_that_do_not_match_are_hidden(page, text, rows, sections):
    page.get_by_role("searchbox").fill(text)
    visible = [row.is_visible() for row in page.locator("tr").all()]
    assert [index for index, shown in enumerate(visible) if shown] == rows
    assert sum(heading.is_visible() for heading in page.locator("h2").all()) == sections
    said = f"{len(rows)} of 3 rows" if text else ""
    assert page.get_by_role("status").text_content() == said
