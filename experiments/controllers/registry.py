"""Every kind of controller: its config, its class, and what the class is built from."""

from collections.abc import Callable, Sequence
from typing import Any

from conf import presets
from dqn.policy import Policy
from envs.bench import Bench
from envs.plant.plant import Plant
from envs.task import EnvConfig
from experiments.certification.bounds import EstimateBounds
from experiments.controllers.base import Array, Controller
from experiments.controllers.baselines import Hold, HoldConfig, Threshold, ThresholdConfig
from experiments.controllers.inverse import Inverse, InverseConfig
from experiments.controllers.learned import LearnedConfig, learned
from experiments.controllers.mpc import Mpc, MpcConfig
from experiments.controllers.oracle import Oracle, OracleConfig
from experiments.controllers.pi import ChiBioPI, ChiBioPIConfig, TunedPI, TunedPIConfig

__all__ = ["add", "build", "config", "on_device"]

KINDS: dict[str, tuple[type[Any], Callable[..., Controller], tuple[str, ...]]] = {
    "dqn": (LearnedConfig, learned, ("config", "policy", "model", "bounds")),
    "pi": (ChiBioPIConfig, ChiBioPI, ("config", "volume_ml")),
    "pi_tuned": (TunedPIConfig, TunedPI, ("config", "model")),
    "mpc": (MpcConfig, Mpc, ("config", "model")),
    "inverse": (InverseConfig, Inverse, ("config", "model")),
    "threshold": (ThresholdConfig, Threshold, ("config",)),
    "hold": (HoldConfig, Hold, ("config", "model")),
    "oracle": (OracleConfig, Oracle, ("config", "plant", "model", "flow_ml_s")),
}
PARTS = ("model", "policy", "plant", "bounds", "flow_ml_s", "volume_ml")
MISSING = {
    "policy": "needs a policy; give policy=RUN/policy.npz",
    "plant": "knows a simulated plant; allowed with backend=sim only",
}


def add(kind: str, config: type[Any], make: Callable[..., Controller], what: str, parts: Sequence[str] = ()) -> None:
    """Make a controller known as `controller=KIND` to every command.

    Args:
      kind: its name, the default of the field `kind` of `config`.
      config: dataclass of its values, whose fields are made by `conf.schema.setting`.
      make: called with the config and then the `parts`, returns the controller.
      what: the sentence that the help shows.
      parts: what else it is built from, arguments of `build`.
    Raises: ValueError for a kind that exists, or a part that nobody has.
    """
    if wrong := set(parts) - set(PARTS):
        raise ValueError(f"controller {kind}: no part {sorted(wrong)[0]}; allowed {', '.join(PARTS)}")
    presets.add(f"controller/{kind}", {"kind": kind}, what)
    KINDS[kind] = (config, make, ("config", *parts))


def on_device(kind: str) -> str:
    """The kind itself, if it needs no simulated plant. Raises: ValueError naming the kinds that can run a device."""
    known = [name for name, (_, _, parts) in KINDS.items() if "plant" not in parts]
    if kind not in known:
        raise ValueError(f"controller_kind = {kind}: allowed {', '.join(known)}")
    return kind


def config(kind: str) -> Any:
    """The default config of this kind of controller. Raises: ValueError naming the kinds there are."""
    if kind not in KINDS:
        raise ValueError(f"controller.kind = {kind}: allowed {', '.join(KINDS)}")
    return KINDS[kind][0]()


def build(
    config: Any,
    model: EnvConfig,
    policy: Policy | None = None,
    plant: Plant | None = None,
    flow_ml_s: float = 1.0,
    bounds: EstimateBounds | None = None,
    volume_ml: Array | float = Bench.volume_ml,
) -> Controller:
    """The controller that a config describes.

    Args:
      config: as `config` gives it; `kind` names the controller.
      model: the calibrated growth model, control period and largest pump rate, for those that use a model.
      policy: what `dqn` follows. plant: the vials that `oracle` knows; only a simulation has it.
      bounds: within which the certificate of `policy` lets it act; None where it has none, and nobody supervises.
      flow_ml_s: what the backend believes its pumps deliver (the oracle must know what a rate becomes).
      volume_ml: of the cultures, as the bench says, (N,) or one for all.
    Raises: ValueError naming what is missing for this kind of controller.
    """
    if config.kind not in KINDS:
        raise ValueError(f"controller.kind = {config.kind}: no such controller")
    _, make, parts = KINDS[config.kind]
    given = {"config": config, "model": model, "policy": policy, "plant": plant, "flow_ml_s": flow_ml_s}
    given |= {"bounds": bounds, "volume_ml": volume_ml}
    for part in parts:
        if given[part] is None and part in MISSING:
            raise ValueError(f"controller = {config.kind}: {MISSING[part]}")
    return make(**{part: given[part] for part in parts})
