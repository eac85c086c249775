"""A run that learns from itself: trainings in a process of their own, and who flies after them.

The loop never waits for one. Every training is asked for and judged in the journal, which names the policy in force of
each reactor at any moment; a run that is resumed goes on with those.
"""

import json
import logging
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from dqn import policy as policies
from dqn.policy import Policy
from experiments.cli import frame
from experiments.control.policies import FIRST, LEARNT, flown, named
from experiments.control.question import LEAST_H, Question, Relearn, Verdict
from experiments.laws.share.estimator import CompositionEstimator
from experiments.laws.share.learned import LearnedLaw
from experiments.laws.share.recall import Recall
from experiments.loop.loop import ClosedLoop, Step
from experiments.loop.share import Share, program_of
from experiments.record.record import Record
from hardware import memory
from hardware.errors import RecordingError
from hardware.storage import atomic

__all__ = ["Relearning"]

log = logging.getLogger(__name__)

PAUSE_S = 600.0  # after a disk that refused
END_S = 10.0  # that a training has to end
ROW = ("n", "wall", "mono", "kind")  # of every row of a journal


class Relearning:
    """The trainings of one run, one after another.

    Args: config: when and with what. loop: whose share is decided by a learned law. record: of the run. limits: of the
      thermostat, degC. tell: is told of a policy that flies. clock: real time, s.
    Attributes: learned: of every training that was judged, a row for the summary.
    Raises: UserError for a policy that the journal names and that cannot be read.
    """

    def __init__(
        self,
        config: Relearn,
        loop: ClosedLoop,
        record: Record,
        limits: tuple[float, float],
        tell: Callable[[str, str, str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        share = next(s for s in loop.signals if isinstance(s, Share))
        if not isinstance(share.law, LearnedLaw) or not isinstance(share.estimator, Recall):
            raise frame.UserError(f"relearn.every_h = {config.every_h}: the law of the share follows no policy")
        self._every_h = config.every_h or 0.0
        self.config, self._loop, self._record, self._limits = config, loop, record, limits
        self._share, self._law, self._recall = share, share.law, share.estimator
        self._tell, self._clock, self._folder = tell, clock, record.folder / LEARNT
        self._names, n = loop.reactors.names, len(loop.reactors.names)
        model = self._law.policy.metadata["model"]
        first = [model.get(key, 1.0) - 1.0 for key in ("scale_e", "scale_p")]
        self._last_min, self._trained = np.zeros(n), np.tile(first, (n, 1))  # newest training of each: when, on what
        self._why = ["off"] * n  # each learns nothing now
        self._child: subprocess.Popen[bytes] | None = None
        self._asked: Question | None = None
        self._began, self._ended, self._rests, self._last = 0.0, np.inf, -np.inf, 0
        self.learned: list[dict[str, Any]] = []
        self._remember(record.journal.rows)

    def _remember(self, rows: list[dict[str, Any]]) -> None:
        """Go on where earlier lives of the run were: policies in force, and a training that was cut."""
        asked = {row["number"]: row for row in rows if row["kind"] == "learn"}
        judged = {row["number"]: row for row in rows if row["kind"] == "judged"}
        self.learned = [{k: v for k, v in row.items() if k not in ROW} for row in judged.values()]
        for number, row in asked.items():
            if row["reactor"] in self._names:
                n = self._names.index(row["reactor"])
                self._last_min[n] = row["minute"]
                if "errors" in judged.get(number, ()):
                    self._trained[n] = row["curves"]
        for name, number in flown(rows).items():
            if name in self._names:
                self._follow(name, number, self._read(self._record.folder / named(number)))
        self._last = max(asked, default=0)
        if self._last and self._last not in judged and self._every_h:
            self._go_on(asked[self._last])

    def _go_on(self, row: Mapping[str, Any]) -> None:
        """A training that an earlier life of the run began: what it found stands, else it goes on where it was cut."""
        number, name = row["number"], row["reactor"]
        if name not in self._names:
            return
        try:
            self._asked = Question.read(self._folder / f"{number:03d}.json")
        except ValueError as error:
            self._judged(number, name, None, f"could not begin: {error}")
            return
        verdict = self._found(number)
        if verdict is not None:
            self._judged(number, name, verdict, "")
            return
        log.info("%s: training %03d goes on where it was cut", name, number)
        self._begin(self._asked)

    @staticmethod
    def _read(path: Path) -> Policy:
        try:
            return policies.load(path)
        except policies.PolicyError as error:
            remedy = "it was in force by the journal: put it back, or begin a new run"
            raise frame.UserError(f"{error}; {remedy}") from None

    def _follow(self, name: str, number: int, policy: Policy) -> None:
        with frame.refusing(ValueError):
            self._law.follow(self._names.index(name), number, policy)

    def take(self, step: Step) -> None:
        """Look after the training under way, or begin the next one that is due. Raises: RecordingError."""
        try:
            if self._every_h:
                self._weigh(step)
            if self._child is not None:
                self._look()
            elif self._clock() >= self._rests:
                self._choose(step)
        except RecordingError:  # of the journal, without which no run goes on
            raise
        except Exception as error:  # whatever it is, cultures are fed without it
            again = f"looked at again in {PAUSE_S / 60.0:.0f} min"
            log.warning("no training now (%s: %s); %s", type(error).__name__, error, again)
            self._rests = self._clock() + PAUSE_S

    def _weigh(self, step: Step) -> None:
        """Who is due, by the newest sample of each; what others wait for is said once it is their turn."""
        for n in map(int, np.flatnonzero(step.rows)):
            before, self._why[n] = self._why[n], self._not_yet(n, step)
            overdue = step.minute[n] - self._last_min[n] >= 60.0 * self._every_h
            if self._why[n] and overdue and kind_of(self._why[n]) != kind_of(before):
                log.info("%s: no training yet: %s", self._names[n], self._why[n])

    def _choose(self, step: Step) -> None:
        """Of those that are due who has waited longest, with a sample of now."""
        due = [n for n, why in enumerate(self._why) if not why]
        if due and step.rows[longest := min(due, key=lambda n: self._last_min[n])]:
            self._ask(longest, step)

    def _not_yet(self, n: int, step: Step) -> str:
        """Why reactor n learns nothing now; "" if it does."""
        elapsed, schedule = float(step.elapsed[n]), self._share.schedules[n]
        if step.minute[n] - self._last_min[n] < 60.0 * self._every_h:
            return f"the last training began less than {self._every_h:g} h ago"
        if not elapsed >= 0.0 or self._loop.stopped[n] or not schedule.composed:
            return "no share is asked for"
        if self._recall.behind or not self._estimator.since[n] >= step.minute[n] - 1e-6:
            return "the estimate is not of now"
        errors, sds = self._curves(n)
        if sds.max() > self.config.sd:
            return f"the growth curves are known to {sds.max():.3f}, not to {self.config.sd:g}"
        if np.abs(errors - self._trained[n]).max() < self.config.moved:
            return f"the growth curves are within {self.config.moved:g} of those of the policy or of the last training"
        ahead = np.arange(elapsed, min(elapsed + 60.0 * self.config.hours, schedule.total_min))
        if np.isfinite(program_of(schedule).setpoint(ahead)).sum() < 60.0 * LEAST_H:
            return f"a share is asked for in less than {LEAST_H:g} h to come"
        return ""

    @property
    def _estimator(self) -> CompositionEstimator:
        return self._recall.estimator

    def _curves(self, n: int) -> tuple[Any, Any]:
        errors, sds = self._estimator.growth_errors()
        return errors[n], sds[n]

    def _ask(self, n: int, step: Step) -> None:
        """The question on the disk, then in the journal, then its process."""
        number, (errors, sds), name = self._last + 1, self._curves(n), self._names[n]
        schedule, alone = self._share.schedules[n], self._estimator.of(np.array([n]))
        begun = float(self._record.rows[n].columns["time_min"][0]) if len(self._record.rows[n]) else 0.0
        asked = Question(
            number, name, (begun, float(step.minute[n])), float(step.elapsed[n]), tuple(errors.tolist()),
            tuple(sds.tolist()), memory.save(alone), asdict(alone.config), asdict(alone.pair),
            asdict(schedule), asdict(self.config), float(alone.volumes_ml[0]), self._limits, self._law.config.kind,
            named(int(self._law.number[n])) if self._law.number[n] else FIRST,
        )  # fmt: skip
        self._folder.mkdir(exist_ok=True)
        atomic.write(self._folder / f"{number:03d}.json", asked.text())
        row = {"minute": float(step.minute[n]), **self._origin(asked)}
        self._record.journal.append("learn", {"number": number, "reactor": name, **row})
        self._last, self._last_min[n] = number, step.minute[n]
        log.info("%s: training %03d begins, for growth off by %+.3f and %+.3f of the curves", name, number, *errors)
        self._asked = asked
        self._begin(asked)

    @staticmethod
    def _origin(asked: Question) -> dict[str, Any]:
        """Where a policy comes from."""
        rests = {"rests_on_min": list(asked.rests_on_min), "in_force": asked.in_force}
        return {"curves": list(asked.errors), "sds": list(asked.sds), **rests}

    def _begin(self, asked: Question) -> None:
        """Start the process of a training; one at a time."""
        file, out = self._folder / f"{asked.number:03d}.json", self._folder / f"{asked.number:03d}"
        lesson = [sys.executable, "-m", "experiments.comparison.lesson", str(file.resolve()), "--until-eof"]
        try:
            out.mkdir(exist_ok=True)
            with (out / "lesson.log").open("ab") as told:
                self._child = subprocess.Popen(  # Ctrl-C is not for it; in another session nice would count for nothing
                    ["nice", "-n", str(self.config.nice), *lesson], stdin=subprocess.PIPE, stdout=told, stderr=told,
                    process_group=0, env={**os.environ, "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"},
                )  # fmt: skip
            self._began, self._ended = self._clock(), np.inf
        except OSError as error:
            self._judged(asked.number, asked.reactor, None, f"could not begin: {error}")

    def _look(self) -> None:
        """Whether the training has ended, and what came out; one that takes too long is ended, without waiting."""
        child, asked, now = self._child, self._asked, self._clock()
        assert child is not None
        assert asked is not None
        if child.poll() is None:
            if now > self._ended + END_S:
                child.kill()
            elif now > self._began + 60.0 * self.config.limit_min and np.isinf(self._ended):
                child.terminate()
                self._ended = now
            return
        given_up = np.isfinite(self._ended)
        self._close()
        verdict = self._found(asked.number)
        why = f"given up after {self.config.limit_min:g} min" if given_up else self._failed(asked.number, child)
        self._judged(asked.number, asked.reactor, verdict, why)

    def _found(self, number: int) -> Verdict | None:
        """What the process of a training has left."""
        try:
            text = (self._folder / f"{number:03d}" / "verdict.json").read_text(encoding="utf-8")
            return Verdict(**json.loads(text))
        except (OSError, ValueError, TypeError):
            return None

    def _failed(self, number: int, child: subprocess.Popen[bytes]) -> str:
        """Why it left nothing."""
        try:
            log_file = self._folder / f"{number:03d}" / "lesson.log"
            lines = log_file.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        except OSError:
            lines = []
        code = child.returncode
        ended = f"ended by signal {-code}" if code < 0 else f"exit status {code}"
        return f"failed, {ended}: {lines[-1] if lines else 'it left no word'}"

    def _judged(self, number: int, name: str, verdict: Verdict | None, why: str) -> None:
        """What came of a training, in the journal; a better policy flies from then on."""
        row: dict[str, Any] = {"number": number, "reactor": name, "flies": False, "why": why}
        row["minute"] = self._loop.reactors.elapsed() / 60.0
        if self._asked is not None and self._asked.number == number:
            row |= self._origin(self._asked)
        policy = None
        if verdict is not None:
            row |= verdict.row()
            self._trained[self._names.index(name)] = row["curves"]
        if row["flies"]:
            try:
                policy = self._kept(number, row)
            except (OSError, policies.PolicyError) as error:
                row |= {"flies": False, "why": f"its file could not be kept: {error}"}
        self._record.journal.append("judged", row)
        if policy is not None:
            self._follow(name, number, policy)
        self.learned = [*self.learned, row]
        flown_by = "" if row.get("law") in (None, "new", "old") else f"as {row['law']} "
        text = f"policy {number:03d} {f'flies {flown_by}from now on' if row['flies'] else 'does not fly'}: {row['why']}"
        log.log(logging.INFO if verdict is not None else logging.WARNING, "%s: %s", name, text)
        if row["flies"] or verdict is None:
            self._tell("policy", text, name)

    def _kept(self, number: int, row: Mapping[str, Any]) -> Policy:
        """The new policy with where it comes from, in one file on the disk. Raises: OSError, PolicyError."""
        policy = policies.load(self._folder / f"{number:03d}" / "policy.npz")
        policy.metadata["learned"] = {"run": self._record.folder.name, **row}
        atomic.write(self._record.folder / named(number), policies.packed(policy))
        return policy

    def _close(self) -> None:
        child, self._child = self._child, None
        if child is not None and child.stdin is not None:
            child.stdin.close()

    def close(self) -> None:
        """End the training under way; the run that is resumed goes on with it. Idempotent."""
        child = self._child
        if child is not None and child.poll() is None and self._asked is not None:
            log.info("%s: training %03d ends with the run", self._asked.reactor, self._asked.number)
            for end in (child.terminate, child.kill):
                end()
                with suppress(subprocess.TimeoutExpired):
                    child.wait(END_S)
                    break
        self._close()


def kind_of(why: str) -> str:
    """A reason without its numbers."""
    return re.sub(r"[\d.]+", "#", why)
