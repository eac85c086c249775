"""Ctrl-C, SIGTERM and SIGHUP end a command with one line that says what it keeps; a stopped reader ends nothing."""

import contextlib
import json
import os
import pty
import re
import shlex
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from dqn import checkpoint
from experiments.cli import frame, stop
from experiments.cli.outlet import Screen
from experiments.reporting.tensorboard import Events
from experiments.training.config import TrainConfig
from experiments.training.session import Session
from tests import programs
from tests.patience import PATIENCE_S
from tests.programs import Program

BLANK = {"WITHOUT_FIGURES": "1"}
SHORT = ["agent=paper", "agent.total_steps=1000", "agent.learn_start=100", "eval_every=200"]


class Run(Program):
    """A command in a folder of its own, known by a mark that all its processes inherit."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.folder, mark = folder, uuid4().hex
        self._mark = f"RUN_OF_TEST={mark}".encode()
        super().__init__(*words, cwd=folder, out=folder / "out", err=folder / "err", **BLANK, RUN_OF_TEST=mark)

    def processes(self) -> list[int]:
        """Every living process of the command, also those in sessions of their own."""
        found = [self.pid] if self.poll() is None else []
        for path in Path("/proc").glob("[0-9]*/environ"):
            with contextlib.suppress(OSError):  # gone meanwhile, or somebody else's
                found += [int(path.parent.name)] if self._mark in path.read_bytes() else []
        return found

    def until_said(self, words: str) -> None:
        """Wait for standard output to hold `words`."""
        self.until(lambda: words in (self.folder / "out").read_text())

    def until_there(self, pattern: str, lines: int = 0) -> None:
        """Wait for a file with something in it, or with more than so many lines."""
        paths = self.folder.glob
        self.until(lambda: any(p.stat().st_size and p.read_bytes().count(b"\n") >= lines for p in paths(pattern)))

    def ctrl_c(self, number: int = signal.SIGINT) -> None:
        """As a terminal does: to every process of the foreground group."""
        os.killpg(self.pid, number)

    def stopped(self) -> str:
        """The one line on standard error, after the command has ended as a stopped one and left no process."""
        status, told = self.wait(), (self.folder / "err").read_text()
        assert status == 130, told
        assert len(told.splitlines()) == 1, told
        assert "Traceback" not in (self.folder / "out").read_text()
        self.gone()
        return told.strip()

    def gone(self) -> None:
        """Wait until no process is left; one that was ended may take a moment."""
        deadline = time.monotonic() + PATIENCE_S
        while self.processes():
            assert time.monotonic() < deadline, self.processes()
            time.sleep(0.02)


def go_on(run: Run, line: str) -> None:
    """Run the command that the line names, as it stands there."""
    told = re.search(r"continue with: python (-m [\w.]+ resume=.+)$", line)
    assert told, line
    done = programs.run(*shlex.split(told[1])[1:], cwd=run.folder, **BLANK)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_stopped_training_goes_on_to_the_bit_with_the_command_it_names(tmp_path: Path) -> None:
    run = Run(tmp_path, "experiments.train", *SHORT, "hydra.run.dir=a folder")  # one that needs quotes
    run.until_there("a folder/progress.csv", lines=2)
    run.terminate()
    line = run.stopped()
    assert "keeps checkpoint.pt, progress.csv; " in line
    assert "stopping at the end of this episode" in (tmp_path / "out").read_text()
    go_on(run, line)
    config = frame.load(frame.compose("train", SHORT), TrainConfig())
    (tmp_path / "whole").mkdir()
    whole = Session(config, tmp_path / "whole")
    whole.run()
    whole.writer.close()
    resumed = Session(config, tmp_path / "a folder", resume=True)
    resumed.writer.close()
    assert resumed.agents.weights().equal(whole.agents.weights())
    assert resumed.best.history == whole.best.history


@pytest.mark.slow
def test_an_impatient_user_gets_out_at_once_and_keeps_what_was_saved(tmp_path: Path) -> None:
    run = Run(tmp_path, "experiments.train", *SHORT, "n_agents=128", "checkpoint_every=100", "hydra.run.dir=run")
    run.until_there("run/checkpoint.pt")
    run.send_signal(signal.SIGHUP)
    run.until_said("stopping")
    run.ctrl_c()
    assert run.stopped()
    assert checkpoint.load(tmp_path / "run/checkpoint.pt")["returns"]


@pytest.mark.slow
def test_a_stopped_benchmark_ends_its_workers(tmp_path: Path) -> None:
    words = ["+experiment=comparison", "workers=2", "replicates=200", "train_seeds=1", "hydra.run.dir=run"]
    run = Run(tmp_path, "experiments.benchmark", *words)
    run.until_there("run/training/dqn/progress.csv", lines=2)
    run.ctrl_c(signal.SIGTERM)  # its workers get it too
    assert run.stopped() == "stopped; run keeps training/; to try again, start a new run"
    assert (tmp_path / "run/training/dqn/checkpoint.pt").is_file()


def _saves(folder: Path) -> None:
    """Work that can be saved between two steps, of half a second each."""
    with stop.pausing("at the end of this step") as stopping:
        (folder / str(os.getpid())).touch()
        while not stopping():
            time.sleep(0.5)
        (folder / "saved").touch()


@pytest.mark.slow
def test_a_worker_told_by_the_terminal_and_by_its_command_saves_what_it_did(tmp_path: Path) -> None:
    with contextlib.suppress(KeyboardInterrupt), stop.Workers(1) as workers:
        workers.submit(_saves, tmp_path)
        while not (there := list(tmp_path.iterdir())):
            time.sleep(0.02)
        os.kill(int(there[0].name), signal.SIGTERM)
        time.sleep(0.1)
        raise KeyboardInterrupt
    assert (tmp_path / "saved").is_file()


def test_a_stop_while_an_extension_module_loads_is_a_stop() -> None:
    masked = ImportError("initialization failed")
    masked.__cause__ = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt), stop.unmasked():
        raise masked
    with pytest.raises(ImportError, match="no module"), stop.unmasked():
        raise ImportError("no module")


@pytest.mark.parametrize("kept", [stop.interrupts, stop.one_interrupt])
@pytest.mark.parametrize("writes", [False, True])
def test_a_stop_that_a_library_takes_for_an_error_of_its_own_is_not_lost(kept, writes):
    """NumPy asks the type of an operand whether it has `__array_ufunc__`, and takes any error for a no.

    When the stop is raised again something may just be written, which is written to its end.
    """

    class Asked(type):
        def __getattr__(cls, name: str) -> None:
            if name == "__array_ufunc__":
                os.kill(os.getpid(), signal.SIGTERM)
            raise AttributeError(name)

    class Operand(metaclass=Asked):
        pass

    seen = []

    def work() -> None:
        with kept():
            seen.append((np.zeros(2) == Operand()) is not None)
            with stop.undisturbed() if writes else contextlib.nullcontext():
                time.sleep(3 * stop.AGAIN_S)
                seen.append("written")
            seen.append("gone on")

    with pytest.raises(KeyboardInterrupt):
        work()
    assert seen == [True, "written"][: 1 + writes]


def test_a_stop_that_was_heard_is_not_repeated_while_the_pumps_are_switched_off() -> None:
    with stop.one_interrupt():
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        stop.heard()
        for _ in range(2):
            time.sleep(2 * stop.AGAIN_S)
            os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(2 * stop.AGAIN_S)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.parametrize("kept", [stop.interrupts, stop.one_interrupt, lambda: stop.pausing("later")])
def test_a_closed_terminal_ends_nothing_that_was_started_to_outlive_it(kept: Callable[[], Any]) -> None:
    """Under `nohup` SIGHUP is ignored; Ctrl-C of another terminal is not."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with kept() as waits:
            try:
                os.kill(os.getpid(), signal.SIGHUP)
            except KeyboardInterrupt:
                pytest.fail("it was stopped")
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
            assert not (waits and waits())
            with pytest.raises(KeyboardInterrupt) if waits is None else contextlib.nullcontext():
                os.kill(os.getpid(), signal.SIGINT)
            assert waits is None or waits()
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("kept", [stop.interrupts, stop.one_interrupt])
def test_a_stop_waits_until_the_writer_of_events_holds_no_lock(kept, tmp_path, monkeypatch):
    written: list[str] = []

    def slow(of: str, call: Callable[..., None]) -> Callable[..., None]:
        def write(*given: object) -> None:
            os.kill(os.getpid(), signal.SIGINT)
            call(*given)
            written.append(of)

        return write

    events = Events(tmp_path)
    for of, call in (("add_event", lambda: events.scalars({"a": 1.0}, 1)), ("flush", events.flush)):
        with monkeypatch.context() as patched, kept():
            patched.setattr(events._writer, of, slow(of, getattr(events._writer, of)))
            with pytest.raises(KeyboardInterrupt):
                call()
        assert written[-1:] == [of]
    with kept(), pytest.raises(KeyboardInterrupt):
        slow("elsewhere", lambda: None)()  # it comes at once
    assert written == ["add_event", "flush"]
    events.close()


@pytest.mark.slow
def test_workers_do_not_outlive_a_killed_command(tmp_path: Path) -> None:
    run = Run(tmp_path, "tests.campaigns.faults", "workers=2")
    run.until(lambda: len(run.processes()) >= 3)  # the command and two workers
    run.kill()
    run.gone()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "there", "kept"),
    [
        ("tests.campaigns.soak", "state.json", "certificate.json, journal.jsonl, policy.npz, recordings/, state.json"),
        ("experiments.calibrate coverage=1000", "config.yaml", "no result"),
    ],
)
def test_a_stopped_command_says_what_it_keeps(words: str, there: str, kept: str, tmp_path: Path) -> None:
    run = Run(tmp_path, *words.split(), "hydra.run.dir=run")
    run.until_there(f"run/{there}")
    run.ctrl_c()
    assert run.stopped() == f"stopped; run keeps {kept}; to try again, start a new run"


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_demo_is_silent_but_for_its_step(number: int, tmp_path: Path) -> None:
    run = Run(tmp_path, "experiments.demo")
    run.until_said("fitting")
    run.send_signal(number)
    assert "1_calibrate keeps no result" in run.stopped()
    assert "experiments.train" not in (tmp_path / "out").read_text()


def test_signals_that_waited_go_each_once_to_whoever_listened_for_them(capsys: pytest.CaptureFixture[str]) -> None:
    """A cluster may repeat its own; nothing is passed on twice."""
    heard: list[int] = []
    with stop.handled(lambda number, frame: heard.append(number), signal.SIGUSR1, signal.SIGTERM):
        with stop.pausing("at the next step") as pause:
            assert not pause()
            for number in (signal.SIGUSR1, signal.SIGUSR1):
                signal.raise_signal(number)
            assert pause()
            assert heard == []
            pause.pass_on()
            assert (heard, pause()) == ([signal.SIGUSR1], False)
            signal.raise_signal(signal.SIGTERM)
            pause.pass_on()
        signal.raise_signal(signal.SIGTERM)  # as before
    assert heard == [signal.SIGUSR1, signal.SIGTERM, signal.SIGTERM]
    said = capsys.readouterr().out.splitlines()
    assert said == ["stopping at the next step; a second signal stops at once"] * 2


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
