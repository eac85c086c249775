"""What tells species apart: growth rate, how it follows temperature, and the share a second one starts with."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, setting
from envs.growth import Arrhenius, Cardinal, relative_to_37

__all__ = ["TEMPERATURE_LAWS", "SecondSpeciesConfig", "response"]

Array = NDArray[np.float64]

TEMPERATURE_LAWS = ("none", "arrhenius", "cardinal", "pair")


def response(law: str, activation_kj_mol: float, curve: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """phi(T) / phi(37 degC) of a temperature law, one of `TEMPERATURE_LAWS`.

    `pair` is the species' own curve (envs/coculture/pair.py), which stays beyond its range at the value of the nearer
    end: a `mu` quoted at 37 degC is that of the default pair at 36.
    Args: activation_kj_mol: of `arrhenius`, kJ/mol. curve: of `pair`.
    """
    laws: dict[str, Callable[[Array], Array]] = {
        "none": np.ones_like,
        "arrhenius": Arrhenius(activation_kj_mol),
        "cardinal": Cardinal(),
        "pair": curve,
    }
    return relative_to_37(laws[law])


@dataclass(frozen=True)
class SecondSpeciesConfig:
    """A second species in the same medium; by default there is none.

    It shares substrate, yield, k_s and wall constants with the first, and whatever changes growth with time: drift,
    ramp, the knots over their mean, the stirrer.
    """

    start_share: tuple[float, float] = setting(
        (0.0, 0.0),
        "its share of the OD at reset, drawn once per vial between these; [0, 0]: there is no second species",
        within=(0, 1),
        interval=True,
    )
    mu: float = setting(0.008, "mean specific growth rate in fresh medium at 37 degC", "1/min", within=(0, 0.1))
    mu_cv: float = setting(0.0, "its relative spread between cultures", within=(0, 0.3))
    temperature_law: str = setting("none", "how mu follows temperature", choices=TEMPERATURE_LAWS)
    activation_kj_mol: float = setting(56.0, "Ea of the Arrhenius law", "kJ/mol", within=(0, 150))
    adaptation_min: float = setting(0.0, "time constant with which growth follows temperature", "min", within=(0, 120))

    def __post_init__(self) -> None:
        check(self, "plant.second")

    @property
    def present(self) -> bool:
        """Whether there is one at all."""
        return self.start_share[1] > 0.0
