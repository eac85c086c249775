"""Frame of every command: command line -> Hydra -> checked dataclass -> run folder.

Hydra composes plain YAML; the command's dataclass is the schema. An invalid argument (unknown key, wrong type, value
out of range, misspelt option) gives one line on standard error, before a run folder exists.
"""

import errno
import logging
import os
import re
import shlex
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from traceback import walk_tb
from typing import Any, Generic, TextIO, TypeVar, cast

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from conf.presets import program
from conf.schema import build
from experiments.cli import extensions, files, help_page, latest, search, stop, sweep, words
from experiments.cli.start import stopped, version
from experiments.cli.words import UserError as UserError
from experiments.cli.words import normalise as normalise
from experiments.cli.words import refusing as refusing

T = TypeVar("T")
log = logging.getLogger(__name__)
for talker in ("httpx", "torch"):  # httpx logs every request, as the journal does; torch logs its caches at exit
    logging.getLogger(talker).setLevel(logging.WARNING)


class _Once(logging.Filter):
    """Filter that logs a repeated warning of another library only once."""

    def __init__(self) -> None:
        super().__init__()
        self._said: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING:
            return True
        kind = re.sub(r"\d+", "", record.getMessage())
        if kind not in self._said:
            self._said.add(kind)
            log.warning("%s: %s (shown once)", record.name, record.getMessage())
        return False


logging.getLogger("submitit").addFilter(_Once())  # a cluster without accounting refuses `sacct` at each poll

BASE: dict[str, Any] = {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}  # deprecated from 1.4 on

SPACE, PLACE = "free disk space", "choose a folder that can be written, with hydra.run.dir=FOLDER"
REFUSALS = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), SPACE),
    **dict.fromkeys((errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR, errno.EEXIST, errno.ENAMETOOLONG), PLACE),
}
"""Error numbers of a disk that refuses a file -> remedies."""


OPTIONS = frozenset((
    "-h", "--help", "--hydra-help", "--version", "-c", "--cfg", "--resolve", "-p", "--package", "-r", "--run", "-m",
    "--multirun", "-sc", "--shell-completion", "-cp", "--config-path", "-cn", "--config-name", "-cd", "--config-dir",
    "--experimental-rerun", "-i", "--info",
))  # fmt: skip
"""Options that begin with a dash, of this program and of Hydra."""
SEVERAL = re.compile(r"(?:Sweep parameters|Ambiguous value for argument) '\+*(.+?)'(?:,| |$)")


def _one_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines()]
    if several := SEVERAL.match(lines[0] if lines else ""):
        word = several[1]
        return f"{word}: several values need a sweep; start it with -m (-m '{word}'), or write a list as [1,2]"
    kept = [s for s in lines if s and not s.startswith(("object_type", "reference_type", "Config search path"))]
    return " ".join(kept[:6])


def _refusal(error: BaseException | None) -> str | None:
    """Return the message for a disk error, None for any other error.

    The disk error may be the cause of another error, e.g. of torch or logging.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in REFUSALS:
            return f"{error.filename or 'writing'}: {error.strerror}; {REFUSALS[error.errno]}"
        error = error.__cause__ or error.__context__
    return None


def _in_thread(failed: threading.ExceptHookArgs) -> None:
    """Show an error of a thread, except a disk error in an event writer's thread, which the run itself reports."""
    if _refusal(failed.exc_value) is None:
        threading.__excepthook__(failed)


def _silence(stream: TextIO) -> None:
    """Send all further output of a stream to /dev/null, also that at the interpreter's exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def load(cfg: DictConfig, schema: T, prefix: str = "") -> T:
    """Convert a composed config to the checked dataclass.

    Args:
      schema: an instance with the defaults; each nested dataclass checks its ranges in `__post_init__`.
      prefix: key of the config, shown in messages.
    Raises: UserError with key, value and allowed values.
    """
    try:
        values = OmegaConf.to_container(cfg, resolve=True)
        return build(schema, cast(dict[str, Any], values), prefix)
    except (OmegaConfBaseException, ValueError) as error:
        raise UserError(_one_line(error)) from None


def compose(name: str, overrides: Sequence[str]) -> DictConfig:
    """Compose `conf/<name>.yaml` with command-line overrides, as the entry point does.

    Raises: UserError with Hydra's message on one line.
    """
    try:
        GlobalHydra.instance().clear()
        with hydra.initialize_config_module("conf", **BASE):
            return hydra.compose(
                name, overrides=[a for a in normalise(overrides, name) if not a.startswith(("hydra.", "hydra/"))]
            )
    except (HydraException, OmegaConfBaseException, ValueError) as error:  # Hydra's own checks of a group's name
        raise UserError(_one_line(error)) from None


def swept() -> bool:
    """Return whether this run is a job of a sweep."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def save_config(config: Any, folder: Path) -> None:
    """Write the checked config as `config.yaml`, which `resume=` and `--config-name` read."""
    OmegaConf.save(OmegaConf.create(asdict(config)), folder / "config.yaml")


def _stored(path: Path, resume: str, schema: T) -> T:
    """Read the config of a run. Raises: UserError with file and reason."""
    try:
        stored = files.load_yaml(path)
        if not isinstance(stored, DictConfig):
            raise UserError("the file has no keys and values")
        stored.resume = resume
        config = load(stored, schema)
        if missing := [f.name for f in fields(cast(Any, schema)) if f.name not in stored]:
            raise UserError(f"key {missing[0]} is missing")
        return config
    except (UserError, OSError, ValueError, AttributeError, OmegaConfBaseException) as error:
        why = _one_line(error) or type(error).__name__
        older = "only the version that started a run can continue it"
        remedy = f"{older}; restore the file as the run wrote it, or start a new run"
        raise UserError(f"{path}: not the config of this run ({why}); {remedy}") from None


@dataclass(frozen=True)
class EntryPoint(Generic[T]):
    """Entry point of a command; call it to run the command. It writes config.yaml before `body` starts.

    name: name of the command, of `conf/<name>.yaml` and of the Hydra job.
    schema: default instance of the command's config dataclass; a field `resume` makes the command resumable.
    body: function of the checked config and the run folder; may return the sweep's objective.
    resumes: file of a run folder that `resume=` needs, "" for a command without `resume=`.
    goes_on: whether a stopped job of a sweep continues from that file, to the same result; if not, it starts again.
    """

    name: str
    schema: T
    body: Callable[[T, Path], float | None]
    resumes: str = ""
    goes_on: bool = False

    def config(self, overrides: Sequence[str] = ()) -> T:
        """Return the checked config of a command line. Raises: UserError."""
        cfg = compose(self.name, overrides)
        return load(cfg, self.schema)

    def __call__(self) -> None:
        """Run the command line. Exits: 0, or 1 after one line on standard error; 130 when stopped."""
        logging.raiseExceptions = False  # a failed log line must not stop the run
        threading.excepthook = _in_thread
        try:
            with stop.interrupts(), stop.unmasked():
                self._answer(sys.argv[1:])
            sys.stdout.flush()
        except BrokenPipeError:  # `--help | head`: the reader has closed the pipe
            _silence(sys.stdout)
        except KeyboardInterrupt:
            print(stopped(), file=sys.stderr)
            sys.exit(stop.STATUS)
        except Exception as error:
            line = _refusal(error)
            if isinstance(error, FileNotFoundError):  # no folder can be created there, e.g. under /proc
                line = f"{error.filename}: {error.strerror}; {PLACE}"
            if line is None and isinstance(error, UserError | ValueError | HydraException | OmegaConfBaseException):
                line = _one_line(error)  # a ValueError is the schema's message about a value
            inside = any(stack.f_code is EntryPoint._job.__code__ for stack, _ in walk_tb(error.__traceback__))
            if line is None or inside:  # a bug of this program, with its traceback
                raise
            print(f"error: {line}", file=sys.stderr)
            if isinstance(error, OSError) and error.filename is None:
                _silence(sys.stdout)  # standard output failed
            sys.exit(1)

    def _answer(self, given: list[str]) -> None:
        with refusing(ValueError):
            given = [latest.resolved(arg, self.name) for arg in given]
        flags = {a for a in given if a.startswith("-")}
        if unknown := sorted(flag for flag in flags if flag.partition("=")[0] not in OPTIONS):
            key, _, value = unknown[0].lstrip("-").partition("=")
            raise UserError(f"{unknown[0]}: no such option; give values as {key}={value or 'VALUE'}; see --help")
        about = next((a.removeprefix("--help=") for a in flags if a.startswith("--help=")), "")
        plain = [a for a in given if not a.startswith("-")]
        if about or flags & {"--help", "-h"}:
            with refusing(ValueError):
                page = help_page.text(self.name, self.config(plain), about)
            print(page, flush=True)
            return
        if "--version" in flags:
            print(version())
            return
        if flags & {"--cfg", "-c"} and "job" in plain:
            plain.remove("job")
            print(OmegaConf.to_yaml(asdict(cast(Any, self.config(plain)))))
            return
        if flags <= set(sweep.FLAGS) and (swept := sweep.asked(given, self.name)):  # Hydra reads other flags
            self._sweep(swept)
            return
        sys.argv[1:] = normalise(given, self.name)
        if not flags:  # a single run is checked before its folder exists
            self.config(given)
            resumed = words.resumed(given)
            others = [a for a in given if not a.startswith(("resume=", "hydra."))]
            if resumed and others:
                raise UserError(f"{others[0]}: a resumed run has all values in {resumed}/config.yaml; drop this one")
            for taken in [a.removeprefix(words.RUN) for a in given if a.startswith(words.RUN)]:
                if self.resumes and not resumed and (Path(taken) / self.resumes).is_file():
                    raise UserError(f"{words.RUN}{taken}: holds a run; give resume={taken}, or a new folder")
        self._hydra()

    def _hydra(self) -> None:
        sys.argv.append(f"hydra.job.name={self.name}")
        if not any(a in sweep.FLAGS or a.startswith(words.RUN) for a in sys.argv):
            sys.argv.append(f"{words.RUN}{sweep.fresh(self.name)}")
        GlobalHydra.instance().clear()
        os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises its error, and `__call__` shows the message
        hydra.main(config_path="pkg://conf", config_name=self.name, **BASE)(self._job)()

    def _sweep(self, swept: sweep.Sweep) -> None:
        """Run every job of a sweep and print how many finished. Exits: 1 if a job failed."""
        sys.argv[1:] = normalise(swept.line(), self.name)
        expected = sweep.jobs(sys.argv[1:])
        self._refuse([swept.arguments] if expected is None else expected)
        if expected is None:
            search.register()
        swept.save()
        try:
            self._hydra()
        except (KeyboardInterrupt, SystemExit):
            print(f"stopped; {sweep.progress(swept, expected)}", file=sys.stderr)
            sys.exit(stop.STATUS)
        except Exception:  # a bug in a launcher, or in a job: Hydra raises the job's error again after all jobs
            print(sweep.progress(swept, expected), file=sys.stderr)
            raise
        errors = sweep.errors(swept.folder, expected)
        print(f"{errors}{sweep.progress(swept, expected)}", file=sys.stderr if errors else sys.stdout, flush=True)
        if errors:
            sys.exit(1)

    def _refuse(self, jobs: list[list[str]]) -> None:
        refusals = []
        for job in jobs:
            try:
                self.config(job)
                return
            except UserError as error:
                refusals.append(error)
        if refusals:
            raise refusals[0]

    def _job(self, cfg: DictConfig) -> float | None:
        folder = Path(os.path.relpath(HydraConfig.get().runtime.output_dir))
        extensions.load_all()  # the worker process of a sweep has not loaded them yet
        if swept():
            return self._swept_job(cfg, folder)
        try:
            if cfg.get("resume"):
                config = _stored(folder / "config.yaml", str(cfg.resume), self.schema)
            else:
                config = load(cfg, self.schema)
                save_config(config, folder)
                extensions.keep(folder)
            with stop.unmasked():
                return self.body(config, folder)
        except KeyboardInterrupt:
            print(f"stopped; {self._left(folder)}", file=sys.stderr)
            sys.exit(stop.STATUS)
        except BrokenPipeError:  # the reader has closed the pipe
            _silence(sys.stdout)
            return None
        except Exception as error:
            refused = _refusal(error)
            if refused is None and not isinstance(error, UserError):
                raise
            print(f"error: {f'{refused}; {self._left(folder)}' if refused else error}", file=sys.stderr)
            sys.exit(1)

    def _swept_job(self, cfg: DictConfig, folder: Path) -> float | None:
        """Run one job of a sweep and keep the results of earlier processes, even of a killed one.

        A failed job is recorded, and the launcher continues with the other jobs.
        """
        try:
            searched = HydraConfig.get().runtime.choices.get("hparams_search") not in (None, "null")
            with sweep.working(folder, wait=searched):  # a search needs the result, whichever process computes it
                return self._once(cfg, folder, sweep.Job.at(folder))
        except KeyboardInterrupt:
            sys.exit(stop.STATUS)
        except sweep.Busy as error:
            log.error("%s", error)
            return None

    def _once(self, cfg: DictConfig, folder: Path, job: sweep.Job) -> float | None:
        try:
            config = load(cfg, self.schema)
            job.begin(config)
            if job.state == "finished":
                return job.objective
            if self.goes_on and (folder / self.resumes).is_file():
                config = _stored(folder / "config.yaml", str(folder), self.schema)
            else:
                job.put_aside()
                save_config(config, folder)
                extensions.keep(folder)
            with stop.unmasked():
                objective = self.body(config, folder)
            job.save("finished", objective)
            return objective
        except BrokenPipeError:
            _silence(sys.stdout)
            return None
        except Exception as error:
            line = _refusal(error) or _one_line(error) or type(error).__name__
            if job.state != "finished":  # a finished job keeps its result, also after invalid new arguments
                with suppress(OSError):  # a full disk
                    job.save("failed", error=line)
            if not isinstance(error, UserError) and _refusal(error) is None:
                raise
            log.error("%s", line)
            return None

    def _left(self, folder: Path) -> str:
        """Describe the files of an unfinished run and how to continue the run."""
        own = re.compile(rf"\.|events\.|config\.yaml|{self.name}\.log|.*\.part$|reactors$|agents$")
        names = sorted(p.name + "/" * p.is_dir() for p in folder.glob("*") if not own.match(p.name))
        kept = f"{folder} keeps {', '.join(names)}" if names else f"{folder} keeps no result"
        if self.resumes and (folder / self.resumes).is_file():
            return f"{kept}; continue with: python -m {program(self.name)} resume={shlex.quote(str(folder))}"
        return f"{kept}; to try again, start a new run"
