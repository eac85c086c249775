"""Interface of density estimators for controllers, supervisor and certificate, and their registry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

from conf.messages import NameTaken, NotAllowed
from envs.task import EnvConfig
from experiments.laws.base import Accounts, Array, Controller, Explains, Mask, Watches
from experiments.laws.density.estimator import Estimator, EstimatorConfig, fixed
from hardware.memory import Remembers


class DensityEstimator(Remembers, Protocol):
    """Estimates of error e = ln(x/r)/B and growth share s = mu h/B of N vials (`envs/relative.py`), structurally.

    For each sample a controller calls `watch`, `see`, `relative` and the rest, then `decided`; `dosed` comes in
    between.
    """

    def reset(self, n: int) -> None:
        """Forget everything; N rows."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Take a sample, also before control begins, as `Watches.watch`."""

    def see(self, od: Array, minute: Array, rows: Mask) -> None:
        """Take the sample of a decision; `rows` are usable."""

    def decided(self, rate: Array) -> None:
        """Take the decided rates, mL/s, (N,), for the case that volumes delivered are not reported."""

    def dosed(self, volume_ml: Array) -> None:
        """Take the volume delivered since the last call, mL, (N,)."""

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return e and s now, each (N,)."""

    def doubt(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of both for the comparison with a certificate's bounds, each (N,)."""

    def sd(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of both for the user, each (N,)."""

    @property
    def full_pump(self) -> Array:
        """B, decrease of ln x in one period at full pump rate, (N,)."""

    @property
    def loudness(self) -> Array:
        """Sum of the squares of the last ten innovations in units of their sd, each at most 9, (N,)."""

    @property
    def loud(self) -> Mask:
        """Whether innovations are impossibly large, (N,)."""

    @property
    def quiet(self) -> Mask:
        """Whether they have been far too small for a long time, (N,)."""

    def explain(self) -> dict[str, Array]:
        """Return the values behind the estimates, by name, (N,) each."""


class EstimatorKind(NamedTuple):
    """Function that makes an estimator from config and model, and its constants by name."""

    config: type[Any]
    make: Callable[[Any, EnvConfig], DensityEstimator]
    fixed: Callable[[], Mapping[str, Any]]


KINDS = {"kalman": EstimatorKind(EstimatorConfig, Estimator, fixed)}


def add(
    kind: str,
    config: type[Any],
    make: Callable[[Any, EnvConfig], DensityEstimator],
    fixed: Callable[[], Mapping[str, Any]] = dict,
) -> None:
    """Register an estimator as `controller.estimator.kind=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`.
      make: called with config and growth model.
      fixed: constants that affect decisions; a certificate also has them.
    Raises: ValueError for a kind that exists.
    """
    if kind in KINDS:
        raise NameTaken(what="estimator", name=kind)
    KINDS[kind] = EstimatorKind(config, make, fixed)


def config_at(kind: str, key: str = "controller.estimator") -> Any:
    """Return the default config of an estimator, "": kalman. Raises: ValueError with the known kinds."""
    if (kind or "kalman") not in KINDS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(KINDS))
    return KINDS[kind or "kalman"].config()


def build(config: Any, model: EnvConfig) -> DensityEstimator:
    """Make the estimator of a config; it starts at mu and tau of the model."""
    return KINDS[config.kind].make(config, model)


def settings(config: Any) -> dict[str, Any]:
    """Return all settings and constants of the estimator of a config, by name: `estimator.KEY`, `filter.KEY`."""
    own = {f"estimator.{key}": value for key, value in asdict(config).items()}
    fixed = {f"filter.{key}": value for key, value in KINDS[config.kind].fixed().items()}
    return {key: list(value) if isinstance(value, tuple) else value for key, value in (own | fixed).items()}


class WithEstimator:
    """A controller without an estimator, with the default estimator for information only.

    Args: law: the controller. model: initial mu and tau of the estimator, and control period.
    """

    def __init__(self, law: Controller, model: EnvConfig) -> None:
        self.law, self.estimator = law, build(EstimatorConfig(), model)
        self.remembers = ("law", "estimator") if isinstance(law, Remembers) else ("estimator",)

    def reset(self, n: int) -> None:
        self.law.reset(n)
        self.estimator.reset(n)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        self.estimator.watch(od, temperature, minute, rows)
        if isinstance(self.law, Watches):
            self.law.watch(od, temperature, minute, rows)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        self.estimator.see(od, minute, rows)
        rate = self.law.act(od, setpoint, minute, rows)
        self.estimator.decided(rate)
        return rate

    def dosed(self, volume_ml: Array) -> None:
        self.estimator.dosed(volume_ml)
        if isinstance(self.law, Accounts):
            self.law.dosed(volume_ml)

    def explain(self) -> dict[str, Array]:
        """Explain the controller's decision, and the estimates for announced changes."""
        own = self.law.explain() if isinstance(self.law, Explains) else {}
        return self.estimator.explain() | own
