"""The interlock between every controller and every pump: what may be dosed, and what to do when something is wrong.

Pure numerics on arrays with a leading axis of N reactors and explicit times; it touches no device. A control step is
`check` (before the dose), then `confirm` (what was really dosed). Sources: docs/device.md for limits and
signatures, docs/biology.md for what a culture, a pump and a sensor can do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.reactor import Measurement, Receipt
from hardware.safety.config import DONE, REMEDIES, WORDS, Response, SafetyConfig

__all__ = ["Interlock", "Verdict"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Verdict:
    """What may be done now.

    rate: allowed feed rate, mL/s, shape (N,); 0 for every row that is not fresh or is held.
    response: a `Response` per reactor, shape (N,).
    reasons: per reactor None, or reason, action taken and remedy in one line.
    kinds: per reactor the reasons' names.
    heat_off: reactors whose heating must be off, shape (N,).
    setpoint: a sane target for the on-board regulation, shape (N,).
    """

    rate: Array
    response: NDArray[np.int64]
    reasons: list[str | None]
    kinds: tuple[tuple[str, ...], ...]
    heat_off: Mask
    setpoint: Array


class Interlock:
    """Stands between controllers and pumps of N reactors; see the module.

    Args:
      n: number of reactors.
      config: limits and declared responses.
    """

    def __init__(self, n: int, config: SafetyConfig | None = None) -> None:
        self.config = config or SafetyConfig()
        c = self.config
        self.n = n
        self._found: list[list[tuple[str, Response, str]]] = [[] for _ in range(n)]
        # Everything below is the state: shape (n,) or (n, 60), saved and restored by name.
        self.volume_ml = np.full(n, c.volume_ml)
        self.fed_ml = np.zeros(n)
        self._hour = np.zeros((n, 60))  # feed per minute of the hour
        self._minute = np.full(n, -1.0)  # minute of the newest entry of _hour
        self._dose_s, self._dose_ml = np.full((n, 4), -math.inf), np.zeros((n, 4))  # the newest four doses
        self._fresh_s = np.full(n, math.nan)  # `now` of the newest sample
        self._seen = np.full(n, math.nan)  # its reading, believed or not
        self._repeats = np.zeros(n)
        self._od, self._at = np.full(n, math.nan), np.full(n, math.nan)  # newest believed reading and its minute
        self._since_ml = np.zeros(n)  # dosed since then
        self._suspect, self._suspect_at = np.full(n, math.nan), np.full(n, math.nan)
        self._suspects = np.zeros(n)
        self._mu = np.full(n, c.mu_max)  # slow estimate of the growth rate
        self._excess, self._deficit = np.zeros(n), np.zeros(n)  # cumulated unexplained rise and fall of ln OD
        self._futile = np.zeros(n)  # cumulated rise of ln OD at full feed
        self._over = np.zeros((n, 3))  # samples in a row for which each of the three was over its limit
        self._owed_ml = np.zeros(n)  # allowed but not dosed since the last dose
        self._hold_until_s = np.full(n, -math.inf)
        self._hold_kind = np.full(n, -1.0)  # index into REMEDIES
        self._latched = np.zeros(n)
        self._unusable = np.zeros(n)
        self._target_c, self._relief_c = np.full(n, math.nan), np.zeros(n)  # what cooling down still explains
        self._hot, self._too_hot = np.zeros(n), np.zeros(n)
        self._thermo_s = np.full(n, math.nan)
        self._nonsense = np.zeros(n)
        self._heat_off = np.zeros(n)

    # ------------------------------------------------------------------------------------------------------ check

    def check(
        self, measurement: Measurement, rate: Array, setpoint: Array, temperature_target: Array, now: float
    ) -> Verdict:
        """Judge the newest samples and the proposed feed rates.

        Args:
          measurement: what the reactors said; `vitals` may be None.
          rate: proposed feed rate, mL/s, shape (N,); only rows with a fresh sample count.
          setpoint: OD, shape (N,). temperature_target: degC, shape (N,), nan where there is no thermostat.
          now: monotonic time, s; never goes back.
        Raises: nothing; what is wrong is in the verdict.
        """
        c = self.config
        self._found = [[] for _ in range(self.n)]
        rate, setpoint = np.array(rate, dtype=np.float64), np.array(setpoint, dtype=np.float64)
        fresh = np.asarray(measurement.fresh, dtype=np.bool_)
        self._judge_device(measurement, now)
        believed = self._judge_reading(measurement, fresh)
        self._judge_change(measurement, believed, now)
        self._judge_heat(measurement, fresh, np.asarray(temperature_target, dtype=np.float64), now)
        bad = ~((setpoint > 0.0) & (setpoint <= c.max_setpoint))
        self._trip("setpoint", bad, lambda i: f"setpoint {setpoint[i]:g}")
        allowed = self._limit(rate, fresh, now)
        return self._conclude(allowed, fresh, setpoint, now)

    def _trip(self, kind: str, mask: Mask, text: Callable[[int], str]) -> None:
        response = WORDS[getattr(self.config.responses, kind)]
        for i in np.flatnonzero(mask):
            self._found[i].append((kind, response, text(int(i))))

    def _judge_device(self, m: Measurement, now: float) -> None:
        """Faults the device reports, and the age of the newest sample on the monotonic clock."""
        c = self.config
        self._fresh_s = np.where(m.fresh | np.isnan(self._fresh_s), now, self._fresh_s)
        age = now - self._fresh_s
        if m.vitals is not None:
            age = np.maximum(age, np.where(m.fresh, 0.0, m.vitals.age_s))
            for i, fault in enumerate(m.vitals.faults):
                if fault is not None:
                    text = f"{fault.detail}; {fault.remedy}"
                    self._found[i].append((fault.kind, WORDS[getattr(c.responses, fault.kind)], text))
        silent = age > 60.0 * c.silent
        lost = (age > c.lost_s) & ~silent
        stale = (age > c.stale_s) & ~lost & ~silent
        for kind, mask in (("stale", stale), ("lost", lost), ("silent", silent)):
            self._trip(kind, mask, lambda i: f"no new sample for {age[i]:.0f} s")

    def _judge_reading(self, m: Measurement, fresh: Mask) -> Mask:
        """Readings no working sensor gives; the rows that may be believed so far."""
        c = self.config
        od = m.od
        raw = m.vitals.raw if m.vitals is not None else np.full(self.n, math.nan)
        with np.errstate(invalid="ignore"):
            broken = fresh & ((od > 10.0) | (raw < c.raw_min))
            impossible = fresh & ~broken & ~((od > c.od_min) & (od < c.od_max) & ~(raw > c.raw_max))
            self._repeats = np.where(fresh, np.where(od == self._seen, self._repeats + 1, 0), self._repeats)
        self._seen = np.where(fresh, od, self._seen)
        frozen = fresh & ~broken & ~impossible & (self._repeats >= c.frozen_samples - 1)
        self._trip("spectrometer", broken, lambda i: f"OD {od[i]:.2f}, raw {raw[i]:.0f}: the light sensor failed")
        self._trip("impossible", impossible, lambda i: f"OD {od[i]:.3f}, raw {raw[i]:.0f}: outside what can be")
        self._trip("frozen", frozen, lambda i: f"OD exactly {od[i]:.6f} in {self._repeats[i] + 1:.0f} samples")
        return np.asarray(fresh & ~broken & ~impossible & ~frozen, dtype=np.bool_)

    def _band(self, od: Array, minutes: Array, dosed_ml: Array) -> tuple[Array, Array]:
        """Lowest and highest reading that growth, dose and noise can make of `od`."""
        c = self.config
        tolerance = np.maximum(c.jump, c.jump_fraction * np.abs(od))
        base = np.maximum(od, 0.0)
        low = base * np.exp(-c.gain_max * dosed_ml / c.volume_ml - c.death * minutes) - tolerance
        high = base * np.exp(np.minimum(c.mu_max * minutes, 5.0)) + tolerance
        return low, high

    def _judge_change(self, m: Measurement, believed: Mask, now: float) -> None:
        """Steps no culture makes, and changes that dose and growth do not explain."""
        c = self.config
        od, t = np.where(believed, m.od, math.nan), m.time_s / 60.0
        first = believed & np.isnan(self._od)
        with np.errstate(invalid="ignore"):
            low, high = self._band(self._od, t - self._at, self._since_ml)
            step = believed & ~first & ~((od >= low) & (od <= high))
            near_low, near_high = self._band(self._suspect, t - self._suspect_at, self._since_ml)
            consistent = (od >= near_low) & (od <= near_high)
            down = od < low
        self._suspects = np.where(
            step, np.where(consistent, self._suspects + 1, 1), np.where(believed, 0, self._suspects)
        )
        self._suspect, self._suspect_at = np.where(step, od, self._suspect), np.where(step, t, self._suspect_at)
        settled = step & (self._suspects >= np.where(down, c.accept_down, c.accept_up))
        before = self._od
        self._trip("jump", step & ~down, lambda i: f"OD {before[i]:.3f} to {od[i]:.3f}: growth cannot do that")
        self._trip("falls", step & down, lambda i: f"OD {before[i]:.3f} to {od[i]:.3f}: no dose explains that")
        self._cool("falls", settled & down, now)
        usual = believed & ~step & ~first
        self._accumulate(od, t, usual, now)
        taken = first | usual | settled
        self._excess, self._deficit = (np.where(settled, 0.0, s) for s in (self._excess, self._deficit))
        self._suspects = np.where(settled, 0, self._suspects)
        self._od, self._at = np.where(taken, od, self._od), np.where(taken, t, self._at)
        self._since_ml = np.where(taken, 0.0, self._since_ml)

    def _accumulate(self, od: Array, t: Array, usual: Mask, now: float) -> None:
        """Cumulated sums of what ln OD did beyond the best and the worst explanation (one-sided CUSUM).

        With d = dosed / volume and x the change of ln OD in dt minutes, a sound pump gives x <= mu dt - gain_min d,
        and no culture gives x < -gain_max d - death dt. mu is a slow estimate (60 min) plus 0.01 1/min. At full feed
        (0.8 of the largest rate and more) x must be below -0.004 dt, or the culture outgrows the pump.
        """
        c = self.config
        with np.errstate(invalid="ignore"):
            usual = usual & (od > 0.05) & (self._od > 0.05)
        with np.errstate(invalid="ignore", divide="ignore"):
            dt = np.where(usual, np.maximum(t - self._at, 1e-3), 1.0)
            x = np.where(usual, np.log(np.where(usual, od / self._od, 1.0)), 0.0)
        d = self._since_ml / c.volume_ml
        cap = np.minimum(c.mu_max, self._mu + 0.01)
        rise = np.where(d > 0.0, x - cap * dt + c.gain_min * d, np.minimum(x - c.mu_max * dt, 0.0))
        self._excess = np.where(usual, np.maximum(self._excess + rise, 0.0), self._excess)
        fall = -x - c.gain_max * d - c.death * dt
        self._deficit = np.where(usual, np.maximum(self._deficit + fall, 0.0), self._deficit)
        full = d / dt >= 0.8 * c.max_rate * 60.0 / c.volume_ml
        futile = np.where(full, np.maximum(self._futile + x + 0.004 * dt, 0.0), 0.0)
        self._futile = np.where(usual, futile, self._futile)
        weight = np.where(usual, 1.0 - np.exp(-dt / 60.0), 0.0)
        self._mu = self._mu + weight * (np.clip((x + d) / dt, 0.0, c.mu_max) - self._mu)
        level = np.where(usual, od, 1.0)
        limit = c.drift + 6.0 * np.hypot(c.noise_od, c.noise_fraction * level) / level
        sums = np.stack([self._excess, self._deficit, self._futile], axis=1)
        over = np.where(sums > limit[:, None], self._over + 1, 0)  # an outlier is over it once only
        self._over = np.where(usual[:, None], over, self._over)
        rising, falling, futile_now = (self._over >= c.persistence).T & usual
        helpless = futile_now & ~rising
        self._trip("no_dilution", rising, lambda i: f"the pump ran, ln OD is {sums[i, 0]:.2f} above what it must be")
        self._trip("falls", falling, lambda i: f"ln OD is {sums[i, 1]:.2f} below what growth and doses explain")
        self._trip("cannot_hold", helpless, lambda i: f"at full feed OD {od[i]:.3f} does not fall")
        self._cool("no_dilution", rising, now)
        self._cool("falls", falling, now)
        self._excess, self._deficit = np.where(rising, 0.0, sums[:, 0]), np.where(falling, 0.0, sums[:, 1])
        self._futile = np.where(helpless | rising, 0.0, self._futile)

    def _cool(self, kind: str, mask: Mask, now: float) -> None:
        """No dose for a while after `kind`, unless it is only reported."""
        if WORDS[getattr(self.config.responses, kind)] is not Response.PASS:
            self._hold_until_s = np.where(mask, now + 60.0 * self.config.cooldown, self._hold_until_s)
            self._hold_kind = np.where(mask, float(list(REMEDIES).index(kind)), self._hold_kind)

    def _judge_heat(self, m: Measurement, fresh: Mask, target_c: Array, now: float) -> None:
        """Too hot, where a vial that still cools down to a lower target is not; a thermometer that reads nonsense."""
        c = self.config
        asked = fresh & np.isfinite(target_c)
        known = asked & np.isfinite(m.temperature)
        temperature, target = np.where(known, m.temperature, 37.0), np.where(known, target_c, 37.0)
        seen = np.isfinite(self._target_c)
        minutes = np.where(known & seen, (now - self._thermo_s) / 60.0, 0.0)
        drop = np.where(known & seen, np.maximum(self._target_c - target, 0.0), 0.0)
        relief = self._relief_c * np.exp(-minutes / c.cooling) + drop
        relief = np.where(seen, relief, np.maximum(temperature - target, 0.0))
        self._relief_c = np.where(known, relief, self._relief_c)
        self._target_c, self._thermo_s = np.where(known, target, self._target_c), np.where(known, now, self._thermo_s)
        in_range = known & (temperature > 5.0) & (temperature < 70.0)
        nonsense = asked & ~in_range & (seen | known)  # a thermometer that falls silent, too
        hot = in_range & (temperature > target + c.hot_excess + self._relief_c)
        too_hot = in_range & (temperature > c.max_temperature)
        scalding = too_hot & (temperature > c.max_temperature + 3.0)
        self._hot = np.where(known, np.where(hot, self._hot + 1, 0), self._hot)
        self._too_hot = np.where(known, np.where(too_hot, self._too_hot + 1, 0), self._too_hot)
        self._nonsense = np.where(asked, np.where(nonsense, self._nonsense + 1, 0), self._nonsense)
        trip = known & ((self._hot >= 3) | (self._too_hot >= 2) | scalding)
        blind = asked & (self._nonsense >= 3)
        self._trip("hot", trip, lambda i: f"{temperature[i]:.1f} degC, target {target[i]:.1f}: heating off")
        self._trip("thermometer", blind, lambda i: f"reads {m.temperature[i]:.1f} degC: heating off")
        self._heat_off = np.where(trip | blind, 1.0, self._heat_off)

    def _limit(self, rate: Array, fresh: Mask, now: float) -> Array:
        """The proposal within range, budgets, bottle and level."""
        c = self.config
        unusable = fresh & ~(np.isfinite(rate) & (rate >= 0.0))
        self._unusable = np.where(fresh, np.where(unusable, self._unusable + 1, 0), self._unusable)
        lost = unusable & (self._unusable >= c.controller_patience)
        self._trip("controller", unusable & ~lost, lambda i: f"proposed {rate[i]:g} mL/s")
        self._trip("controller_lost", lost, lambda i: f"{self._unusable[i]:.0f} unusable proposals in a row")
        wanted = np.where(fresh & ~unusable, rate, 0.0)
        allowed = np.minimum(wanted, c.max_rate)
        self._trip("limit", wanted > c.max_rate * (1.0 + 1e-9), lambda i: f"{wanted[i]:g} mL/s cut to {c.max_rate:g}")
        undosed = fresh & (self._owed_ml > 2.0 * c.max_rate * c.period_s)
        self._trip("undosed", undosed, lambda i: f"{self._owed_ml[i]:.2f} mL were allowed, nothing was dosed")
        self._roll(now)
        recent = np.where(now - self._dose_s < 60.0, self._dose_ml, 0.0).sum(axis=1)
        left = {
            "budget": np.minimum.reduce(
                [c.ml_per_minute - recent, c.ml_per_hour - self._hour.sum(axis=1), c.ml_per_run - self.fed_ml]
            ),
            "bottle": c.bottle_ml - self.fed_ml,
            "overflow": c.max_volume_ml - self.volume_ml,
        }
        for kind, room in left.items():
            asked = allowed * c.period_s
            over = asked > room + 1e-9
            texts = [f"{max(r, 0.0):.2f} mL left, {a:.2f} asked" for r, a in zip(room, asked, strict=True)]
            self._trip(kind, over, texts.__getitem__)
            allowed = np.where(over, 0.0, allowed)
        return allowed

    def _roll(self, now: float) -> None:
        """Forget feed of more than an hour ago: entry k of the ring belongs to the minutes with k = minute mod 60."""
        minute = np.floor(now / 60.0)
        ages = (minute - np.arange(60)) % 60  # how long ago each entry was last current, if the ring is up to date
        stale = ages[None, :] < np.minimum(minute - self._minute, 60)[:, None]
        self._hour = np.where(stale, 0.0, self._hour)
        self._minute = np.full(self.n, minute)

    def _conclude(self, allowed: Array, fresh: Mask, setpoint: Array, now: float) -> Verdict:
        """The most severe response per reactor, with latches and cool-downs."""
        c = self.config
        cooling = fresh & (now < self._hold_until_s)
        names = list(REMEDIES)
        for i in np.flatnonzero(cooling):
            kind = names[int(self._hold_kind[i])]
            if kind not in [k for k, _, _ in self._found[i]]:
                wait = (self._hold_until_s[i] - now) / 60.0
                self._found[i].append((kind, Response.HOLD, f"no dose for another {wait:.1f} min after this"))
        response = np.array([max([r for _, r, _ in found], default=0) for found in self._found], dtype=np.int64)
        self._latched = np.where(response >= Response.REGULATE, np.maximum(self._latched, response), self._latched)
        response = np.maximum(response, self._latched.astype(np.int64))
        reasons: list[str | None] = []
        for found, code in zip(self._found, response, strict=True):
            texts = [f"{kind}: {text}; {DONE[r]}; {REMEDIES.get(kind, '')}".rstrip("; ") for kind, r, text in found]
            if not texts and code >= Response.REGULATE:
                texts = [f"{DONE[Response(code)]} earlier in this run"]
            reasons.append(" | ".join(texts) or None)
        kinds = tuple(tuple(kind for kind, _, _ in found) for found in self._found)
        rate = np.where(response == Response.PASS, allowed, 0.0)
        self._owed_ml = self._owed_ml + rate * c.period_s
        sane = np.clip(np.where(np.isfinite(setpoint), setpoint, 0.5), 0.05, c.max_setpoint)
        sane = np.where((setpoint > 0.0) & (setpoint <= c.max_setpoint), sane, 0.5)
        return Verdict(rate, response, reasons, kinds, self._heat_off > 0.0, sane)

    # ---------------------------------------------------------------------------------------------------- confirm

    def confirm(self, receipt: Receipt, now: float) -> None:
        """Book what was dosed. Volume: V <- max(V_tube, V + feed - waste), no waste pump modelled = V_tube.

        Args:
          receipt: of the command that followed `check`.
          now: monotonic time of the dose, s.
        """
        feed = np.asarray(receipt.volume_ml, dtype=np.float64)
        self._roll(now)
        self._hour[:, int(now // 60.0) % 60] += feed
        self.fed_ml = self.fed_ml + feed
        self._since_ml = self._since_ml + feed
        dosed = feed > 0.0
        for mine, new in ((self._dose_s, np.full(self.n, now)), (self._dose_ml, feed)):
            mine[dosed] = np.column_stack([mine[dosed, 1:], new[dosed]])
        self._owed_ml = np.where(dosed, 0.0, self._owed_ml)
        waste = np.full(self.n, math.inf) if receipt.waste_ml is None else np.asarray(receipt.waste_ml)
        level = np.maximum(self.volume_ml + feed - waste, self.config.volume_ml)
        self.volume_ml = np.where(waste > 0.0, level, self.volume_ml + feed)

    # ------------------------------------------------------------------------------------------------------ resume

    def state(self) -> dict[str, list[Any]]:
        """Everything it remembers, as plain lists; times are those given to `check`, so give it run time."""
        return {k: v.tolist() for k, v in vars(self).items() if isinstance(v, np.ndarray)}

    def latch(self, response: Response, rows: Mask) -> None:
        """Never respond with less than this for `rows`, shape (N,), in this run."""
        self._latched = np.where(rows, np.maximum(self._latched, float(response)), self._latched)

    def restore(self, state: Any) -> None:
        """The inverse of `state`, of an interlock that has not been used; None stands for nan or -inf, as in JSON.

        Only the age of the newest sample begins anew: while the program was gone nobody could have seen one, and a
        reactor is stale, lost or silent once it had its chance.

        Raises: ValueError if it is of another number of reactors or another version, or damaged.
        """
        mine = {k: v for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        if not isinstance(state, dict):
            raise ValueError(f"saved interlock: {str(state)[:40]}, expected its fields")
        if set(state) != set(mine):
            raise ValueError(f"saved interlock has other fields: {', '.join(sorted(set(state) ^ set(mine)))[:80]}")
        restored = {}
        for key, old in mine.items():
            try:
                new = np.array(state[key], dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                raise ValueError(f"saved interlock: {key} = {str(state[key])[:40]}: expected numbers") from None
            if new.ndim and len(new) != self.n:
                raise ValueError(f"saved interlock is for {len(new)} reactors, this run has {self.n}")
            if new.shape != old.shape:
                raise ValueError(f"saved interlock: {key} has the shape {new.shape}, expected {old.shape}")
            if not np.isfinite(new).all() and np.isfinite(old).all():  # nan would pass every limit
                raise ValueError(f"saved interlock: {key} = {str(state[key])[:40]}: expected finite numbers")
            restored[key] = np.where(np.isnan(new), -math.inf, new) if key in ("_dose_s", "_hold_until_s") else new
        for key, codes in (("_latched", list(Response)), ("_hold_kind", range(-1, len(REMEDIES)))):
            if not np.isin(restored[key], np.array(codes)).all():
                raise ValueError(f"saved interlock: {key} = {state[key]}: no such code")
        for key, new in restored.items():
            setattr(self, key, new)
        self._fresh_s = np.full(self.n, math.nan)
