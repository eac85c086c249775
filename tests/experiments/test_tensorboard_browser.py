"""TensorBoard itself, in a browser: what a training and a deployment wrote is found on its pages, by its names.

BOARD_FIGURES=docs/figures python -m pytest -n0 tests/experiments/test_tensorboard_browser.py     draws those figures
"""

import io
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

from experiments.reporting.curves import TRAINING
from experiments.reporting.tensorboard import Events
from tests.patience import PATIENCE_S
from tests.programs import OURS, ROOT, run

BROWSER = next((b for b in map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome")) if b), None)
DRAWN = os.environ.get("BOARD_FIGURES")
playwright = pytest.importorskip("playwright.sync_api", reason="no playwright (python -m pip install playwright)")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.xdist_group("tensorboard"),  # its tests share the runs and the browser
    pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine (apt-get install chromium)"),
]
LEARNING, DEPLOYMENT = "Learning, several agents" if DRAWN else "Learning", ("Density", "Pump, heat, interlock")
ENVIRONMENT = {**os.environ, **OURS}
SHORT = ["agent.total_steps=300", "agent.learn_start=100"]
LONG = ["agent.total_steps=3000", "n_agents=3"]  # of the figures


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training in `learning`, a deployment in `deployment`."""
    folder = tmp_path_factory.mktemp("logs")
    minutes = [] if DRAWN else ["scenario=hold", "scenario.minutes=[20]", "scenario.setpoints=[0.5]"]
    commands = [
        ("train", *(LONG if DRAWN else SHORT), f"hydra.run.dir={folder / 'learning'}"),
        ("deploy", *minutes, f"hydra.run.dir={folder / 'deployment'}"),
    ]
    if DRAWN:
        commands.append(("train", *LONG, "agent=paper", f"hydra.run.dir={folder / 'learning_paper'}"))
    for name, *words in commands:
        done = run(f"experiments.{name}", *words, cwd=folder)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def address(logs: Path) -> Iterator[str]:
    """TensorBoard on these runs, once it has read them."""
    with served(logs, "result/ise", "result/regret_pct") as url:
        yield url


@contextmanager
def served(logs: Path, *tags: str) -> Iterator[str]:
    """TensorBoard on a folder, once it has read these tags."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words = ["-m", "tensorboard.main", "--logdir", ".", "--host", "127.0.0.1", "--port", str(port)]
    said = logs / "tensorboard.log"
    with open(said, "w", encoding="utf-8") as f:
        process = subprocess.Popen([sys.executable, *words], env=ENVIRONMENT, cwd=logs, stdout=f, stderr=f)
    url, deadline = f"http://127.0.0.1:{port}", time.monotonic() + 120.0
    try:
        while not has_read(url, tags):
            assert process.poll() is None, said.read_text(encoding="utf-8")
            assert time.monotonic() < deadline, "TensorBoard does not answer"
            time.sleep(0.1)
        yield url
    finally:
        process.terminate()
        process.wait(timeout=PATIENCE_S)


def has_read(url: str, tags: tuple[str, ...]) -> bool:
    try:
        with urllib.request.urlopen(f"{url}/data/plugin/scalars/tags", timeout=5) as answer:
            text = answer.read().decode()
    except OSError:
        return False
    return all(tag in text for tag in tags)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as engine:
        # with --disable-gpu the lines of Time Series, which WebGL draws, would be blank
        opened = engine.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield opened
        opened.close()


def show(browser: Any, url: str, *texts: str, height: int = 1000) -> Any:
    """A page once it shows all these texts. Raises: TimeoutError naming the one that is missing."""
    page = browser.new_page(viewport={"width": 1900, "height": height})
    page.goto(url, timeout=60_000)
    for text in texts:
        page.get_by_text(text, exact=True).first.wait_for(state="attached", timeout=40_000)
    return page


def ink(chart: Any) -> int:
    """How many dots of a chart are coloured: lines are, grid and text are not."""
    image = (imread(io.BytesIO(chart.screenshot()))[..., :3] * 255).astype(int)
    coloured = image.max(axis=-1) - image.min(axis=-1) > 25
    return int(coloured.sum())


def draw(page: Any, name: str, shown: str = "", hidden: tuple[str, ...] = ()) -> None:
    """The figure of the documentation, where it is asked for. Args: shown: the one run. hidden: categories."""
    if DRAWN:
        if shown:
            page.get_by_label("Write a regex to filter runs").fill(f"^{shown}$")
        for category in hidden:
            page.get_by_text(category, exact=True).first.click()
        page.wait_for_timeout(3000)
        page.screenshot(path=str(ROOT / DRAWN / f"tensorboard_{name}.png"))
    page.close()


def test_time_series_show_a_card_with_a_line_for_each_tag(address: str, browser: Any) -> None:
    """Called by their tags: how far learning has come, and the culture of the deployment."""
    end = "/iqm" if DRAWN else ""
    learned = [f"{group}/{name}{end}" for group in ("eval", "kept") for name in ("regret_pct", "steady_abs_error")]
    tags = [*learned, f"train/return{end}", "train/epsilon", "culture/od", "culture/setpoint", "pump/rate_ml_s"]
    page = show(browser, f"{address}/?tagFilter=^({'|'.join(tags)})$&smoothing=0#timeseries", height=3000)
    for tag in tags:
        card = page.locator("scalar-card", has=page.locator(f'[title="{tag}"]'))
        card.wait_for(timeout=40_000)
        deadline = time.monotonic() + PATIENCE_S
        while ink(card) < 100:
            assert time.monotonic() < deadline, f"{tag}: no line"
            page.wait_for_timeout(100)
    page.close()


def test_custom_scalars_show_learning_against_its_limits(address: str, browser: Any) -> None:
    titles = ("Regret of the greedy policy, its limit, %", "Steady error at the worst setpoint, its limit", "Loss",
              "Q values", "Exploration, share of random actions", "Reward per episode")  # fmt: skip
    page = show(
        browser,
        f"{address}/?runFilter=learning#custom_scalars",
        f"Learning{', several agents' if DRAWN else ''}",
        *titles,
    )
    draw(page, "learning", "learning", DEPLOYMENT)


def test_custom_scalars_show_the_culture_with_its_band(address: str, browser: Any) -> None:
    titles = ("OD and setpoint with its band of 5 %", "Pump rate, mL/s", "Temperature, °C", "Interlock and warnings")
    page = show(browser, f"{address}/#custom_scalars", *DEPLOYMENT, *titles)
    draw(page, "deployment", "deployment", (LEARNING,))


def test_of_more_runs_than_tensorboard_selects_an_address_shows_those_of_a_day(tmp_path: Path, browser: Any) -> None:
    """As docs/tensorboard.md has it: 41 runs are none at first sight."""
    for k in range(41):
        with closing(Events(tmp_path / f"2026-11-{1 + k % 20:02d}_{k:02d}")) as events:
            events.layout(TRAINING)
            events.scalars({"eval/regret_pct": 1.0 + k, "last/one" if k == 40 else "some/other": 1.0}, 0)
    with served(tmp_path, "last/one") as url:
        for words, picked in (("", 0), ("&regexInput=2026-11-05", 2)):
            page = show(browser, f"{url}/#custom_scalars{words}", "2026-11-05_04", "2026-11-05_24")
            boxes = page.locator("tf-multi-checkbox paper-checkbox")
            assert boxes.count() == (picked or 41)
            assert sum(box.get_attribute("aria-checked") == "true" for box in boxes.all()) == picked
            page.close()


def test_hparams_show_what_was_varied_and_what_came_out(address: str, browser: Any) -> None:
    columns = ("agent or controller", "model or plant", "seed", "mu, 1/min", "tau", "command", "scenario", "steps",
               "given")  # fmt: skip
    results = ("regret, %", "worst-setpoint error, OD", "ISE, OD² min", "error of the share")
    page = show(browser, f"{address}/#hparams", *columns, *results)
    draw(page, "hparams")
