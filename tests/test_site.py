"""The pages and the reference made of the docstrings are built as a site; a warning is an error."""

import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from envs.plant.plant import PlantConfig

# one worker makes what its tests look at, which takes minutes where the machine is busy
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("site"), pytest.mark.timeout(1200)]
ROOT = Path(__file__).parents[1]
PAGES = sorted(
    path.relative_to(ROOT / "docs").with_suffix("").as_posix()
    for folder in ("docs", "docs/records")
    for path in (ROOT / folder).glob("*.md")
)
NEEDED = ("sphinx", "myst_parser", "furo", "sphinx_copybutton", "latex2mathml")


def built(source: Path, target: Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(source), str(target)]
    return subprocess.run(words, capture_output=True, text=True, cwd=ROOT, check=False)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    missing = [name for name in NEEDED if find_spec(name.split(".")[0]) is None]
    if missing:
        pytest.skip(f"{missing[0]} is not installed; the extra [docs] has it")
    target = tmp_path_factory.mktemp("site")
    done = built(ROOT / "docs", target)
    assert done.returncode == 0, done.stderr
    return target


def test_every_page_is_built_and_reached_from_the_first(site: Path) -> None:
    first = (site / "index.html").read_text(encoding="utf-8")
    for page in PAGES:
        assert (site / f"{page}.html").is_file()
        assert page == "index" or f'href="{page}.html"' in first


def test_equations_labels_and_code_of_a_docstring_are_on_its_page(site: Path) -> None:
    page = (site / "api" / "envs" / "envs.html").read_text(encoding="utf-8")
    assert "-(x - setpoint)^2" in page
    assert "<strong>Raises:</strong>" in page
    said = str(PlantConfig.__doc__).split(" ", 1)[0]
    assert f"<p>{said}" in (site / "api" / "envs" / "envs.plant.html").read_text(encoding="utf-8")


def test_the_site_is_whole_without_a_network(site: Path) -> None:
    loads = re.compile(
        r"""<(?:script|img|iframe|object|source)\b[^>]*?\b(?:src|data)=["'](?:https?:)?//"""
        r"""|<link\b(?=[^>]*\brel=["'](?:stylesheet|preload|icon))[^>]*\bhref=["'](?:https?:)?//"""
        r"""|\b(?:import|from|fetch)\s*\(?\s*["'](?:https?:)?//"""
    )
    found = {page.name: loads.findall(page.read_text(encoding="utf-8")) for page in site.rglob("*.html")}
    assert not any(found.values()), found
    assert (site / "method.html").read_text(encoding="utf-8").count("<math") > 50


@pytest.mark.parametrize(
    ("page", "text"),
    [
        ("lost.md", "# A page that no table of contents has\n"),
        ("index.md", "# Index\n\n```{toctree}\nnot_there\n```\n"),
        ("index.md", "# Index\n\n[nowhere]({lost}.md)\n".format(lost="not_there")),
    ],
)
def test_a_warning_is_an_error(page: str, text: str, tmp_path: Path) -> None:
    pytest.importorskip("sphinx")
    lines = (ROOT / "docs" / "conf.py").read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if not line.startswith("apidoc_modules")]
    (tmp_path / "conf.py").write_text("\n".join(kept), encoding="utf-8")
    shutil.copytree(ROOT / "docs" / "_static", tmp_path / "_static")
    (tmp_path / "index.md").write_text("# Index\n", encoding="utf-8")
    (tmp_path / page).write_text(text, encoding="utf-8")
    assert built(tmp_path, tmp_path / "out").returncode != 0
