"""What laws, supervisor and certificate ask of an estimator of the density, and where one is added."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, NamedTuple, Protocol

from conf.messages import NameTaken, NotAllowed
from envs.task import EnvConfig
from experiments.laws.base import Accounts, Array, Controller, Explains, Mask, Watches
from experiments.laws.density.estimator import Estimator, EstimatorConfig, fixed
from hardware.memory import Remembers

__all__ = ["DensityEstimator", "WithEstimator", "add", "build", "config_at", "settings"]


class DensityEstimator(Remembers, Protocol):
    """Estimates of error e = ln(x/r)/B and growth share s = mu h/B of N vials (`envs/relative.py`), structurally.

    A law calls for each sample `watch`, `see`, `relative` and the rest, then `decided`; `dosed` comes in between.
    """

    def reset(self, n: int) -> None:
        """Forget everything; N rows."""

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """Take a sample of reactors that need not be controlled yet, as `Watches.watch`."""

    def see(self, od: Array, minute: Array, rows: Mask) -> None:
        """Take the sample on which a law decides; `rows` may be used."""

    def decided(self, rate: Array) -> None:
        """Take what was decided, mL/s, (N,), for where nobody tells what was given."""

    def dosed(self, volume_ml: Array) -> None:
        """Take fresh medium that went in since this was last called, mL, (N,)."""

    def relative(self, setpoint: Array) -> tuple[Array, Array]:
        """Return e and s now, each (N,)."""

    def doubt(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of both that the supervisor holds against the bounds of a certificate, each (N,)."""

    def sd(self, setpoint: Array) -> tuple[Array, Array]:
        """Return the sd of both for the user, each (N,)."""

    @property
    def full_pump(self) -> Array:
        """B, what one period of full pump takes off ln x, (N,)."""

    @property
    def loudness(self) -> Array:
        """Sum of the squares of the last ten innovations in units of their sd, each at most 9, (N,)."""

    @property
    def loud(self) -> Mask:
        """Whether readings are far further off than it believes possible, (N,)."""

    @property
    def quiet(self) -> Mask:
        """Whether they have long been far closer, so that it takes itself for less sure than it is, (N,)."""

    def explain(self) -> dict[str, Array]:
        """Return what is behind the estimates, by name, (N,) each."""


class EstimatorKind(NamedTuple):
    """What makes an estimator of config and model, and what decides in it beside its config, by name."""

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
    """Make an estimator known as `controller.estimator.kind=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`.
      make: called with config and growth model.
      fixed: what decides beside the config and no config changes; a certificate names it, too.
    Raises: ValueError for a kind that exists.
    """
    if kind in KINDS:
        raise NameTaken(what="estimator", name=kind)
    KINDS[kind] = EstimatorKind(config, make, fixed)


def config_at(kind: str, key: str = "controller.estimator") -> Any:
    """Return the default config of an estimator, "": kalman. Raises: ValueError naming those there are."""
    if (kind or "kalman") not in KINDS:
        raise NotAllowed(key=f"{key}.kind", given=kind, allowed=", ".join(KINDS))
    return KINDS[kind or "kalman"].config()


def build(config: Any, model: EnvConfig) -> DensityEstimator:
    """Make the estimator of a config; mu and tau of the model are where it begins."""
    return KINDS[config.kind].make(config, model)


def settings(config: Any) -> dict[str, Any]:
    """Return everything that decides in the estimator of a config, by name: `estimator.KEY`, `filter.KEY`."""
    own = {f"estimator.{key}": value for key, value in asdict(config).items()}
    fixed = {f"filter.{key}": value for key, value in KINDS[config.kind].fixed().items()}
    return {key: list(value) if isinstance(value, tuple) else value for key, value in (own | fixed).items()}


class WithEstimator:
    """A controller that estimates nothing, and the default estimator beside it, which decides nothing.

    Args: law: the controller. model: mu, tau and control period with which the estimator begins.
    """

    def __init__(self, law: Controller, model: EnvConfig) -> None:
        self.law, self.estimator = law, build(EstimatorConfig(), model)
        self.remembers = ("law", "estimator") if isinstance(law, Remembers) else ("estimator",)

    def reset(self, n: int) -> None:
        """See `Controller.reset`."""
        self.law.reset(n)
        self.estimator.reset(n)

    def watch(self, od: Array, temperature: Array, minute: Array, rows: Mask) -> None:
        """See `Watches.watch`."""
        self.estimator.watch(od, temperature, minute, rows)
        if isinstance(self.law, Watches):
            self.law.watch(od, temperature, minute, rows)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """See `Controller.act`: the law's."""
        self.estimator.see(od, minute, rows)
        rate = self.law.act(od, setpoint, minute, rows)
        self.estimator.decided(rate)
        return rate

    def dosed(self, volume_ml: Array) -> None:
        """See `Accounts.dosed`."""
        self.estimator.dosed(volume_ml)
        if isinstance(self.law, Accounts):
            self.law.dosed(volume_ml)

    def explain(self) -> dict[str, Array]:
        """Explain the law's decision, and the estimates by which changes are aimed ahead."""
        own = self.law.explain() if isinstance(self.law, Explains) else {}
        return self.estimator.explain() | own
