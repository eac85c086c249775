"""Run of `deploy`: the loop to its end or an error, pumps verified off, figure and summary."""

import logging
import os
import shlex
from contextlib import closing
from pathlib import Path

from tqdm import tqdm
from tqdm.contrib.logging import logging_redirect_tqdm

from experiments.cli import files, frame, outlet
from experiments.cli.frame import swept
from experiments.cli.stop import heard, one_interrupt
from experiments.control import assemble, messages, notify
from experiments.control.assemble import Setup
from experiments.control.config import DeployConfig
from experiments.control.notify import Notifier
from experiments.loop.loop import ClosedLoop
from experiments.loop.signals import Draws
from experiments.record.curves import windows_table
from experiments.record.messages import AlarmsTold
from experiments.record.record import Record
from experiments.record.summary import ChangeLog, figure_of, reasons_line, summarise
from experiments.reporting import charts
from hardware.clock import boot
from hardware.errors import ReactorError, RecordingError
from hardware.storage.marks import NAME, Mark, read_marks
from hardware.watched import Watched

log = logging.getLogger(__name__)


class BenchMarks:
    """Measurements that users enter with `mark` during a run: each is passed to the loop once, also after a resume."""

    def __init__(self, record: Record) -> None:
        self._record, self._size = record, -1
        self._taken = sum(row["kind"] in ("level", "share", "bottle") for row in record.journal.rows)

    def take(self, loop: ClosedLoop) -> None:
        """Pass new measurements to the loop; a damaged file gives a warning. Raises: RecordingError of the journal."""
        path = self._record.folder / NAME
        size = path.stat().st_size if path.is_file() else -1
        if size == self._size:
            return
        self._size = size
        try:
            marked = [mark for mark in read_marks(self._record.folder) if mark.measured]
        except RecordingError as error:
            log.warning("%s", error)
            return
        for mark in marked[self._taken :]:
            self._taken += 1
            self._tell(loop, mark)

    def _tell(self, loop: ClosedLoop, mark: Mark) -> None:
        known, journal = mark.reactor in loop.reactors.names, self._record.journal
        if mark.level_ml is not None:
            journal.append("level", {"reactor": mark.reactor, "level_ml": mark.level_ml})
            if known:
                before = loop.set_level(mark.reactor, mark.level_ml)
                log.info(messages.LevelMarked(reactor=mark.reactor, level_ml=mark.level_ml, ledger_ml=before))
        if mark.bottle_ml is not None:
            journal.append("bottle", {"reactor": mark.reactor, "bottle_ml": mark.bottle_ml})
            if known:
                loop.refilled(mark.reactor, mark.bottle_ml)
                log.info(messages.BottleMarked(reactor=mark.reactor, bottle_ml=mark.bottle_ml))
        if mark.share is not None and mark.sd is not None:
            counted = mark.share, mark.sd, mark.time_min
            journal.append(
                "share", {"reactor": mark.reactor, **dict(zip(("share", "sd", "minute"), counted, strict=True))}
            )
            if known:
                answer, doubtful = loop.counted(mark.reactor, *counted)
                share, sd, minute = counted
                told = messages.ShareMarked(reactor=mark.reactor, answer=answer, share=share, sd=sd, minute=minute)
                log.log(logging.WARNING if doubtful else logging.INFO, told)


def _run(loop: ClosedLoop, record: Record, tell: Notifier) -> str:
    """Run the loop to its end or an error, then verify all pumps off in any case; return the outcome."""
    log_changes, marks, reactors = ChangeLog(loop, tell), BenchMarks(record), loop.reactors
    outcome = "failed: see the log"
    record.journal.append("start", {"time_s": round(reactors.elapsed(), 3), "pid": os.getpid(), "boot": boot()})
    try:
        with logging_redirect_tqdm(), tqdm(disable=None, unit="sample") as bar:
            for step in loop.run():
                record.done(step, loop.state())
                log_changes(step)
                marks.take(loop)
                bar.update(int(step.rows.sum()))
        given_up = [name for name, s in zip(reactors.names, loop.stopped, strict=True) if s]
        outcome = f"stopped by the interlock: {', '.join(given_up)}" if given_up else "completed"
    except KeyboardInterrupt:
        heard()
        outcome = "stopped by the operator"
    except ReactorError as error:
        outcome = f"failed: {error}"
    except Exception as error:  # after any error the recorded part still needs a summary
        log.exception("the run ends because of an error")
        outcome = f"failed: {type(error).__name__}: {error}"
    finally:
        try:
            reactors.stop()
            left = ", ".join(n for n, h in zip(reactors.names, reactors.handed_over, strict=True) if h)
            if isinstance(reactors, Watched):
                log.info(messages.OnlyWatched())
            else:
                log.info(messages.PumpsOff(left=f"; {left}: regulated by the device itself" if left else ""))
        except ReactorError as error:
            outcome = f"failed: {error}"
    return outcome


def _finish(record: Record, setup: Setup, loop: ClosedLoop, outcome: str) -> str:
    """Write figures and summary.json after any outcome; return the outcome, "failed" if they cannot be written."""
    folder = record.folder
    try:  # if a signal or an error ended the loop during a dose, the row of that sample is still missing
        record.complete()
    except (RecordingError, OSError) as error:
        log.warning("%s", error)
    try:
        title = f"{setup.title}: {outcome}"
        table = record.table()
        figures = {"closed_loop": figure_of(table, setup.scenarios, title)}
        for signal in setup.further:
            figures |= signal.draw(table, title) if isinstance(signal, Draws) else {}
        pictures = {name: charts.save(figure, folder / "figures", name) for name, figure in figures.items()}
        summary = {
            **summarise(table, setup.scenarios, setup.roles, outcome, loop.progress),
            "figure": str(folder / "figures" / "closed_loop.png"),
        }
        files.write_json(folder / "summary.json", summary)
        record.curves.end(summary, setup.row, pictures)
    except OSError as error:
        return str(messages.DiskFull(outcome=outcome.removeprefix("failed: "), why=error.strerror or error))
    log.info("%s after %.0f min, %.1f mL of fresh medium", outcome, summary["minutes"], summary["volume_ml"])
    for name, rows in zip(record.names, record.rows, strict=True):
        if line := reasons_line(rows):
            log.warning(AlarmsTold(reactor=name, kinds=line))
    log.info("windows; settled: time until |e| stays within 5 %%\n%s", windows_table(summary["windows"]))
    log.info("recordings %s; figure %s", folder / "recordings", summary["figure"])
    log.info("next, write all results on one page: python -m experiments.report run=%s", shlex.quote(str(folder)))
    return outcome


def deploy(config: DeployConfig, folder: Path) -> None:
    """Run the closed loop of a config over its scenario, and write its output files. Raises: UserError."""
    outlet.detach()
    if (whole := assemble.completed(config, folder)) != config:
        config = whole
        frame.save_config(config, folder)
    setup = assemble.unpack(config, folder)
    if config.preflight_only:
        assemble.run_preflight(setup, folder)
        return
    tell, outcome = notify.opened(config.notify, folder, setup.resumed), "ended before its summary: see the log"
    try:
        outcome = _recorded(setup, folder, tell)
    except (ReactorError, frame.UserError) as error:
        outcome = f"failed: {error}"
        raise frame.UserError(str(error)) from None
    finally:
        tell("end", outcome)
        tell.close()
    if outcome.startswith("failed"):
        raise frame.UserError(outcome)
    if outcome == "stopped by the operator" and swept():
        raise KeyboardInterrupt  # the operator also ends the sweep that this job belongs to


def _recorded(setup: Setup, folder: Path, tell: Notifier) -> str:
    """Run the loop with all its output files; return the outcome. Raises: ReactorError, UserError."""
    kept = setup.backend.reactors, setup.fsync, setup.columns
    with one_interrupt(), closing(Record(folder, *kept)) as record:
        for repair in record.repairs:
            log.warning("%s", repair)
        longest, title = max(s.total_min for s in setup.scenarios), f"{setup.title}, {', '.join(kept[0])}"
        log.info("%s: schedule of %g min (%.1f h), after the culture has grown", title, longest, longest / 60.0)
        log.info("writes to %s; watch it with: tensorboard --logdir %s", folder, shlex.quote(str(folder)))
        with assemble.opened(setup, record) as loop:
            tell("start", f"{'resumed' if setup.resumed else 'started'}: {', '.join(loop.reactors.names)}")
            outcome = _run(loop, record, tell)
        return _finish(record, setup, loop, outcome)
