"""Every command of README and docs does what the page says, or needs hardware; every source that is cited is there.

All commands are checked against what they take. Those of the README run, each behind the ones whose files it reads,
with less work for the long ones; `-m campaign` runs all the others.

A citation is `docs/NAME.md` or `docs/NAME.md, Heading`, with further headings after commas and `and`. What follows the
comma with a capital letter is a heading; a semicolon ends the list.
"""

import importlib
import json
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

from tests import programs
from tests.documented import OPEN, PAGES, ROOT, commands, needs_hardware
from tests.patience import PATIENCE_S

OTHERS = (
    "experiments", "experiments.demo", "experiments.cli.reference", "hardware.emulator", "hardware.rig",
    "turbidostat",
)  # fmt: skip
SHOWN = {
    " ".join(words): words
    for page in PAGES
    if page.name != "extending.md"  # whose commands a test of its own runs
    for words in commands(page)
    if words[0] not in OTHERS
}
RECORDINGS = "RECORDING.csv", "FILE.csv", "chibio_ecoli_dither.csv"
LESS = {
    "tests.campaigns.rig_study": ['overrides=[scenario.recovery_od=0.7,"scenario.minutes=[3,3,3]"]'],
    "experiments.train": ["agent.total_steps=300", "agent.learn_start=100", "n_agents=2"],
    "tests.studies.ablate": ["agent.total_steps=300", "n_agents=2"],
    "experiments.benchmark": ["replicates=1", "train_seeds=1"],
    "tests.campaigns.faults": ["controls=0", "moments=[dose]", "faults=[feed weak]"],
    "tests.campaigns.kills": ["kills=2", "runs=1"],
    "tests.campaigns.soak": ["days=0.05"],
}
"""Command -> what makes it shorter here without leaving out a part of it."""


def ready(folder: Path) -> None:
    """Files that the pages take for granted: runs of earlier commands, recordings of the reader's own."""
    for name in ("RUN", "SWEEP"):
        (folder / name).mkdir()
        (folder / name / "config.yaml").write_text("seed: 0\n", encoding="utf-8")
    run = folder / "RUN"
    shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", run)
    for name in RECORDINGS:
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", folder / name)
    calibrated = folder / "runs" / "calibrate" / "1"
    calibrated.mkdir(parents=True)
    for path in (calibrated, run):
        (path / "calibrated.yaml").touch()
        (path / "twin.yaml").touch()
    train = folder / "runs" / "train" / "1"
    train.mkdir(parents=True)
    for name in ("config.yaml", "checkpoint.pt", "sweep.json"):
        (train / name).touch()


@pytest.mark.parametrize("shown", SHOWN)
def test_a_command_of_the_pages_is_one_that_the_program_takes(
    shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready(tmp_path)
    monkeypatch.chdir(tmp_path)
    program, *words = SHOWN[shown]
    swept = "-m" in words
    given = [w for w in words if w != "-m" and not w.startswith("--help")]
    if swept:  # one of its jobs
        given = [re.sub(r",.*$", "", w.replace("=range(", "=")) for w in given]
    assert (ROOT / f"{program.replace('.', '/')}.py").is_file()
    importlib.import_module(program).main.config(given)


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_a_shell_passes_the_words_of_every_line_on_as_they_stand(shell: str, tmp_path: Path) -> None:
    """Pages and the comments of the presets, which `--help` prints; zsh refuses a bracket that is not quoted."""
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    presets = [path for room in ("conf", "tests") for path in (ROOT / room).rglob("*.yaml")]
    text = re.sub(r"\\\n\s*", "", "\n".join(path.read_text(encoding="utf-8") for path in (*PAGES, *presets)))
    shown = re.findall(r"(?:^ {4}|^# {3}|`)(python -m .*?)(?= {2}|`|$| \| | > | #)", text, re.MULTILINE)
    lines = [line for line in shown if not OPEN.search(line)]
    script = "\n".join(["python() { printf '%s\\n' \"$*\"; }", *lines])
    plain = {"PATH": os.environ["PATH"], "HOME": "$HOME"}
    done = subprocess.run(
        [shell, "-c", script], cwd=tmp_path, env=plain, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [" ".join(shlex.split(line)[1:]) for line in lines]


def test_the_pages_have_commands_at_all() -> None:
    assert len(SHOWN) > 70
    assert sum(needs_hardware(words) for words in SHOWN.values()) >= 6


def run(words: list[str], folder: Path, seconds: float = PATIENCE_S, **environment: str) -> None:
    done = programs.run(*words, cwd=folder, seconds=seconds, HOME=str(folder), **environment)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr[-2000:]}"


def shorter(words: list[str]) -> list[str]:
    """The same command with less to do; an emulated device runs as fast as this machine can follow."""
    less = LESS.get(words[0], [])
    if any(word.startswith("resume=") for word in words):
        return words
    if words == ["experiments.deploy", "scenario=ratio_steps"]:
        less = ["scenario.minutes=[20,20,20,20]"]
    if "backend=emulator" in words:
        less = ["scenario.minutes=[2,2,2]", "scenario.recovery_od=0.3", "backend.reactors=[M0]"]
        if any("ratio" in word or "plant=coculture" in word for word in words):
            one = ["setpoints=[0.5]", "minutes=[5]", "temperatures=[33.2]", "ratios=[0.3]"]
            less = [*(f"scenario.{values}" for values in one), "backend.reactors=[M0]"]
    return [*words, *less]


README = {
    " ".join(words): words
    for words in commands(ROOT / "README.md")
    if words[0] not in ("turbidostat", "experiments.demo", "experiments.certify", "hardware.emulator")
    and not needs_hardware(words)
}
QUICK = (
    "experiments", "experiments.calibrate", "experiments.train env_file=latest",
    "experiments.deploy policy=latest env_file=latest",
)  # fmt: skip
"""Lines of every run of the suite; their figures are blank."""


def before(shown: str) -> str | None:
    """The line of the README whose files this one reads."""
    lines = [*README][: [*README].index(shown)]
    if "policy=latest" in shown:
        writer = "train env_file=latest"
    elif "_file=latest" in shown or "report" in shown:
        writer = "-m " if "runs=" in shown else "calibrate"
    else:
        writer = "stop_within" if "resume=latest" in shown else None
    return None if writer is None else next(line for line in lines if writer in line)


@pytest.fixture(scope="module")
def lived(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of somebody who typed a line of the README, and before it those that it needs."""

    @cache
    def typed(shown: str) -> Path:
        folder = tmp_path_factory.mktemp("reader")
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", folder / "YOURS.csv")
        if earlier := before(shown):
            shutil.copytree(typed(earlier), folder, dirs_exist_ok=True)
        plain = {"WITHOUT_FIGURES": "1"} if shown in QUICK else {}
        run(shorter(README[shown]), folder, **plain)
        return folder

    return typed


@pytest.mark.numeric
@pytest.mark.xdist_group("readme")
@pytest.mark.parametrize(
    "shown", [pytest.param(line, marks=[] if line in QUICK else pytest.mark.slow) for line in README]
)
def test_a_line_of_the_readme_works(shown: str, lived: Callable[[str], Path]) -> None:
    lived(shown)


@pytest.mark.numeric
@pytest.mark.slow
def test_the_way_of_the_readme_from_a_recording_to_the_device_is_completed(tmp_path: Path) -> None:
    """Calibrate, train, certify, preflight, run: by the Chi.Bio driver over sockets, and nothing is forced."""
    lines = list(commands(ROOT / "README.md"))
    [server] = [words for words in lines if words[0] == "hardware.emulator"]
    [check, deploy] = [words for words in lines if any(word.startswith("backend.url=") for word in words)]
    run(["experiments.calibrate"], tmp_path)
    run(["experiments.train", "env_file=latest", "stop_within=2"], tmp_path)
    refused = programs.run(*deploy, cwd=tmp_path)
    assert (refused.returncode, "force_policy" in refused.stderr) == (1, True)
    run(["experiments.certify", "policy=latest"], tmp_path)
    with programs.Program(*server, "--port", "0", cwd=tmp_path, out=tmp_path / "said") as device:
        device.until(lambda: "emulator ready" in device.said())
        [url] = re.findall(r"ready: (http://\S+)", device.said())
        here = [f"backend.url={url}" if word.startswith("backend.url=") else word for word in deploy]
        run([*here, "preflight_only=true"], tmp_path)
        run([*here, "scenario.minutes=[3,2,2]", "scenario.recovery_od=0.3"], tmp_path)
    assert set(check) - set(deploy) == {"preflight_only=true"}
    [summary] = tmp_path.glob("runs/deploy/*/summary.json")
    assert json.loads(summary.read_text())["outcome"] == "completed"


def test_the_readme_has_lines_that_need_no_hardware() -> None:
    assert len(README) > 12
    assert set(QUICK) <= set(README)


@pytest.mark.campaign
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("shown", [name for name in SHOWN if name not in README and not needs_hardware(SHOWN[name])])
def test_a_command_of_the_pages_runs(shown: str, tmp_path: Path) -> None:
    run(["experiments.calibrate", "hydra.run.dir=RUN"], tmp_path)
    if "resume=RUN" in shown or "run=RUN" in shown:
        run(["experiments.deploy", "hydra.run.dir=RUN"], tmp_path)
    shutil.copy(ROOT / "dqn" / "shipped" / "policy.npz", tmp_path / "RUN")
    for name in RECORDINGS:
        shutil.copy(ROOT / "experiments" / "data" / "open_loop.csv", tmp_path / name)
    run(shorter(SHOWN[shown]), tmp_path, 3000.0)


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
