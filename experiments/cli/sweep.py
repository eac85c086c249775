"""Sweeps: folder of a sweep, record of every job, and continuation of missing jobs."""

import fcntl
import hashlib
import itertools
import json
import os
import shlex
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser

from experiments.cli import files
from experiments.cli.words import UserError

RECORD, JOB = "sweep.json", "job.json"
SEARCH = "hparams_search="
FLAGS = ("-m", "--multirun")
FOLDER = "hydra.sweep.dir="
LATER = ("hydra/launcher=", "hydra.launcher.", "hydra.sweeper.")  # arguments that a resumed sweep may change


class Busy(Exception):
    """Error that another process works on this job; its message has one line."""


@dataclass(frozen=True)
class Sweep:
    """A sweep: its folder, name of its command, and arguments as typed, without the folder and -m."""

    folder: Path
    command: str
    arguments: list[str]

    def line(self) -> list[str]:
        """Return the arguments of the command line, with the folder, for workers and later starts."""
        return [FLAGS[0], *self.arguments, f"{FOLDER}{self.folder}"]  # argparse accepts -m only in front

    def save(self) -> None:
        """Save the sweep in its folder. Raises: UserError if the folder has another sweep."""
        before = read(self.folder)
        if before and (before.command, _lasting(before.arguments)) != (self.command, _lasting(self.arguments)):
            other = shlex.join([f"experiments.{before.command}", *before.line()])
            raise UserError(f"{FOLDER}{self.folder}: holds another sweep ({other}); give another folder")
        self.folder.mkdir(parents=True, exist_ok=True)
        files.write_json(self.folder / RECORD, {"command": self.command, "arguments": self.arguments})

    def again(self) -> str:
        """Return the command that runs the missing jobs."""
        return f"python -m experiments.{self.command} -m resume={shlex.quote(str(self.folder))}"


def _lasting(arguments: Sequence[str]) -> list[str]:
    return [a for a in arguments if not a.startswith(LATER)]


def fresh(command: str) -> Path:
    """Return a new run folder, unique by the second and the process number in its name."""
    return Path("runs") / command / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{os.getpid()}"


def read(folder: Path) -> Sweep | None:
    """Read the sweep of a folder; return None if there is no sweep or its record is damaged."""
    try:
        found = json.loads((folder / RECORD).read_text("utf-8"))
        return Sweep(folder, str(found["command"]), [str(a) for a in found["arguments"]])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def asked(given: Sequence[str], command: str) -> Sweep | None:
    """Return the sweep of a command line, None for a single run.

    `resume=SWEEP` continues the sweep in that folder, perhaps with another launcher.
    Raises: UserError if other arguments are given, too.
    """
    plain = [a for a in given if a not in FLAGS]
    folder = next((Path(a.removeprefix("resume=")) for a in reversed(plain) if a.startswith("resume=")), None)
    before = read(folder) if folder else None
    if before:
        others = [a for a in plain if not a.startswith(("resume=", *LATER))]
        if others or before.command != command:
            what = others[0] if others else f"experiments.{command}"
            raise UserError(f"{what}: not allowed, a resumed sweep keeps its values; use {before.again()}")
        new = [a for a in plain if not a.startswith("resume=")]
        keys = {a.partition("=")[0] for a in new}
        kept = [a for a in before.arguments if a.partition("=")[0] not in keys]
        if any(a.startswith("hydra/launcher=") for a in new):  # without the settings of the previous launcher
            kept = [a for a in kept if not a.startswith("hydra.launcher.")]
        return Sweep(before.folder, command, kept + new)
    if folder and len(plain) < len(given):
        raise UserError(f"resume={folder}: not a sweep; to continue a single run, drop -m")
    if len(plain) == len(given) and not searches(plain):
        return None
    named = [a.removeprefix(FOLDER) for a in plain if a.startswith(FOLDER)]
    own = [a for a in plain if not a.startswith(FOLDER)]
    return Sweep(Path(named[-1] if named else f"{fresh(command)}_sweep"), command, own)


def searches(arguments: Sequence[str]) -> bool:
    """Return whether the jobs of a sweep depend on each other's results."""
    return any(a.lstrip("+").startswith(SEARCH) and not a.endswith("=null") for a in arguments)


def jobs(arguments: Sequence[str]) -> list[list[str]] | None:
    """List the overrides of every job, in order; None for a search, whose jobs depend on results.

    Args: arguments: in Hydra's form. Raises: hydra.errors.HydraException if an argument is not in this form.
    """
    if searches(arguments):
        return None
    own = [a for a in arguments if not a.startswith(("-", "hydra.", "hydra/"))]
    values: dict[str, list[str]] = {}
    for one in OverridesParser.create().parse_overrides(own):
        several = one.is_sweep_override() and one.is_discrete_sweep()
        values[one.get_key_element()] = (
            list(map(str, one.sweep_string_iterator())) if several else [one.get_value_element_as_str()]
        )
    return [list(job) for job in itertools.product(*([f"{key}={v}" for v in each] for key, each in values.items()))]


@dataclass
class Job:
    """Content of a job's job.json.

    state: missing, running, stopped (its process was killed), finished or failed. config: hash of the job's config.
    objective: return value of the job. error: reason of a failure, one line. overrides: values on its command line.
    """

    folder: Path
    state: str = "missing"
    config: str = ""
    objective: float | None = None
    error: str = ""
    overrides: list[str] = field(default_factory=list)

    @classmethod
    def at(cls, folder: Path) -> "Job":
        """Return the job of a folder; a job without a readable job.json is missing."""
        try:
            found = json.loads((folder / JOB).read_text("utf-8"))
            return cls(folder, found["state"], found["config"], found["objective"], found["error"])
        except (OSError, ValueError, LookupError, TypeError):
            return cls(folder)

    def save(self, state: str, objective: float | None = None, error: str = "") -> None:
        """Save the state of the job."""
        self.state, self.objective, self.error = state, objective, error
        kept = {"state": state, "config": self.config, "objective": objective, "error": error}
        files.write_json(self.folder / JOB, kept)

    def begin(self, config: Any) -> None:
        """Begin the job with this config. Raises: UserError if its folder has a run with another config."""
        digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True, default=str).encode()).hexdigest()
        if self.config not in ("", digest):
            raise UserError(f"{self.folder}: has a run with another config; give another {FOLDER}FOLDER")
        self.config = digest
        if self.state != "finished":
            self.save("running")

    def put_aside(self) -> None:
        """Move the files of an earlier start, which cannot continue, to a folder stopped_1, stopped_2, ..."""
        own = (JOB, ".hydra", ".lock")
        left = [p for p in self.folder.iterdir() if p.name not in own and p.suffix != ".log"]
        left = [p for p in left if not p.name.startswith("stopped_")]
        if left:
            count = len(list(self.folder.glob("stopped_*")))
            aside = self.folder / f"stopped_{count + 1}"
            aside.mkdir()
            for path in left:
                path.rename(aside / path.name)


@contextmanager
def working(folder: Path, wait: bool = False) -> Iterator[None]:
    """Exclude other processes from the job of a folder in this context.

    Args: wait: whether to wait for another process. Raises: Busy if another process has the job and `wait` is false.
    """
    with open(folder / ".lock", "w") as lock:
        try:
            fcntl.lockf(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            raise Busy(f"{folder}: another process works on this job; wait until that process ends") from error
        yield


def _free(folder: Path) -> bool:
    try:
        with working(folder):
            return True
    except Busy:
        return False
    except OSError:  # another user's folder: no process of this user works there
        return True


def survey(folder: Path, expected: list[list[str]] | None = None) -> list[Job]:
    """List every job of a sweep with its state, in order of number.

    Args: expected: overrides of all jobs; None lists the jobs that have a folder.
    """
    there = sorted((p for p in folder.glob("*") if p.name.isdigit()), key=lambda p: int(p.name))
    found = (
        [Job.at(folder / str(k)) for k in range(len(expected))] if expected is not None else list(map(Job.at, there))
    )
    for k, job in enumerate(found):
        if job.state == "running" and _free(job.folder):  # left by a killed process
            job.state = "stopped"
        job.overrides = [a.lstrip("+") for a in (expected[k] if expected is not None else files.given(job.folder))]
    return found


def progress(sweep: Sweep, expected: list[list[str]] | None) -> str:
    """Return one line: how many jobs of a sweep finished, and the next command."""
    found = survey(sweep.folder, expected)
    done = sum(job.state == "finished" for job in found)
    line = f"{done} of {len(found)} jobs finished in {sweep.folder}"
    if any(job.state == "running" for job in found):
        line += f"; {sum(job.state == 'running' for job in found)} still running in other processes"
    over = ("finished", "running") if expected is not None else ("finished", "running", "failed")
    if all(job.state in over for job in found):
        return f"{line}; compare them: python -m experiments.report runs={shlex.quote(str(sweep.folder))}"
    return f"{line}; run the missing jobs: {sweep.again()}"


def errors(folder: Path, expected: list[list[str]] | None, most: int = 3) -> str:
    """Return which jobs failed and why, as the start of a line; "" without failures."""
    why: dict[str, list[str]] = {}
    for job in survey(folder, expected):
        if job.state == "failed":
            why.setdefault(job.error, []).append(f"job {job.folder.name}: {' '.join(job.overrides)}")
    each = [f"{error} ({'; '.join(which[:most])}{'; ...' * (len(which) > most)})" for error, which in why.items()]
    more = [f"and {len(each) - most} other errors"] if len(each) > most else []
    return f"error: {'; '.join(each[:most] + more)}; " if why else ""
