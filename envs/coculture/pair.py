"""Two species in one vial: how each grows with temperature, and the pigment of the second.

The default is E. coli and P. putida: Lee, Morlock, Allan, Steel, Cell Reports Methods 5:101009 (2025) and its public
model, Janmorlock/CompEst3000: fits to batch growth between 29 and 36 degC. Another one:
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

STEPS = 71  # of temperatures between which crossings are sought
PLAUSIBLE = (0.02, 10.0)  # 1/h, of the fastest growth; a rate per minute is not
FILE = "pair.yaml"
NEEDED = ("first", "second", "pigment", "temperatures")  # of a file: nothing of another pair stands in for one


@dataclass(frozen=True)
class SpeciesConfig:
    """How a species grows with temperature: a polynomial, or the cardinal temperatures (Rosso et al. 1993).

    mu(T) = sum_k c_k T^k
    mu(T) = mu_opt (T - t_max)(T - t_min)^2 / ((t_opt - t_min)((t_opt - t_min)(T - t_opt)
            - (t_opt - t_max)(t_opt + t_min - 2 T))),     0 outside t_min to t_max
    """

    name: str = setting("E. coli", "what figures call it")
    polynomial: tuple[float, ...] = setting(
        (0.07727, -1.66954), "mu(T) in 1/h of T in degC, highest power first; empty: `cardinal` holds"
    )
    cardinal: tuple[float, ...] = setting(
        (), "lowest, best and highest temperature of growth, degC, and the rate at the best one, 1/h"
    )
    lag_min: float = setting(2.0, "time constant with which growth follows temperature", "min", within=(0, 600))

    def __post_init__(self) -> None:
        check(self, "pair")
        require(bool(self.polynomial) != bool(self.cardinal), "pair", self.name, "one of polynomial and cardinal")
        for key in ("polynomial", "cardinal"):
            given = getattr(self, key)
            require(bool(np.isfinite(given).all()), f"pair, {key} of {self.name}", given, "numbers")
        if self.cardinal:
            risen = len(self.cardinal) == 4 and self.cardinal[0] < self.cardinal[1] < self.cardinal[2]
            right = risen and 2 * self.cardinal[1] > self.cardinal[0] + self.cardinal[2] and self.cardinal[3] > 0
            allowed = "[t_min, t_opt, t_max, mu_opt], rising, t_opt nearer to t_max, mu_opt > 0"
            require(right, f"pair, cardinal of {self.name}", self.cardinal, allowed)

    def rate(self, temperature: Array) -> Array:
        """mu(T), 1/h, of a temperature in degC, any shape; not below 0."""
        if self.polynomial:
            return np.asarray(np.maximum(np.polyval(self.polynomial, temperature), 0.0))
        low, best, high, most = self.cardinal
        t = np.clip(temperature, low, high)
        below = (best - low) * ((best - low) * (t - best) - (best - high) * (best + low - 2.0 * t))
        return np.asarray(most * (t - high) * (t - low) ** 2 / below)


@dataclass(frozen=True)
class PigmentConfig:
    """Pigment of the second species: f' = g p - D f.

    Its light is counted. The production g lags behind temperature:
    g' = follow (g_ss(T) - g(t - delay)),  g_ss(T) = max(least, sum_k c_k (T - centre)^k),  g >= least.
    """

    polynomial: tuple[float, ...] = setting(  # the other order would reach 900 000 at 29 and 36 degC, and 100 between
        (44.49572512791427, 31.820479677943325, -917.5864128224449, -886.6854718162117, 6318.711894680335),
        "g_ss in counts per hour and OD of T - centre_c in degC, highest power first",
        some=True,
    )
    centre_c: float = setting(32.5, "temperature about which the polynomial stands", "degC", within=(0, 60))
    least: float = setting(20.0, "least production", "counts/OD/h", above=0.0)
    follow_per_h: float = setting(1.6, "rate with which production follows", "1/h", within=(0.01, 60))
    delay_min: int = setting(30, "after which it feels its own change", "min", within=(1, 240))

    def __post_init__(self) -> None:
        check(self, "pair.pigment")

    def steady(self, temperature: Array) -> Array:
        """g_ss(T), counts per hour and OD, of a temperature in degC, any shape."""
        return np.maximum(np.polyval(np.array(self.polynomial), temperature - self.centre_c), self.least)


P_PUTIDA = SpeciesConfig("P. putida", (-0.02208, 1.3796, -20.56996), (), 60.0)


@dataclass(frozen=True)
class PairConfig:
    """Two species, of which the second makes the pigment. Raises: ValueError naming key, value and what is allowed."""

    first: SpeciesConfig = part(SpeciesConfig, "the one without pigment")
    second: SpeciesConfig = part(lambda: P_PUTIDA, "the one whose share is held")
    pigment: PigmentConfig = part(PigmentConfig, "of the second")
    temperatures: tuple[float, float] = setting(
        (29.0, 36.0), "range in which the curves hold; beyond it those of the nearer end", "degC", within=(4, 60),
        interval=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self, "pair")
        require(self.first.name != self.second.name, "pair, names", self.first.name, "two that differ")
        lags = self.first.lag_min, self.second.lag_min
        require(lags[0] <= lags[1], "pair.first.lag_min", lags[0], f"at most pair.second.lag_min = {lags[1]:g} min")
        low, high = self.temperatures
        for k, species in enumerate((self.first, self.second)):
            for t, rate in zip(self.temperatures, self.rates(np.array(self.temperatures))[:, k], strict=True):
                allowed = "more than 0: give pair.temperatures between which both species grow"
                require(bool(rate > 0.0), f"growth of {species.name} at {t:g} degC", f"{rate:.3g} 1/h", allowed)
            fastest, (least, most) = self.rates(np.linspace(low, high, STEPS))[:, k].max(), PLAUSIBLE
            allowed = f"{least:g} to {most:g} 1/h; curves are per hour"
            require(bool(least <= fastest <= most), f"fastest growth of {species.name}", f"{fastest:.3g} 1/h", allowed)
        ends = self.faster(np.array(self.temperatures))
        said = f"{self.first.name} and {self.second.name}, of which {self.second.name} grows by {ends[0]:+.3g} 1/h "
        said += f"faster at {low:g} degC and by {ends[1]:+.3g} at {high:g}"
        allowed = (
            "two of which the other one is faster at the other end, or no temperature holds a share: where the curves "
            "cross outside, record both there and widen pair.temperatures; where they cross nowhere, take other species"
        )
        require(bool(ends[0] * ends[1] < 0.0), "pair", said, allowed)

    def rates(self, temperature: Array | float) -> Array:
        """Rates of both, 1/h, (..., 2), at temperatures in degC, (...)."""
        t = np.clip(np.asarray(temperature, dtype=np.float64), *self.temperatures)
        return np.stack([self.first.rate(t), self.second.rate(t)], axis=-1)

    def curve(self, species: int) -> Callable[[Array], Array]:
        """Rate of the first (0) or the second (1) species, 1/h, of temperatures in degC."""
        return lambda temperature: self.rates(temperature)[..., species]

    def faster(self, temperature: Array) -> Array:
        """By how much the second grows faster, 1/h, shape of the temperatures."""
        rates = self.rates(temperature)
        return np.asarray(rates[..., 1] - rates[..., 0])

    def production(self, temperature: Array | float) -> Array:
        """Compute the pigment's production at temperatures in degC, counts per hour and OD, same shape."""
        return self.pigment.steady(np.clip(np.asarray(temperature, dtype=np.float64), *self.temperatures))

    @property
    def raising(self) -> float:
        """The end of the range at which the second species gains, degC; at the other one it loses."""
        low, high = self.temperatures
        return low if self.faster(np.array(low)) > self.faster(np.array(high)) else high

    @property
    def lowering(self) -> float:
        """The end of the range at which the second species loses, degC."""
        return sum(self.temperatures) - self.raising

    @property
    def even_c(self) -> float:
        """Temperature at which both grow alike, degC."""
        return float(self.even(np.zeros((1, 2)))[0])

    @property
    def resting_c(self) -> float:
        """The same to a tenth of a degree, as one sets a thermostat."""
        return round(self.even_c, 1)

    def first_at(self, rate: Array) -> Array:
        """Temperature at which the first species grows at a rate, 1/h, by its curve, degC, shape of the rates.

        Of the stretch about `even_c` on which the curve only rises or only falls; beyond its rates the stretch's ends.
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
        """Temperature at which both grow alike, degC, (N,), if the curves are off by relative errors, (N, 2).

        Of several the one next to the warm end; the end of the range where there is none, at which they differ less.
        """
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
    """Load a pair by its preset in conf/strains, from a YAML file like these, or from a folder with pair.yaml.

    Raises: ValueError naming the presets, or the file and what is wrong with it.
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
        raise ValueError(f"pair = {name}: holds no key: value pairs; give the pair.yaml of a calibration")
    for key in NEEDED:
        require(key in content, f"pair = {path}", f"no {key}", f"{', '.join(NEEDED)}; pigment: {{}} is P. putida's")
    for key in ("first", "second"):
        given = content[key] if isinstance(content[key], Mapping) else {}
        whole = "name" in given and ("polynomial" in given or "cardinal" in given)
        require(whole, f"pair = {path}, {key}", given, "a name and a curve, polynomial or cardinal")
    of = {key: {"cardinal": [], "polynomial": [], **content[key]} for key in ("first", "second")}
    return build(PairConfig(), {**content, **of}, "pair")
