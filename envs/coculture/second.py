"""Two species in simulated vials: their settings in the config of a plant, and the strain and sensor made from them."""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from conf.schema import check, part, setting
from envs.coculture.fluorescence import FluorescenceConfig, FluorescenceSensor
from envs.coculture.pair import PairConfig
from envs.plant.noise import Streams, spread, uniform
from envs.plant.plant import PlantConfig
from envs.plant.strains import REFERENCE_TEMPERATURE, TEMPERATURE_LAWS, Strain, response

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SecondSpeciesConfig:
    """Second species in the same medium; by default there is none.

    Both species share substrate, yield, k_s and wall constants. They also share every change of growth with time:
    drift, ramp, knots (relative to their mean), stirrer.
    """

    start_share: tuple[float, float] = setting(
        (0.0, 0.0),
        "range of the second species' share of the OD at reset, drawn once per vial; [0, 0]: no second species",
        within=(0, 1),
        interval=True,
    )
    mu: float = setting(0.008, "mean specific growth rate in fresh medium at 37 degC", "1/min", within=(0, 0.1))
    mu_cv: float = setting(0.0, "relative spread of mu between cultures", within=(0, 0.3))
    temperature_law: str = setting("none", "temperature dependence of mu", choices=TEMPERATURE_LAWS)
    activation_kj_mol: float = setting(56.0, "activation energy (Arrhenius)", "kJ/mol", within=(0, 150))
    adaptation_min: float = setting(0.0, "time constant of growth after a temperature change", "min", within=(0, 120))

    def __post_init__(self) -> None:
        check(self, "plant.second")

    @property
    def present(self) -> bool:
        """Whether there is a second species."""
        return self.start_share[1] > 0.0


class OfPlant:
    """Settings that two species add to the config of a plant."""

    pair: PairConfig = part(PairConfig, "curves and pigment of two species, for temperature_law=pair")
    second: SecondSpeciesConfig = part(SecondSpeciesConfig, "a second species in the vial")
    fluorescence: FluorescenceConfig = part(FluorescenceConfig, "fluorescence of the second species, and its sensor")


def of_plant(config: PlantConfig) -> OfPlant:
    return cast(OfPlant, config)


def of_pair(config: PlantConfig, pair: PairConfig) -> PlantConfig:
    """Return the config with the species of another pair; each mu is multiplied by the new / old rate at 37 degC."""
    two = of_plant(config)
    if pair == two.pair:
        return config
    by = pair.rates(REFERENCE_TEMPERATURE) / two.pair.rates(REFERENCE_TEMPERATURE)
    first = replace(config.growth, mu=config.growth.mu * float(by[0]), adaptation_min=pair.first.lag_min)
    second = replace(two.second, mu=two.second.mu * float(by[1]), adaptation_min=pair.second.lag_min)
    changed: dict[str, Any] = {"pair": pair, "growth": first, "second": second, "start_temperature": pair.even_c}
    return replace(config, **changed)


def strain(config: PlantConfig, rngs: Streams) -> tuple[list[Strain], dict[str, Array]]:
    """Return [second species], or [] without one, and its random constants by name. Args: rngs: one stream per vial."""
    second = of_plant(config).second
    if not second.present:
        return [], {}
    mu, share = spread(rngs, second.mu, second.mu_cv), uniform(rngs, *second.start_share)
    phi = response(second.temperature_law, config, second.activation_kj_mol, 1)
    return [Strain(mu, phi, second.adaptation_min, share)], {"second_mu": mu, "second_share": share}


def sensor(config: PlantConfig, rngs: Streams) -> FluorescenceSensor | None:
    """Return the fluorescence sensor, or None without a second species. Args: rngs: one stream per vial."""
    two = of_plant(config)
    return FluorescenceSensor(two.fluorescence, rngs, two.pair) if two.second.present else None
