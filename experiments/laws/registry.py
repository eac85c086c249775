"""Registry of the controllers of all signals: their configs, and how each is built."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from conf import presets
from conf.messages import NotAllowed
from envs.bench import Bench
from experiments.laws.density.baselines import (
    GainScheduled,
    GainScheduledConfig,
    Hold,
    HoldConfig,
    Threshold,
    ThresholdConfig,
)
from experiments.laws.density.inverse import Inverse, InverseConfig
from experiments.laws.density.learned import LearnedConfig, learned
from experiments.laws.density.mpc import Mpc, MpcConfig
from experiments.laws.density.oracle import Oracle, OracleConfig
from experiments.laws.density.pi import ChiBioPI, ChiBioPIConfig, TunedPI, TunedPIConfig

DENSITY = "density"


@dataclass(frozen=True)
class LawKind:
    """Registered controller. config: class of its config. make: function that builds it. parts: arguments of `make`."""

    config: type[Any]
    make: Callable[..., Any]
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Part:
    """Object that controllers can need. usual: its default. missing: error text if it is None; "": None is allowed."""

    usual: Any = None
    missing: str = ""


@dataclass(frozen=True)
class Laws:
    """Controllers of a signal.

    key: config key of the controller and group of its presets; "": the key is signals.NAME, without presets.
    parts: name -> object that a controller can need. kinds: name -> controller.
    """

    key: str = ""
    parts: Mapping[str, Part] = field(default_factory=dict)
    kinds: dict[str, LawKind] = field(default_factory=dict)


SIGNALS = {
    DENSITY: Laws(
        "controller",
        {
            "model": Part(),  # growth model, control period and largest pump rate
            "policy": Part(missing="needs a policy; give policy=RUN/policy.npz"),
            "plant": Part(missing="needs the exact state of a simulated plant; use it only with backend=sim"),
            "bounds": Part(),  # bounds on estimation errors from the policy's certificate; None: not supervised
            "flow_ml_s": Part(1.0),  # pump flow that the backend assumes; the oracle computes doses from it
            "volume_ml": Part(Bench.volume_ml),  # volume of the cultures, (N,) or one for all
        },
        {
            "dqn": LawKind(LearnedConfig, learned, ("policy", "model", "bounds")),
            "pi": LawKind(ChiBioPIConfig, ChiBioPI, ("volume_ml",)),
            "pi_tuned": LawKind(TunedPIConfig, TunedPI, ("model",)),
            "mpc": LawKind(MpcConfig, Mpc, ("model",)),
            "inverse": LawKind(InverseConfig, Inverse, ("model",)),
            "threshold": LawKind(ThresholdConfig, Threshold),
            "gain_scheduled": LawKind(GainScheduledConfig, GainScheduled, ("model",)),
            "hold": LawKind(HoldConfig, Hold, ("model",)),
            "oracle": LawKind(OracleConfig, Oracle, ("plant", "model", "flow_ml_s")),
        },
    )
}
KINDS = SIGNALS[DENSITY].kinds
"""The controllers of the density."""


def hold(signal: str, key: str, parts: Mapping[str, Part]) -> None:
    """Register a signal whose controllers have their own config key and presets. Args as in `Laws`."""
    SIGNALS[signal] = Laws(key, parts)


def add(
    kind: str, config: type[Any], make: Callable[..., Any], what: str, parts: Sequence[str] = (), signal: str = DENSITY
) -> None:
    """Register a controller: `controller=KIND` for density, `signals.NAME.kind=KIND` for another signal.

    Args:
      kind: name of the controller; also the default of the field `kind` of `config`.
      config: dataclass of its settings; define the fields with `conf.schema.setting`.
      make: function that receives the config and the `parts`, and returns the controller.
      what: the help text; "": use the help text of the preset in conf/.
      parts: names of other objects that `make` needs; the signal must have them.
      signal: the quantity to control: density, or a signal registered by `experiments.loop.signals.add`.
    Raises: ValueError if the kind exists or the signal lacks a part.
    """
    held = SIGNALS.setdefault(signal, Laws())
    if wrong := set(parts) - set(held.parts):
        raise ValueError(
            f"{signal}, controller {kind}: no part {sorted(wrong)[0]}; allowed {', '.join(held.parts) or 'none'}"
        )
    if held.key and what:
        presets.add(f"{held.key}/{kind}", {"kind": kind}, what)
    held.kinds[kind] = LawKind(config, make, tuple(parts))


def _kind(kind: str, signal: str) -> LawKind:
    held = SIGNALS.get(signal, Laws())
    if kind not in held.kinds:
        missing = f"none, because there is no such signal; define it in extend=FILE.py, or use {', '.join(SIGNALS)}"
        key = f"{held.key or f'signals.{signal}'}.kind"
        raise NotAllowed(key=key, given=kind, allowed=", ".join(held.kinds) or missing)
    return held.kinds[kind]


def takes(kind: str, part: str, signal: str = DENSITY) -> bool:
    """Return whether a controller needs a part, e.g. "policy". Raises: ValueError with the known controllers."""
    return part in _kind(kind, signal).parts


def on_device(kind: str) -> str:
    """Return `kind` if this density controller can run on a device (without a plant). Raises: ValueError otherwise."""
    known = [name for name, law in KINDS.items() if "plant" not in law.parts]
    if kind not in known:
        raise NotAllowed(key="controller_kind", given=kind, allowed=", ".join(known))
    return kind


def config(kind: str, signal: str = DENSITY) -> Any:
    """Return the default config of a controller. Raises: ValueError with the known controllers."""
    return _kind(kind, signal).config()


def config_at(kind: str, key: str) -> Any:
    """Return the default config of a controller at a key (controller, controllers.NAME, signals.NAME)."""
    group, _, name = key.partition(".")
    keys = {held.key + s: signal for signal, held in SIGNALS.items() for s in ("", "s") if held.key}
    return config(kind, keys.get(group, name))


def build(config: Any, signal: str = DENSITY, **given: Any) -> Any:
    """Build the controller that a config describes; a density controller is a `Controller`.

    Args: config: config of a registered controller. given: name -> part of the signal.
    Raises: ValueError naming a part that the controller needs and that is missing.
    """
    law, held, made = _kind(config.kind, signal), SIGNALS[signal], {}
    for name in law.parts:
        part = held.parts[name]
        made[name] = given.get(name, part.usual)
        if made[name] is None and part.missing:
            raise ValueError(f"{held.key} = {config.kind}: {part.missing}")
    return law.make(config, **made)
