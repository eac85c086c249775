"""A sweep: its folder, a record of every job, and the continuation of missing jobs."""

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
LATER = ("hydra/launcher=", "hydra.launcher.", "hydra.sweeper.")  # arguments that may differ between starts of a sweep


class Busy(Exception):
    """Error: another process works on this job; the message is one line."""


@dataclass(frozen=True)
class Sweep:
    """A sweep. folder: of the sweep. command: its command. arguments: as typed, without folder and flag."""

    folder: Path
    command: str
    arguments: list[str]

    def line(self) -> list[str]:
        """Return the command line with the folder, for workers and later starts."""
        return [FLAGS[0], *self.arguments, f"{FOLDER}{self.folder}"]  # argparse accepts the flag only in front

    def save(self) -> None:
        """Save the sweep. Raises: UserError if the folder has another sweep."""
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
    """Return a new run folder. Its name has the second and the process number, so it is unique."""
    return Path("runs") / command / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_{os.getpid()}"


def read(folder: Path) -> Sweep | None:
    """Read the sweep in a folder, None without one or with a damaged record."""
    try:
        found = json.loads((folder / RECORD).read_text("utf-8"))
        return Sweep(folder, str(found["command"]), [str(a) for a in found["arguments"]])
    except (OSError, ValueError, LookupError, TypeError):
        return None


def asked(given: Sequence[str], command: str) -> Sweep | None:
    """Return the sweep of a command line, None for a single run.

    `resume=SWEEP` continues the sweep in that folder; it may change the launcher.
    Raises: UserError if other arguments are given, too.
    """
    plain = [a for a in given if a not in FLAGS]
    folder = next((Path(a.removeprefix("resume=")) for a in reversed(plain) if a.startswith("resume=")), None)
    before = read(folder) if folder else None
    if before:
        others = [a for a in plain if not a.startswith(("resume=", *LATER))]
        if others or before.command != command:
            what = others[0] if others else f"experiments.{command}"
            raise UserError(f"{what}: a resumed sweep keeps its values; use {before.again()}")
        new = [a for a in plain if not a.startswith("resume=")]
        keys = {a.partition("=")[0] for a in new}
        kept = [a for a in before.arguments if a.partition("=")[0] not in keys]
        if any(a.startswith("hydra/launcher=") for a in new):  # without the settings of the previous launcher
            kept = [a for a in kept if not a.startswith("hydra.launcher.")]
        return Sweep(before.folder, command, kept + new)
    if folder and len(plain) < len(given):
        raise UserError(f"resume={folder}: no sweep; continue a single run without -m")
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

    Args: arguments: in Hydra's form. Raises: hydra.errors.HydraException for other text.
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

    state: running (or stopped, if no process works on it), finished, failed. config: hash of its config.
    objective: its return value. error: reason of a failure, one line.
    """

    folder: Path
    state: str = "missing"
    config: str = ""
    objective: float | None = None
    error: str = ""
    overrides: list[str] = field(default_factory=list)

    @classmethod
    def at(cls, folder: Path) -> "Job":
        """Return the job of a folder, also an incomplete one."""
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
        """Begin the job with this config. Raises: UserError if its folder has a run of another config."""
        digest = hashlib.sha256(json.dumps(asdict(config), sort_keys=True, default=str).encode()).hexdigest()
        if self.config not in ("", digest):
            raise UserError(f"{self.folder}: holds a run of another config; give another {FOLDER}FOLDER")
        self.config = digest
        if self.state != "finished":
            self.save("running")

    def put_aside(self) -> None:
        """Move files of an earlier start that cannot be continued to stopped_1, stopped_2, ..."""
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

    Args: wait: for another process. Raises: Busy without waiting.
    """
    with open(folder / ".lock", "w") as lock:
        try:
            fcntl.lockf(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            raise Busy(f"{folder}: another process works on it; wait for its end") from error
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

    Args: expected: overrides of all jobs; None: the jobs with a folder.
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
    """Describe how many jobs of a sweep finished, and the remedy for the others, in one line."""
    found = survey(sweep.folder, expected)
    done = sum(job.state == "finished" for job in found)
    line = f"{done} of {len(found)} jobs finished in {sweep.folder}"
    if any(job.state == "running" for job in found):
        line += f"; {sum(job.state == 'running' for job in found)} still running in other processes"
    over = ("finished", "running") if expected is not None else ("finished", "running", "failed")
    if all(job.state in over for job in found):
        return f"{line}; compare them: python -m experiments.report runs={shlex.quote(str(sweep.folder))}"
    return f"{line}; what is missing: {sweep.again()}"


def errors(folder: Path, expected: list[list[str]] | None, most: int = 3) -> str:
    """Describe which jobs failed and why, for the start of a line; empty without failures."""
    why: dict[str, list[str]] = {}
    for job in survey(folder, expected):
        if job.state == "failed":
            why.setdefault(job.error, []).append(f"job {job.folder.name}: {' '.join(job.overrides)}")
    each = [f"{error} ({'; '.join(which[:most])}{'; ...' * (len(which) > most)})" for error, which in why.items()]
    more = [f"and {len(each) - most} other errors"] if len(each) > most else []
    return f"error: {'; '.join(each[:most] + more)}; " if why else ""
