"""Pages are correct: links resolve, and quoted messages and script options exist."""

import ast
import functools
import re
from importlib import import_module
from inspect import ismodule
from pathlib import Path

import pytest
from shown import strings

import pimper_bench
import pimper_torch
from pimper_torch.cli.options import CommonOptions, InputOptions

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PACKAGES = [Path(package.__file__).parent for package in (pimper_torch, pimper_bench)]
PAGES = (
    *sorted(DOCS.glob("*.md")),
    *(ROOT / folder / "README.md" for folder in ("", "benchmarks")),
)
LINK = re.compile(r"\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#{1,4} (.+)$", flags=re.MULTILINE)
MODULE = re.compile(r"^\.\. automodule:: (\S+)$", flags=re.MULTILINE)
SCRIPT = re.compile(r"^    .*?python (benchmarks/studies/\w+\.py)(.*)$", flags=re.MULTILINE)
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")

# The site gets these pages from other places.
INCLUDED = {DOCS / "benchmarks.md": ROOT / "benchmarks" / "README.md"}


def text_of(page: Path) -> str:
    return INCLUDED.get(page, page).read_text(encoding="utf-8")


def anchors(page: Path) -> set[str]:
    """Return the anchors of headings, as on GitHub and the site."""
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in HEADING.findall(text_of(page)))
    return {heading.strip().replace(" ", "-") for heading in plain}


def links(page: Path) -> list[str]:
    found = LINK.findall(page.read_text(encoding="utf-8"))
    return [link for link in found if "://" not in link]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_and_headings(page):
    for link in links(page):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors(target), link


def bare(text: str) -> str:
    return " ".join(text.replace("`", "").split())


def test_messages_on_the_page_on_failures_are_in_the_code():
    quoted = re.findall(r"^\| `(.+?)` \| ", text_of(DOCS / "failures.md"), flags=re.MULTILINE)
    assert len(quoted) > 25
    files = (path for package in PACKAGES for path in package.rglob("*.py"))
    texts = [bare(one) for path in files for _, one in strings(ast.parse(path.read_text("utf-8")))]
    assert [quote for quote in quoted if not any(bare(quote) in text for text in texts)] == []


def documented() -> set[str]:
    pages = (DOCS / "api").rglob("*.rst")
    return {name for page in pages for name in MODULE.findall(page.read_text(encoding="utf-8"))}


def test_the_reference_has_the_modules_of_all_public_names():
    homes = {
        value.__module__
        for name in pimper_torch._names
        if not ismodule(value := getattr(pimper_torch, name))
    }
    assert homes <= documented()


def test_the_reference_names_existing_modules():
    for name in documented():
        assert import_module(name).__doc__, name


@functools.cache
def options_of(script: str) -> set[str]:
    found = set(re.findall(r'"(--[a-z-]+)"', (ROOT / script).read_text(encoding="utf-8")))
    if script.endswith("speed.py"):  # passes the others to `pimper reconstruct`
        fields = (*CommonOptions.__dataclass_fields__, *InputOptions.__dataclass_fields__)
        found |= {f"--{name.replace('_', '-')}" for name in fields}
    return found


def test_benchmark_scripts_have_the_documented_options():
    page = text_of(ROOT / "benchmarks" / "README.md")
    commands = SCRIPT.findall(page)
    assert len(commands) > 20
    for script, rest in commands:
        assert set(OPTION.findall(rest)) <= options_of(script), (script, rest)
