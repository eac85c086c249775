"""Every source that code, configuration and pages cite can be followed: page, heading, link, figure.

A citation is `docs/NAME.md` or `docs/NAME.md, Heading`, with further headings after commas and `and`. What follows the
comma with a capital letter is a heading; a semicolon ends the list.
"""

import re
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("dqn", "envs", "hardware", "experiments", "conf", "docs", "tests")
SOURCES = sorted(
    path
    for path in chain(ROOT.glob("*.md"), *((ROOT / folder).rglob("*") for folder in FOLDERS))
    if path.suffix in (".py", ".yaml", ".md") and path != Path(__file__)
)
WRITTEN = {"table.md"}  # what a command writes into its run folder

PAGE = re.compile(r"(?<![\w/.-])([\w./-]+\.md)\b(?!\")")  # a file name in quotation marks is code
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
SECTION = re.compile(r"\bsections? (?:\d|[a-d]\b)", re.IGNORECASE)
LITERATURE = re.compile(r"\bpaper\b|\d:\d")  # a paper's sections may be cited; 25:1 is volume and page
END = r"(?:(?= and\b)|(?! ?[\w-]|\.\d))"  # what may follow a heading; more words would be another heading
LEADER = re.compile(r"\s*\n\s*(?:# ?)?")


@cache
def headings(page: Path) -> tuple[str, ...]:
    """Headings of a page, longest first; lines of code blocks are indented and therefore none."""
    found = re.findall(r"^#{1,6} (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return tuple(sorted(found, key=len, reverse=True))


def anchor(heading: str) -> str:
    """What a heading is called in a link: lower case, letters, digits, hyphens."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def wrong_headings(rest: str, page: Path) -> list[str]:
    """Of the text after a cited page: the first heading that the page does not have, if any."""
    while named := re.match(r"(?:, and|,| and) (?=[A-Z])", rest):
        rest = rest[named.end() :]
        heading = next((h for h in headings(page) if re.match(re.escape(h) + END, rest)), "")
        if not heading:
            return [f"{page.name} has no heading {rest[:30]!r}"]
        rest = rest[len(heading) :]
    return []


def wrong(text: str, source: Path) -> list[str]:
    """Everything in a file's text that cannot be followed."""
    faults = []
    prose = text
    if source.suffix == ".md":
        prose = LINK.sub("", text)
        for target in LINK.findall(text):
            path, _, name = target.partition("#")
            if "://" in target or target.startswith("mailto:"):
                continue
            page = (source.parent / path) if path else source
            if not page.is_file():
                faults.append(f"link to {target}: no such file")
            elif name and name not in map(anchor, headings(page)):
                faults.append(f"link to {target}: no such heading")
    prose = LEADER.sub(" ", prose)
    for cited in PAGE.finditer(prose):
        name = cited[1]
        page = ROOT / name
        if name in WRITTEN:
            continue
        if page.is_file():
            faults += wrong_headings(prose[cited.end() :], page)
        else:
            faults.append(f"{name}: no such page")
    faults += [
        f"{prose[max(0, found.start() - 30) : found.end()]!r}: cite a heading, not a number"
        for found in SECTION.finditer(prose)
        if not LITERATURE.search(prose[max(0, found.start() - 40) : found.start()])
    ]
    return faults


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_what_is_cited_exists(source):
    assert not wrong(source.read_text(encoding="utf-8"), source)


@pytest.mark.parametrize(
    ("name", "text", "found"),
    [
        ("a.py", "# see docs/device.md, Pumps, Waste and Failures; Steel 2020", ""),
        ("a.py", "# docs/device.md, OD\n    # measurement, and what follows", ""),
        ("a.yaml", "# paper, section 3; docs/device.md, which says more", ""),
        ("README.md", "[pumps](docs/device.md#od-measurement) ![curve](docs/figures/closed_loop.png)", ""),
        ("a.py", "# docs/nothing.md", "no such page"),
        ("a.py", "# docs/device.md, Pump", "no heading 'Pump'"),
        ("a.py", "# docs/device.md, Pumps and Wasted", "no heading 'Wasted'"),
        ("a.py", "# docs/device.md section 3", "not a number"),
        ("README.md", "[pumps](docs/device.md#pump)", "no such heading"),
        ("README.md", "[pumps](device.md)", "no such file"),
        ("README.md", "![curve](docs/figures/nothing.png)", "no such file"),
    ],
)
def test_a_wrong_citation_is_found(name, text, found):
    faults = wrong(text, ROOT / name)
    assert (found in faults[0]) if found else not faults


def test_every_page_is_in_the_readme():
    linked = {target.partition("#")[0] for target in LINK.findall((ROOT / "README.md").read_text(encoding="utf-8"))}
    pages = {page.relative_to(ROOT).as_posix() for page in (ROOT / "docs").glob("*.md")}
    assert pages - {"docs/index.md"} <= linked  # which is the README's counterpart on the site


def test_every_figure_is_shown_on_a_page():
    shown = "".join(page.read_text(encoding="utf-8") for page in SOURCES if page.suffix == ".md")
    assert all(figure.name in shown for figure in (ROOT / "docs" / "figures").iterdir())
