"""A sweep: a folder named once, a record of every job in it, and going on with the jobs that are missing."""

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

__all__ = ["FLAGS", "Busy", "Job", "Sweep", "asked", "errors", "fresh", "jobs", "progress", "read", "survey", "working"]

RECORD, JOB = "sweep.json", "job.json"
SEARCH = "hparams_search="
FLAGS = ("-m", "--multirun")
FOLDER = "hydra.sweep.dir="
LATER = ("hydra/launcher=", "hydra.launcher.", "hydra.sweeper.")  # what another start of a sweep may say differently


class Busy(Exception):
    """Another process works on this job; the message is one line."""


@dataclass(frozen=True)
class Sweep:
    """folder: of the sweep. command: that swept. arguments: of it, without folder and flag, as they were typed."""

    folder: Path
    command: str
    arguments: list[str]

    def line(self) -> list[str]:
        """Return the command line with the folder spelled out, so that workers and later starts find it."""
        return [FLAGS[0], *self.arguments, f"{FOLDER}{self.folder}"]  # argparse takes the flag only in front

    def save(self) -> None:
        """Write down what was asked for. Raises: UserError where the folder holds a sweep of something else."""
        before = read(self.folder)
        if before and (before.command, _lasting(before.arguments)) != (self.command, _lasting(self.arguments)):
            other = shlex.join([f"experiments.{before.command}", *before.line()])
            raise UserError(f"{FOLDER}{self.folder}: holds another sweep ({other}); give another folder")
        self.folder.mkdir(parents=True, exist_ok=True)
        files.write_json(self.folder / RECORD, {"command": self.command, "arguments": self.arguments})

    def again(self) -> str:
        """Return the command that does what is missing."""
        return f"python -m experiments.{self.command} -m resume={shlex.quote(str(self.folder))}"


def _lasting(arguments: Sequence[str]) -> list[str]:
    """Without what may differ between two starts of one sweep."""
    return [a for a in arguments if not a.startswith(LATER)]


def fresh(command: str) -> Path:
    """Where a run of a command writes. The name holds the second and the process number: two runs never meet."""
    return Path("runs") / command / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{os.getpid()}"


def read(folder: Path) -> Sweep | None:
    """Read the sweep in a folder, None where there is none or its record is damaged."""
    try:
        found = json.loads((folder / RECORD).read_text("utf-8"))
        return Sweep(folder, str(found["command"]), [str(a) for a in found["arguments"]])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def asked(given: Sequence[str], command: str) -> Sweep | None:
    """Return the sweep that a command line asks for, None where it asks for a single run.

    `resume=SWEEP` is the sweep that was begun there, by whatever launcher it names now.
    Raises: UserError where it names anything else beside.
    """
    plain = [a for a in given if a not in FLAGS]
    folder = next((Path(a.removeprefix("resume=")) for a in reversed(plain) if a.startswith("resume=")), None)
    before = read(folder) if folder else None
    if before:
        others = [a for a in plain if not a.startswith(("resume=", *LATER))]
        if others or before.command != command:
            what = others[0] if others else f"experiments.{command}"
            raise UserError(f"{what}: a resumed sweep is {before.again()}, with all its values; drop it")
        new = [a for a in plain if not a.startswith("resume=")]
        keys = {a.partition("=")[0] for a in new}
        kept = [a for a in before.arguments if a.partition("=")[0] not in keys]
        if any(a.startswith("hydra/launcher=") for a in new):  # settings of the launcher before are not for this one
            kept = [a for a in kept if not a.startswith("hydra.launcher.")]
        return Sweep(before.folder, command, kept + new)
    if folder and len(plain) < len(given):
        raise UserError(f"resume={folder}: no sweep; a single run goes on without -m")
    if len(plain) == len(given) and not searches(plain):
        return None
    named = [a.removeprefix(FOLDER) for a in plain if a.startswith(FOLDER)]
    own = [a for a in plain if not a.startswith(FOLDER)]
    return Sweep(Path(named[-1] if named else f"{fresh(command)}_sweep"), command, own)


def searches(arguments: Sequence[str]) -> bool:
    """Whether the jobs of a sweep follow from each other's results."""
    return any(a.lstrip("+").startswith(SEARCH) and not a.endswith("=null") for a in arguments)


def jobs(arguments: Sequence[str]) -> list[list[str]] | None:
    """List the overrides of every job, in order; None for a search, whose jobs follow from each other.

    Args: arguments: in the form that Hydra takes. Raises: hydra.errors.HydraException for what is none.
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
    """What job.json says of a job.

    state: running (or stopped, if no process works on it), finished, failed. config: hash of its config.
    objective: what it returned. error: why it failed, one line.
    """

    folder: Path
    state: str = "missing"
    config: str = ""
    objective: float | None = None
    error: str = ""
    overrides: list[str] = field(default_factory=list)

    @classmethod
    def at(cls, folder: Path) -> "Job":
        """Return the job of a folder, whatever there is of it."""
        try:
            found = json.loads((folder / JOB).read_text("utf-8"))
            return cls(folder, found["state"], found["config"], found["objective"], found["error"])
        except (OSError, ValueError, LookupError, TypeError):
            return cls(folder)

    def save(self, state: str, objective: float | None = None, error: str = "") -> None:
        """Write down where the job stands."""
        self.state, self.objective, self.error = state, objective, error
        kept = {"state": state, "config": self.config, "objective": objective, "error": error}
        files.write_json(self.folder / JOB, kept)

    def begin(self, config: Any) -> None:
        """Begin the job with this config. Raises: UserError where its folder holds a run of another config."""
        digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True, default=str).encode()).hexdigest()
        if self.config not in ("", digest):
            raise UserError(f"{self.folder}: holds a run of another config; give another {FOLDER}FOLDER")
        self.config = digest
        if self.state != "finished":
            self.save("running")

    def put_aside(self) -> None:
        """Move files of an earlier start that nobody can continue to stopped_1, stopped_2, ..."""
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
    """Inside, no other process works on the job of a folder.

    Args: wait: for one that does already. Raises: Busy where one does and nobody waits.
    """
    with open(folder / ".lock", "w") as lock:
        try:
            fcntl.lockf(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            raise Busy(f"{folder}: another process works on it; wait for its end") from error
        yield


def _free(folder: Path) -> bool:
    """Whether no process works on a job."""
    try:
        with working(folder):
            return True
    except Busy:
        return False
    except OSError:  # a folder of somebody else's: nothing of ours runs there
        return True


def survey(folder: Path, expected: list[list[str]] | None = None) -> list[Job]:
    """Every job of a sweep as it stands, in order of its number.

    Args: expected: overrides of every job there should be; None: those that have a folder.
    """
    there = sorted((p for p in folder.glob("*") if p.name.isdigit()), key=lambda p: int(p.name))
    found = (
        [Job.at(folder / str(k)) for k in range(len(expected))] if expected is not None else list(map(Job.at, there))
    )
    for k, job in enumerate(found):
        if job.state == "running" and _free(job.folder):  # a process that was killed leaves that behind
            job.state = "stopped"
        job.overrides = [a.lstrip("+") for a in (expected[k] if expected is not None else files.given(job.folder))]
    return found


def progress(sweep: Sweep, expected: list[list[str]] | None) -> str:
    """How many jobs of a sweep came to their end, and what to do about the others, one line."""
    found = survey(sweep.folder, expected)
    done = sum(job.state == "finished" for job in found)
    line = f"{done} of {len(found)} jobs finished in {sweep.folder}"
    if any(job.state == "running" for job in found):
        line += f"; {sum(job.state == 'running' for job in found)} still at work in other processes"
    over = ("finished", "running") if expected is not None else ("finished", "running", "failed")
    if all(job.state in over for job in found):
        return f"{line}; compare them: python -m experiments.report runs={shlex.quote(str(sweep.folder))}"
    return f"{line}; what is missing: {sweep.again()}"


def errors(folder: Path, expected: list[list[str]] | None, most: int = 3) -> str:
    """Why jobs failed, and which, at the head of a line; empty where none did."""
    why: dict[str, list[str]] = {}
    for job in survey(folder, expected):
        if job.state == "failed":
            why.setdefault(job.error, []).append(f"job {job.folder.name}: {' '.join(job.overrides)}")
    each = [f"{error} ({'; '.join(which[:most])}{'; ...' * (len(which) > most)})" for error, which in why.items()]
    more = [f"and {len(each) - most} other errors"] if len(each) > most else []
    return f"error: {'; '.join(each[:most] + more)}; " if why else ""
