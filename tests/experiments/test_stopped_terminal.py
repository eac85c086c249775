"""A terminal that was stopped, or a pipe that nobody reads: neither stops a run or its end, or costs a file a line."""

import json
import os
import pty
import re
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from experiments.cli.outlet import Screen
from tests.programs import Program

LINES = 40
RUN = "controller=pi", "scenario=hold", "scenario.minutes=[30]", "hydra.run.dir=run"


def full_pipe() -> tuple[int, int]:
    """Both ends of a pipe that takes nothing more."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    try:
        while True:
            os.write(writer, b"x" * 4096)
    except BlockingIOError:
        os.set_blocking(writer, True)
    return reader, writer


def stopped_terminal() -> tuple[int, int]:
    """Both ends of a terminal in which somebody has typed Ctrl-S."""
    reader, writer = pty.openpty()
    os.write(reader, b"\x13")
    return reader, writer


@pytest.mark.slow
@pytest.mark.parametrize("made", [full_pipe, stopped_terminal])
def test_a_reader_that_stopped_stops_no_run(made: Callable[[], tuple[int, int]], tmp_path: Path) -> None:
    """It ends as one whose output goes to a file, with the same lines in its log and rows in its journal."""
    reader, writer = made()
    found = []
    for name, out in (("file", tmp_path / "out"), ("stopped", Connection(writer))):
        (tmp_path / name).mkdir()
        program = Program("experiments.deploy", *RUN, cwd=tmp_path / name, out=out, WITHOUT_FIGURES="1")
        assert program.wait() == 0
        run = tmp_path / name / "run"
        log = re.sub(r"\d\d:\d\d:\d\d", "", (run / "deploy.log").read_text())
        kinds = [json.loads(line)["kind"] for line in (run / "journal.jsonl").read_text().splitlines()]
        found.append((log, kinds, (run / "recordings" / "M0.csv").read_text()))
    assert found[0] == found[1]
    os.close(reader)


def test_what_a_stopped_reader_did_not_get_is_counted_and_told_when_it_reads_again() -> None:
    reader, writer = full_pipe()
    stream = os.fdopen(writer, "w")
    screen = Screen(stream, size=5)
    for k in range(LINES):
        screen.write(f"line {k}\n")
    got = os.read(reader, 1 << 20)
    while b"line 4\n" not in got:
        got += os.read(reader, 4096)
    screen.write("last\n")  # there is room again
    while b"last\n" not in got:
        got += os.read(reader, 4096)
    lines = got.lstrip(b"x").decode().splitlines()
    kept = [line for line in lines if line.startswith("line")]
    assert kept == [f"line {k}" for k in range(len(kept))]
    assert lines[len(kept)].split()[:2] == ["...", str(LINES - len(kept))]
    screen.close()
    stream.close()
    os.close(reader)
