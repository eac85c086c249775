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
    """Interface of an estimator of error e = ln(x/r)/B and growth share s = mu h/B of N vials (`envs/relative.py`).

    For each sample a controller calls `watch`, `see`, the methods that return estimates, and `decided`. Between two
    samples it calls `dosed`.
    """

    def reset(self, n: int) -> None:
        """Reset the state for n vials."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Process a sample, also before control begins, as in `Watches.watch`."""

    def see(self, od: Array, minute: Array, rows: Mask) -> None:
        """Process a sample for which the controller decides; only `rows` have a usable reading."""

    def decided(self, rate: Array) -> None:
        """Process the decided pump rates, mL/s, (N,); they are used if delivered volumes are not reported."""

    def dosed(self, volume_ml: Array) -> None:
        """Process the volume delivered since the last call, mL, (N,)."""

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the current estimates of e and s, (N,) each."""

    def doubt(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of e and s for the comparison with a certificate's bounds, (N,) each."""

    def sd(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of e and s reported to the user, (N,) each."""

    @property
    def full_pump(self) -> Array:
        """B, decrease of ln x in one period at full pump rate, (N,)."""

    @property
    def loudness(self) -> Array:
        """Sum of the squares of the last ten innovations in units of their sd, each square cut to 9, (N,)."""

    @property
    def loud(self) -> Mask:
        """Whether recent innovations are far too large for a correct filter, (N,)."""

    @property
    def quiet(self) -> Mask:
        """Whether innovations have been far too small for a long time, (N,)."""

    def explain(self) -> dict[str, Array]:
        """Return the values behind the estimates, name -> (N,)."""


class EstimatorKind(NamedTuple):
    """Registered estimator. config: class of its config. make: builds it. fixed: returns its constants by name."""

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
      kind: name of the estimator; also the default of the field `kind` of `config`.
      config: dataclass of its settings; define the fields with `conf.schema.setting`.
      make: function that builds it from config and growth model.
      fixed: function that returns constants that affect decisions; certificates contain them.
    Raises: ValueError if the kind exists.
    """
    if kind in KINDS:
        raise NameTaken(what="estimator", name=kind)
    KINDS[kind] = EstimatorKind(config, make, fixed)


def config_at(kind: str, key: str = "controller.estimator") -> Any:
    """Return the default config of an estimator; kind "" means kalman. Raises: ValueError with the known kinds."""
    if (kind or "kalman") not in KINDS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(KINDS))
    return KINDS[kind or "kalman"].config()


def build(config: Any, model: EnvConfig) -> DensityEstimator:
    """Build the estimator that a config describes; its initial estimates are mu and tau of the model."""
    return KINDS[config.kind].make(config, model)


def settings(config: Any) -> dict[str, Any]:
    """Return all settings (`estimator.KEY`) and constants (`filter.KEY`) of the estimator that a config describes."""
    own = {f"estimator.{key}": value for key, value in asdict(config).items()}
    fixed = {f"filter.{key}": value for key, value in KINDS[config.kind].fixed().items()}
    return {key: list(value) if isinstance(value, tuple) else value for key, value in (own | fixed).items()}


class WithEstimator:
    """Wrapper that adds the default estimator to a controller; the controller decides as before.

    Args: law: controller without an estimator. model: control period, and the estimator's initial mu and tau.
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
