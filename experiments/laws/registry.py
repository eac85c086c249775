"""Every law of every signal: its config, what makes it, and what it is made from."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from conf import presets
from conf.messages import NotAllowed
from dqn.policy import Policy
from envs.bench import Bench
from envs.coculture.pair import PairConfig
from envs.plant.plant import Plant
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.laws.base import Array
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
from experiments.laws.share.laws import (
    PI,
    BangBang,
    BangBangConfig,
    InverseDynamics,
    InverseDynamicsConfig,
    Midpoint,
    MidpointConfig,
    Myopic,
    MyopicConfig,
    PIConfig,
    Proportional,
    ProportionalConfig,
)  # fmt: skip
from experiments.laws.share.learned import LearnedLaw, LearnedLawConfig, PreviewLawConfig
from experiments.laws.share.planned import Optimum, OptimumConfig, Receding, RecedingConfig
from experiments.laws.share.program import Program

__all__ = ["DENSITY", "FORESIGHT", "KINDS", "SHARE", "LawKind", "add", "build", "config", "on_device", "takes"]

DENSITY, SHARE = "density", "share"
GROUPS = {DENSITY: "controller", SHARE: "composition"}  # of presets, and key of the config
PARTS = ("model", "policy", "plant", "bounds", "flow_ml_s", "program", "volume_ml", "pair")
MISSING = {
    (DENSITY, "policy"): "needs a policy; give policy=RUN/policy.npz",
    (DENSITY, "plant"): "knows a simulated plant; allowed with backend=sim only",
    (SHARE, "policy"): "needs a policy; give policy=RUN/policy.npz of a training with env=coculture or "
    "env=coculture_preview",
    (SHARE, "program"): "plans the whole program; give a scenario with ratios",
}
FORESIGHT = ("dqn_preview", "midpoint", "receding", "optimum")
"""Laws of the share that act on what is announced."""


@dataclass(frozen=True)
class LawKind:
    """A law: the class of its config, what makes it, and the parts with which that is called after the config."""

    config: type[Any]
    make: Callable[..., Any]
    parts: tuple[str, ...] = ()


KINDS: dict[str, dict[str, LawKind]] = {
    DENSITY: {
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
    SHARE: {
        "dqn": LawKind(LearnedLawConfig, LearnedLaw, ("policy", "pair")),
        "dqn_preview": LawKind(PreviewLawConfig, LearnedLaw, ("policy", "pair")),
        "pi": LawKind(PIConfig, PI, ("pair",)),
        "proportional": LawKind(ProportionalConfig, Proportional, ("pair",)),
        "inverse_dynamics": LawKind(InverseDynamicsConfig, InverseDynamics, ("pair",)),
        "bang_bang": LawKind(BangBangConfig, BangBang, ("pair",)),
        "myopic": LawKind(MyopicConfig, Myopic, ("pair",)),
        "midpoint": LawKind(MidpointConfig, Midpoint, ("pair",)),
        "receding": LawKind(RecedingConfig, Receding, ("pair",)),
        "optimum": LawKind(OptimumConfig, Optimum, ("program", "pair")),
    },
}


def add(
    kind: str, config: type[Any], make: Callable[..., Any], what: str, parts: Sequence[str] = (), signal: str = DENSITY
) -> None:
    """Make a law known: `controller=KIND` of the density, `composition=KIND` of the share, `signals.NAME.kind=KIND`.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`; one of the share also has the
        field `estimator` of `experiments.laws.share.laws.LawConfig`.
      make: called with the config and then the `parts`, returns the law.
      what: the sentence that the help shows.
      parts: what else it is made from, arguments of `build`.
      signal: which it holds: density, share, or one of one's own (`experiments.loop.signals.add`).
    Raises: ValueError for a kind that exists, or a part that nobody has.
    """
    if wrong := set(parts) - set(PARTS):
        raise ValueError(f"{signal}, law {kind}: no part {sorted(wrong)[0]}; allowed {', '.join(PARTS)}")
    if signal in GROUPS:
        presets.add(f"{GROUPS[signal]}/{kind}", {"kind": kind}, what)
    KINDS.setdefault(signal, {})[kind] = LawKind(config, make, tuple(parts))


def _kind(kind: str, signal: str) -> LawKind:
    if kind not in KINDS.get(signal, {}):
        key = f"{GROUPS.get(signal, f'signals.{signal}')}.kind"
        missing = f"none: no such signal; bring it by extend=FILE.py, or one of {', '.join(KINDS)}"
        allowed = ", ".join(KINDS.get(signal, {})) or missing
        raise NotAllowed(key=key, given=kind, allowed=allowed)
    return KINDS[signal][kind]


def takes(kind: str, part: str, signal: str = DENSITY) -> bool:
    """Whether a law is made from this part, "policy" say. Raises: ValueError naming the laws there are."""
    return part in _kind(kind, signal).parts


def on_device(kind: str) -> str:
    """Return the law of the density, if it needs no simulated plant. Raises: ValueError naming those that do not."""
    known = [name for name, law in KINDS[DENSITY].items() if "plant" not in law.parts]
    if kind not in known:
        raise NotAllowed(key="controller_kind", given=kind, allowed=", ".join(known))
    return kind


def config(kind: str, signal: str = DENSITY) -> Any:
    """Return the default config of a law. Raises: ValueError naming the laws there are."""
    return _kind(kind, signal).config()


def config_at(kind: str, key: str) -> Any:
    """Return the default config of a law by where it stands: controller, compositions.NAME, signals.NAME.

    Raises: ValueError naming the laws there are.
    """
    group, _, name = key.partition(".")
    groups = {word + s: signal for signal, word in GROUPS.items() for s in ("", "s")}
    return config(kind, groups.get(group, name))


def build(
    config: Any,
    signal: str = DENSITY,
    *,
    model: EnvConfig | None = None,
    policy: Policy | None = None,
    plant: Plant | None = None,
    flow_ml_s: float = 1.0,
    bounds: EstimateBounds | None = None,
    program: Program | None = None,
    volume_ml: Array | float = Bench.volume_ml,
    pair: PairConfig | None = None,
) -> Any:
    """Build the law that a config describes, a `Controller` of the density or a `Law` of the share.

    Args:
      config: as `config` gives it; `kind` names the law.
      model: the calibrated growth model, control period and largest pump rate.
      policy: what a learned law follows. program: of shares, which `optimum` plans.
      plant: the vials that `oracle` knows; only a simulation has it. flow_ml_s: what the backend believes its pumps
        deliver (the oracle must know what a rate becomes).
      bounds: within which the certificate of `policy` lets it act; None where it has none, and nobody supervises.
      volume_ml: of the cultures, as the bench says, (N,) or one for all.
      pair: the two species whose share a law holds; None: the default one.
    Raises: ValueError naming what is missing for this law.
    """
    law = _kind(config.kind, signal)
    given = dict(zip(PARTS, (model, policy, plant, bounds, flow_ml_s, program, volume_ml, pair), strict=True))
    for part in law.parts:
        if given[part] is None and (signal, part) in MISSING:
            raise ValueError(f"{GROUPS[signal]} = {config.kind}: {MISSING[signal, part]}")
    return law.make(config, **{part: given[part] for part in law.parts})
