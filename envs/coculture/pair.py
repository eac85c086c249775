"""Two species in one vial: the growth of each as a function of temperature, and the pigment of the second.

The default pair is E. coli and P. putida from Lee, Morlock, Allan, Steel, Cell Reports Methods 5:101009 (2025) and its
public model Janmorlock/CompEst3000. It was fitted to batch growth between 29 and 36 degC. For other species see
docs/coculture.md, Another pair of species.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml  # type: ignore[import-untyped]
from numpy.typing import NDArray

from conf import presets
from conf.schema import build, check, part, require, setting

Array = NDArray[np.float64]

STEPS = 71  # number of temperatures between which crossings of the growth curves are sought
PLAUSIBLE = (0.02, 10.0)  # range of the fastest growth rate, 1/h; a rate given per minute lies below
FILE = "pair.yaml"
NEEDED = ("first", "second", "pigment", "temperatures")  # keys of a file; no other pair replaces a missing one


@dataclass(frozen=True)
class SpeciesConfig:
    """Growth rate mu of a species at temperature T: a polynomial, or cardinal temperatures (Rosso et al. 1993).

    mu(T) = sum_k c_k T^k
    mu(T) = mu_opt (T - t_max)(T - t_min)^2 / ((t_opt - t_min)((t_opt - t_min)(T - t_opt)
            - (t_opt - t_max)(t_opt + t_min - 2 T))),     0 outside t_min to t_max
    """

    name: str = setting("E. coli", "name in figures")
    polynomial: tuple[float, ...] = setting(
        (0.07727, -1.66954), "mu(T) in 1/h of T in degC, highest power first; empty: `cardinal` is used"
    )
    cardinal: tuple[float, ...] = setting(
        (), "lowest, best and highest temperature of growth, degC, and the rate at the best, 1/h"
    )
    lag_min: float = setting(2.0, "time constant with which growth follows temperature", "min", within=(0, 600))

    def __post_init__(self) -> None:
        check(self, "pair")
        require(bool(self.polynomial) != bool(self.cardinal), "pair", self.name, "either polynomial or cardinal")
        for key in ("polynomial", "cardinal"):
            given = getattr(self, key)
            require(bool(np.isfinite(given).all()), f"pair, {key} of {self.name}", given, "numbers")
        if self.cardinal:
            risen = len(self.cardinal) == 4 and self.cardinal[0] < self.cardinal[1] < self.cardinal[2]
            right = risen and 2 * self.cardinal[1] > self.cardinal[0] + self.cardinal[2] and self.cardinal[3] > 0
            allowed = "[t_min, t_opt, t_max, mu_opt], rising, t_opt nearer to t_max, mu_opt > 0"
            require(right, f"pair, cardinal of {self.name}", self.cardinal, allowed)

    def rate(self, temperature: Array) -> Array:
        """Compute mu(T), 1/h, at temperatures in degC, any shape; at least 0."""
        if self.polynomial:
            return np.asarray(np.maximum(np.polyval(self.polynomial, temperature), 0.0))
        low, best, high, most = self.cardinal
        t = np.clip(temperature, low, high)
        below = (best - low) * ((best - low) * (t - best) - (best - high) * (best + low - 2.0 * t))
        return np.asarray(most * (t - high) * (t - low) ** 2 / below)


@dataclass(frozen=True)
class PigmentConfig:
    """Pigment f of the second species, whose light the sensor counts: f' = g p - D f.

    The production g lags behind the temperature:
    g' = follow (g_ss(T) - g(t - delay)),  g_ss(T) = max(least, sum_k c_k (T - centre)^k),  g >= least.
    """

    polynomial: tuple[float, ...] = setting(  # in reverse order they would give 900 000 at 29 and 36 degC
        (44.49572512791427, 31.820479677943325, -917.5864128224449, -886.6854718162117, 6318.711894680335),
        "g_ss in counts per hour and OD as a function of T - centre_c in degC, highest power first",
        some=True,
    )
    centre_c: float = setting(32.5, "temperature subtracted from T in the polynomial", "degC", within=(0, 60))
    least: float = setting(20.0, "smallest production", "counts/OD/h", above=0.0)
    follow_per_h: float = setting(1.6, "rate at which production approaches g_ss", "1/h", within=(0.01, 60))
    delay_min: int = setting(30, "delay after which production acts on its own change", "min", within=(1, 240))

    def __post_init__(self) -> None:
        check(self, "pair.pigment")

    def steady(self, temperature: Array) -> Array:
        """Compute g_ss(T), counts per hour and OD, at temperatures in degC, any shape."""
        return np.maximum(np.polyval(np.array(self.polynomial), temperature - self.centre_c), self.least)


P_PUTIDA = SpeciesConfig("P. putida", (-0.02208, 1.3796, -20.56996), (), 60.0)


@dataclass(frozen=True)
class PairConfig:
    """Two species, of which the second makes the pigment. Raises: ValueError with key, value and allowed values."""

    first: SpeciesConfig = part(SpeciesConfig, "species without pigment")
    second: SpeciesConfig = part(lambda: P_PUTIDA, "species with pigment; its share is controlled")
    pigment: PigmentConfig = part(PigmentConfig, "pigment of the second species")
    temperatures: tuple[float, float] = setting(
        (29.0, 36.0), "range of the curves; outside, the rate at the nearer end is used", "degC", within=(4, 60),
        interval=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self, "pair")
        require(self.first.name != self.second.name, "pair, names", self.first.name, "two different names")
        lags = self.first.lag_min, self.second.lag_min
        require(lags[0] <= lags[1], "pair.first.lag_min", lags[0], f"at most pair.second.lag_min = {lags[1]:g} min")
        low, high = self.temperatures
        for k, species in enumerate((self.first, self.second)):
            for t, rate in zip(self.temperatures, self.rates(np.array(self.temperatures))[:, k], strict=True):
                allowed = "more than 0; set pair.temperatures to a range in which both species grow"
                require(bool(rate > 0.0), f"growth of {species.name} at {t:g} degC", f"{rate:.3g} 1/h", allowed)
            fastest, (least, most) = self.rates(np.linspace(low, high, STEPS))[:, k].max(), PLAUSIBLE
            allowed = f"{least:g} to {most:g} 1/h; give the curves in 1/h, not in 1/min"
            require(bool(least <= fastest <= most), f"fastest growth of {species.name}", f"{fastest:.3g} 1/h", allowed)
        ends = self.faster(np.array(self.temperatures))
        said = f"growth of {self.second.name} minus growth of {self.first.name} is {ends[0]:+.3g} 1/h "
        said += f"at {low:g} degC and {ends[1]:+.3g} 1/h at {high:g} degC"
        allowed = (
            "opposite signs, else no temperature holds a share; if the curves cross outside this range, record both "
            "species there and widen pair.temperatures; if they cross nowhere, use other species"
        )
        require(bool(ends[0] * ends[1] < 0.0), "pair", said, allowed)

    def rates(self, temperature: Array | float) -> Array:
        """Compute the growth rates of both species, 1/h, (..., 2), at temperatures in degC, (...)."""
        t = np.clip(np.asarray(temperature, dtype=np.float64), *self.temperatures)
        return np.stack([self.first.rate(t), self.second.rate(t)], axis=-1)

    def curve(self, species: int) -> Callable[[Array], Array]:
        """Return the function temperatures, degC -> growth rates, 1/h, of the first (0) or second (1) species."""
        return lambda temperature: self.rates(temperature)[..., species]

    def faster(self, temperature: Array) -> Array:
        """Compute the growth rate of the second species minus that of the first, 1/h, shape of the temperatures."""
        rates = self.rates(temperature)
        return np.asarray(rates[..., 1] - rates[..., 0])

    def production(self, temperature: Array | float) -> Array:
        """Compute the pigment's production at temperatures in degC, counts per hour and OD, same shape."""
        return self.pigment.steady(np.clip(np.asarray(temperature, dtype=np.float64), *self.temperatures))

    @property
    def raising(self) -> float:
        """End of the temperature range at which the share of the second species rises, degC."""
        low, high = self.temperatures
        return low if self.faster(np.array(low)) > self.faster(np.array(high)) else high

    @property
    def lowering(self) -> float:
        """End of the temperature range at which the share of the second species falls, degC."""
        return sum(self.temperatures) - self.raising

    @property
    def even_c(self) -> float:
        """Temperature at which both species grow equally fast, degC."""
        return float(self.even(np.zeros((1, 2)))[0])

    @property
    def resting_c(self) -> float:
        """`even_c` rounded to 0.1 degC, the resolution of a thermostat."""
        return round(self.even_c, 1)

    def first_at(self, rate: Array) -> Array:
        """Return the temperature at which the first species grows at `rate`, 1/h, by its curve, degC, same shape.

        Only the monotonic part of the curve around `even_c` is used. Rates beyond this part give its ends.
        """
        t = np.linspace(*self.temperatures, 10 * STEPS)
        curve = self.rates(t)[:, 0]
        up, here = np.diff(curve) >= 0.0, min(int(np.searchsorted(t, self.even_c)), t.size - 2)
        turns = np.flatnonzero(up != up[here])
        start = int(turns[turns < here].max(initial=-1)) + 1
        end = int(turns[turns > here].min(initial=t.size - 1))
        stretch = slice(start, end + 1)
        rising = 1 if up[here] else -1
        return np.asarray(np.interp(rate, curve[stretch][::rising], t[stretch][::rising]))

    def even(self, errors: Array) -> Array:
        """Return the temperature at which both species grow equally fast, degC, (N,).

        If there are several, return the warmest; if there is none, the end of the range where the rates differ less.
        Args: errors: relative errors of both curves, (N, 2)."""
        t = np.linspace(*self.temperatures, STEPS)
        rates = self.rates(t) * (1.0 + errors[:, None, :])
        gap = rates[..., 1] - rates[..., 0]  # (N, T)
        crossing = gap[:, :-1] * gap[:, 1:] <= 0.0
        last = STEPS - 2 - np.argmax(crossing[:, ::-1], axis=1)
        rows = np.arange(len(errors))
        before, after = gap[rows, last], gap[rows, last + 1]
        within = t[last] + (t[1] - t[0]) * before / np.where(before == after, 1.0, before - after)
        ends = np.abs(gap[:, [0, -1]])
        return np.asarray(np.where(crossing.any(axis=1), within, np.where(ends[:, 0] < ends[:, 1], t[0], t[-1])))


def named_pair(name: str) -> PairConfig:
    """Load a pair from a preset of conf/strains, from a YAML file of the same form, or from a folder with pair.yaml.

    Raises: ValueError with the known presets, or with the file and the reason.
    """
    known = presets.groups()["strains"]
    if name in known:
        return build(PairConfig(), presets.load(f"strains/{name}"), "pair")
    path = Path(name)
    if path.is_dir():
        path = path / FILE
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(f"pair = {name}: allowed {', '.join(known)}, a {FILE}, or a run folder with one")
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        why = getattr(error, "strerror", None) or str(error).splitlines()[0]
        raise ValueError(f"pair = {name}: {why}; give the pair.yaml of a calibration") from None
    if not isinstance(content, Mapping):
        raise ValueError(f"pair = {name}: the file has no keys with values; give the pair.yaml of a calibration")
    for key in NEEDED:
        require(key in content, f"pair = {path}", f"no {key}", f"{', '.join(NEEDED)}; pigment: {{}} uses P. putida's")
    for key in ("first", "second"):
        given = content[key] if isinstance(content[key], Mapping) else {}
        whole = "name" in given and ("polynomial" in given or "cardinal" in given)
        require(whole, f"pair = {path}, {key}", given, "a name and a curve, polynomial or cardinal")
    of = {key: {"cardinal": [], "polynomial": [], **content[key]} for key in ("first", "second")}
    return build(PairConfig(), {**content, **of}, "pair")
