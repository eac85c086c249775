"""Every controller of every signal: its config, what makes it, and what it is made from."""

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
    """A controller: the class of its config, the function that makes it, and the parts that this function gets."""

    config: type[Any]
    make: Callable[..., Any]
    parts: tuple[str, ...] = ()


@dataclass(frozen=True)
class Part:
    """A part of a controller: its value where none is given, and the error where it cannot be None."""

    usual: Any = None
    missing: str = ""


@dataclass(frozen=True)
class Laws:
    """What the laws of a signal have in common.

    key: where a law is said in a config, and group of its presets; "": below `signals`, without any. parts: by name.
    kinds: the laws, by name.
    """

    key: str = ""
    parts: Mapping[str, Part] = field(default_factory=dict)
    kinds: dict[str, LawKind] = field(default_factory=dict)


SIGNALS = {
    DENSITY: Laws(
        "controller",
        {
            "model": Part(),  # growth, control period and largest pump rate, as calibrated
            "policy": Part(missing="needs a policy; give policy=RUN/policy.npz"),
            "plant": Part(missing="knows a simulated plant; allowed with backend=sim only"),
            "bounds": Part(),  # within which the policy's certificate lets it act; None: nobody supervises
            "flow_ml_s": Part(1.0),  # what the backend believes its pumps deliver, by which the oracle doses
            "volume_ml": Part(Bench.volume_ml),  # of the cultures, (N,) or one for all
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
    """Register a signal whose controllers have their own config key and presets. Args: as of `Laws`."""
    SIGNALS[signal] = Laws(key, parts)


def add(
    kind: str, config: type[Any], make: Callable[..., Any], what: str, parts: Sequence[str] = (), signal: str = DENSITY
) -> None:
    """Register a controller: `controller=KIND` for density, `signals.NAME.kind=KIND` for another signal.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`.
      make: called with the config and then the `parts`, returns the controller.
      what: the help text; "": that of the preset in conf/.
      parts: other objects that `make` needs, from those of the signal.
      signal: what the controller holds: density, or a signal of `experiments.loop.signals.add`.
    Raises: ValueError for a kind that exists, or a part that the signal lacks.
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
        missing = f"none: no such signal; bring it by extend=FILE.py, or one of {', '.join(SIGNALS)}"
        key = f"{held.key or f'signals.{signal}'}.kind"
        raise NotAllowed(key=key, given=kind, allowed=", ".join(held.kinds) or missing)
    return held.kinds[kind]


def takes(kind: str, part: str, signal: str = DENSITY) -> bool:
    """Tell whether a controller is made from this part, e.g. "policy". Raises: ValueError naming the controllers."""
    return part in _kind(kind, signal).parts


def on_device(kind: str) -> str:
    """Return the density controller, if it needs no simulated plant. Raises: ValueError naming those that do not."""
    known = [name for name, law in KINDS.items() if "plant" not in law.parts]
    if kind not in known:
        raise NotAllowed(key="controller_kind", given=kind, allowed=", ".join(known))
    return kind


def config(kind: str, signal: str = DENSITY) -> Any:
    """Return the default config of a controller. Raises: ValueError naming the controllers."""
    return _kind(kind, signal).config()


def config_at(kind: str, key: str) -> Any:
    """Return the default config of a law by where it stands: controller, controllers.NAME, signals.NAME.

    Raises: ValueError naming the laws there are.
    """
    group, _, name = key.partition(".")
    keys = {held.key + s: signal for signal, held in SIGNALS.items() for s in ("", "s") if held.key}
    return config(kind, keys.get(group, name))


def build(config: Any, signal: str = DENSITY, **given: Any) -> Any:
    """Build the law that a config describes: of the density a `Controller`.

    Args: config: as `config` gives it; `kind` names the law. given: parts of the signal, by name.
    Raises: ValueError naming what is missing for this law.
    """
    law, held, made = _kind(config.kind, signal), SIGNALS[signal], {}
    for name in law.parts:
        part = held.parts[name]
        made[name] = given.get(name, part.usual)
        if made[name] is None and part.missing:
            raise ValueError(f"{held.key} = {config.kind}: {part.missing}")
    return law.make(config, **made)
