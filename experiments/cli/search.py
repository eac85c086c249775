"""Hydra sweeper in which Optuna chooses the values of each job from the results of earlier jobs.

All processes with the same `hydra.sweep.dir` share one search. If a process ends, another one continues its trial in
the same folder. hydra-optuna-sweeper 1.3.0 does neither: it needs Optuna 2, whose shared storage needs SQLAlchemy 1,
numbers the folders of each process from 0, and leaves a killed trial in the state running without limit.
"""

import fcntl
import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from experiments.cli import files
from experiments.cli.words import EXTRA, UserError

log = logging.getLogger(__name__)

NAME = "hydra_plugins.search.Search"  # as in conf/hydra/sweeper/search.yaml; Hydra accepts no other package
JOURNAL = "search.journal"


def register() -> None:
    """Register the search with Hydra. Raises: UserError if Optuna is missing or too old."""
    try:
        import_module("optuna.storages.journal")  # only a search needs it
    except ImportError:
        raise UserError(f"hparams_search: needs optuna 4 or newer; {EXTRA}") from None
    Plugins.instance().class_name_to_class[NAME] = Search


def _distribution(name: str, said: Mapping[str, Any]) -> Any:
    """Read an entry of `space`: {choices: [...]} or {low, high, log, step}. Raises: UserError with the entry."""
    of: Any = import_module("optuna.distributions")
    try:
        if "choices" in said:
            return of.CategoricalDistribution(list(said["choices"]))
        whole = isinstance(said["low"], int) and isinstance(said["high"], int)
        kind = of.IntDistribution if whole else of.FloatDistribution
        return kind(**said)
    except (ValueError, TypeError, LookupError) as error:
        form = "{low: 1, high: 9}, with log: true or step: 2, or {choices: [1, 2]}"
        raise UserError(f"hydra.sweeper.space.{name}: {error}; write {form}") from None


class Search(Sweeper):
    """Minimiser of the objective over a space of values, shared through one file in the sweep's folder.

    Args:
      trials: number of trials of the search, over all processes and restarts, including failed ones.
      at_once: number of jobs in a launch. space: dotted key -> allowed values.
    """

    def __init__(self, trials: int, at_once: int, space: DictConfig) -> None:
        self.trials, self.at_once = trials, at_once
        self.space = {str(name): _distribution(str(name), said) for name, said in space.items()}
        self._held: dict[int, IO[str]] = {}

    def setup(self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig) -> None:
        """Store Hydra's context and make the launcher; Hydra calls this before `sweep`."""
        self.hydra_context, self.config = hydra_context, config
        self.folder = Path(str(config.hydra.sweep.dir))
        self.launcher: Launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def _open(self) -> Any:
        optuna: Any = import_module("optuna")
        optuna.logging.set_verbosity(logging.WARNING)
        (self.folder / ".trials").mkdir(parents=True, exist_ok=True)
        file = import_module("optuna.storages.journal").JournalFileBackend(str(self.folder / JOURNAL))
        storage = optuna.storages.JournalStorage(file)
        sampler = optuna.samplers.TPESampler(constant_liar=True)  # running trials of other processes count as poor
        with self._alone():
            return optuna.create_study(storage=storage, sampler=sampler, study_name="search", load_if_exists=True)

    def sweep(self, arguments: list[str]) -> None:
        """Run trials until there are `trials` of them. Args: arguments: overrides of every trial."""
        study = self._open()
        while batch := self._take(study):
            overrides = [[*arguments, *self._values(t), f"hydra.sweep.subdir={t.number}"] for t in batch]
            returned = self.launcher.launch(overrides, initial_job_idx=batch[0].number)
            for trial, job in zip(batch, returned, strict=True):
                self._tell(study, trial.number, job)
        self._best(study)

    def _values(self, trial: Any) -> list[str]:
        return [f"++{name}={value}" for name, value in trial.params.items()]

    def _take(self, study: Any) -> list[Any]:
        """Return trials for the next launch: first unfinished ones whose process has ended, then new ones."""
        taken: list[Any] = []
        with self._alone():
            for trial in study.get_trials(deepcopy=False):
                if len(taken) < self.at_once and not trial.state.is_finished() and self._hold(trial.number):
                    log.info("trial %d continues: its process has ended", trial.number)
                    taken.append(trial)
            while len(taken) < self.at_once and len(study.get_trials(deepcopy=False)) < self.trials:
                trial = study.ask(self.space)
                self._hold(trial.number)
                taken.append(trial)
        return taken

    def _hold(self, number: int) -> bool:
        """Reserve a trial until it has a result or this process ends; return False if another process has the trial."""
        if number in self._held:
            return False
        file = open(self.folder / ".trials" / str(number), "w")  # noqa: SIM115  (open as long as it is held)
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            return False
        self._held[number] = file
        return True

    @contextmanager
    def _alone(self) -> Iterator[None]:
        with open(self.folder / ".trials" / "all", "w") as file:
            fcntl.lockf(file, fcntl.LOCK_EX)
            yield

    def _tell(self, study: Any, number: int, job: JobReturn) -> None:
        try:
            study.tell(number, float(job.return_value))
        except Exception as error:  # any error of the job
            log.warning("trial %d failed: %s", number, error)
            study.tell(number, state=import_module("optuna").trial.TrialState.FAIL)
        self._held.pop(number).close()

    def _best(self, study: Any) -> None:
        done = [t for t in study.get_trials(deepcopy=False) if t.value is not None]
        if not done:
            return
        best = min(done, key=lambda t: t.value)
        values = [line.removeprefix("++") for line in self._values(best)]
        files.write_json(self.folder / "best.json", {"trial": best.number, "objective": best.value, "values": values})
        log.info("trial %d is the best of %d: objective %.4g, %s", best.number, len(done), best.value, " ".join(values))
