"""The four parts of the interlock against twins in plain Python, one reactor and one sample at a time, and the limits
at their boundaries by hand."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from hardware import memory
from hardware.memory import Remembers
from hardware.messages import Fault, PumpFault, StalledFault
from hardware.reactor import Measurement, Receipt, Vitals
from hardware.safety.budget import FeedBudget
from hardware.safety.config import Response, Responses, SafetyConfig
from hardware.safety.interlock import Interlock
from hardware.safety.messages import PAUSES, FallsPause
from hardware.safety.readings import Finding, Heat, Readings
from hardware.safety.unexplained_change import UnexplainedChange

N = 16
C = SafetyConfig()
TUBES = np.resize([20.0, 12.0, 31.0], N)  # mL, of vials that are not alike


def told(findings: list[Finding], rows: int = N) -> list[list[str]]:
    """Reasons of each reactor, in order; "+" after those that cool down. Every fault can be made."""
    out: list[list[str]] = [[] for _ in range(rows)]
    for finding in findings:
        for i in np.flatnonzero(finding.rows):
            out[i].append(finding.of(int(i)).kind + ("+" if finding.cool is not None and finding.cool[i] else ""))
    return out


def resumed(owner: Remembers, new: Any) -> Any:
    """`new` with the memory of another, by way of a file."""
    memory.restore(new, json.loads(json.dumps(memory.save(owner))), "part")
    return new


def same(state: dict[str, np.ndarray], twins: list[Any], **names: str) -> None:
    """What is remembered, twin by twin."""
    for key, name in names.items():
        np.testing.assert_allclose(state[key], [getattr(twin, name) for twin in twins], rtol=1e-9, atol=1e-12)


# -- feed and level --------------------------------------------------------------------------------------------------


@dataclass
class Ledger:
    """Feed of one reactor as a list of doses (time, mL)."""

    c: SafetyConfig
    bench: Bench
    tube: float
    doses: list[tuple[float, float]] = field(default_factory=list)
    level: float = math.nan
    owed: float = 0.0
    paid: float = 0.0
    unusable: int = 0

    def __post_init__(self) -> None:
        self.level = self.tube

    @property
    def fed(self) -> float:
        return sum(ml for _, ml in self.doses)

    @property
    def given(self) -> list[tuple[float, float]]:
        return [dose for dose in self.doses if dose[1] > 0.0]

    def judge(self, rate: float, fresh: bool, now: float) -> tuple[float, list[str]]:
        c, bench, kinds = self.c, self.bench, []
        usable = math.isfinite(rate) and rate >= 0.0
        wanted = rate if fresh and usable else 0.0
        if fresh:
            self.unusable = 0 if usable else self.unusable + 1
        if fresh and not usable:
            kinds.append("controller_lost" if self.unusable >= c.controller_patience else "controller")
        if wanted > bench.max_rate:
            kinds.append("limit")
        if fresh and self.owed > 2.0 * bench.max_rate * bench.period_s:
            kinds.append("undosed")
        wanted = min(wanted, bench.max_rate)
        minute = sum(ml for t, ml in self.given[-4:] if now - t < 60.0)
        hour = sum(ml for t, ml in self.doses if now // 60.0 - t // 60.0 < 60.0)
        budget = min(
            (c.ml_per_minute or 2.5 * bench.max_rate * bench.period_s) - minute,
            c.ml_per_hour - hour,
            c.ml_per_run - self.fed,
        )
        bottle = bench.bottle_ml - self.fed
        for kind, room in (("budget", budget), ("bottle", bottle), ("overflow", self.tube + 5.0 - self.level)):
            if wanted * bench.period_s > room + 1e-9 and (wanted > 0.0 or kind != "budget"):
                kinds.append(kind)
                wanted = 0.0
        return wanted, kinds

    def book(self, feed: float, waste: float, now: float) -> None:
        if feed > 0.0:
            self.owed, self.paid = 0.0, self.owed
        elif feed < 0.0 and -feed >= 0.9 * self.given[-1][1]:  # booked as it began, and not given
            self.owed += self.paid
        self.doses += [(now, feed)] * int(feed != 0.0)
        self.level = max(self.level + feed - waste, self.tube) if waste != 0.0 else self.level + feed


@pytest.mark.parametrize("limit", ["ml_per_minute", "ml_per_hour", "ml_per_run", "bottle_ml", "controller_patience"])
def test_the_ledger_is_that_of_a_list_of_doses(limit: str) -> None:
    rng, period_s = np.random.default_rng(0), 30.0 if limit == "ml_per_minute" else 60.0
    tight = {"ml_per_minute": 1.9, "ml_per_hour": 14.0, "ml_per_run": 30.0, "controller_patience": 2}
    c = SafetyConfig(**{limit: tight[limit]} if limit in tight else {})
    bench = Bench(period_s=period_s, bottle_ml=30.0 if limit == "bottle_ml" else 2000.0)
    given = (c, bench, TUBES, TUBES + 5.0)
    budget, twins, now = FeedBudget(*given), [Ledger(c, bench, tube) for tube in TUBES.tolist()], 0.0
    order = {"controller": 0, "controller_lost": 1, "limit": 2, "undosed": 3, "budget": 4, "bottle": 5, "overflow": 6}
    for _ in range(120):
        now += float(
            rng.choice([5.0, 30.0, 60.0, 61.0, 200.0, 1500.0, 9000.0], p=[0.1, 0.2, 0.4, 0.2, 0.08, 0.01, 0.01])
        )
        rate = rng.choice([0.0, 0.004, 0.015, 0.02, 0.0200001, 0.03, -0.001, np.nan, np.inf], N)
        fresh = rng.random(N) < 0.9
        allowed, findings = budget.check(rate, fresh, now)
        expected = [t.judge(r, f, now) for t, r, f in zip(twins, rate, fresh, strict=True)]
        np.testing.assert_allclose(allowed, [e[0] for e in expected], rtol=1e-12)
        assert [sorted(kinds, key=order.get) for kinds in told(findings)] == [e[1] for e in expected]
        budget.grant(allowed)
        feed = allowed * bench.period_s * (rng.random(N) < 0.7) + 1.2 * (rng.random(N) < 0.02)  # a repetition
        waste = rng.choice([0.0, 0.5, 9.0, -0.4], N)  # the last corrects what was booked
        at = now + float(rng.choice([0.0, 40.0, -70.0, -3000.0, -3600.0, -4000.0], p=[0.5, 0.4, *[0.025] * 4]))
        budget.book(feed, waste, at)  # when it ends, or a repeat that is told of late
        now = max(now, at)
        back = -feed * rng.choice([0.0, 0.8, 0.95, 1.0], N, p=[0.7, 0.1, 0.1, 0.1])  # of it, what did not flow
        budget.book(back, 0.5 * back, at)
        for twin, a, f, w, b in zip(twins, allowed, feed, waste, back, strict=True):
            twin.owed += a * bench.period_s
            twin.book(f, w, at)
            twin.book(b, 0.5 * b, at)
        same(vars(budget), twins, volume_ml="level", fed_ml="fed", _owed_ml="owed", _unusable="unusable")
        if rng.random() < 0.3:
            budget = resumed(budget, FeedBudget(*given))


# -- readings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("od", "raw", "kind"),
    [
        (-0.1, 9000.0, "impossible"), (-0.0999, 9000.0, ""), (3.999, 9000.0, ""), (4.0, 9000.0, "impossible"),
        (10.0, 9000.0, "impossible"), (10.01, 9000.0, "spectrometer"), (0.5, 4.99, "spectrometer"), (0.5, 5.0, ""),
        (np.inf, 9000.0, "spectrometer"), (0.0, 0.0, "spectrometer"), (14.06, 1.0, "spectrometer"),
        (0.5, 65534.0, ""), (0.5, 65535.0, "impossible"), (0.5, np.nan, "impossible"), (np.nan, 9000.0, "impossible"),
    ],
)  # fmt: skip
def test_what_a_sensor_can_read(od: float, raw: float, kind: str) -> None:
    vitals = Vitals(np.zeros(2), np.array([raw, 9000.0]), (None, None))
    m = Measurement(np.zeros(2), np.array([od, 0.4]), np.full(2, 37.0), np.array([True, True]), vitals)
    assert Readings(2, C, 100.0, 180.0).believed(m, np.array([True, True])).tolist() == [kind == "", True]
    believed, findings = Readings(2, C, 100.0, 180.0).check(m, np.array([True, True]), 0.0)
    assert told(findings, 2) == [[kind] if kind else [], []]
    assert believed.tolist() == [kind == "", True]
    believed, findings = Readings(2, C, 100.0, 180.0).check(m, np.array([False, True]), 0.0)
    assert told(findings, 2) == [[], []]
    assert believed.tolist() == [False, True]


def test_equal_readings_are_counted_over_samples_that_are_new() -> None:
    readings, new = Readings(1, C, 100.0, 180.0), np.array([True])
    kinds = []
    for od, fresh in zip([0.5] * 6 + [0.6] + [0.5] * 3, [1, 0, 1, 1, 0, 1, 1, 1, 1, 0], strict=True):
        m = Measurement(np.zeros(1), np.array([od]), np.zeros(1), new, None)
        foreseen = [readings.believed(m, np.array([bool(fresh)]))[0] for _ in range(5)]  # asking changes nothing
        believed, findings = readings.check(m, np.array([bool(fresh)]), 0.0)
        assert foreseen == [believed[0]] * 5
        kinds += told(findings, 1)
        assert believed[0] == (bool(fresh) and kinds[-1] == [])
        if len(kinds) == 3:
            readings = resumed(readings, Readings(1, C, 100.0, 180.0))
    assert kinds == [[], [], [], ["frozen"], [], ["frozen"], [], [], [], []]


@pytest.mark.parametrize(
    ("after_s", "driver_s", "kind"),
    [
        (100.0, 0.0, ""), (100.1, 0.0, "stale"), (180.0, 0.0, "stale"), (180.1, 0.0, "lost"), (7200.0, 0.0, "lost"),
        (7200.1, 0.0, "silent"), (10.0, 100.0, ""), (10.0, 100.1, "stale"), (10.0, 7200.1, "silent"),
    ],
)  # fmt: skip
def test_the_age_of_the_newest_sample(after_s: float, driver_s: float, kind: str) -> None:
    """By this computer's clock, or by what the driver says; a sample that is new has no age."""
    readings = Readings(2, C, 100.0, 180.0)
    m = Measurement(np.zeros(2), np.array([0.5, 0.4]), np.zeros(2), np.ones(2, bool))
    readings.check(m, np.array([True, True]), 1000.0)
    vitals = Vitals(np.full(2, driver_s), np.full(2, 9000.0), (None, None))
    for fresh, expected in ((False, [kind] if kind else []), (True, [])):
        m = Measurement(np.zeros(2), np.array([0.6, 0.3]), np.zeros(2), np.ones(2, bool), vitals)
        findings = readings.check(m, np.array([fresh, True]), 1000.0 + after_s)[1]
        assert told(findings, 2) == [expected, []]


# -- heat ------------------------------------------------------------------------------------------------------------


@dataclass
class Thermostat:
    """One vial's temperature, sample by sample."""

    cooling: float
    target: float = math.nan
    relief: float = 0.0
    at: float = math.nan
    hot: int = 0
    too_hot: int = 0
    nonsense: int = 0
    off: bool = False

    def judge(self, reading: float, fresh: bool, target: float, now: float) -> list[str]:
        if not fresh or not math.isfinite(target):
            return []
        first = math.isnan(self.target)
        if not math.isfinite(reading):
            self.nonsense = 0 if first else self.nonsense + 1  # no thermometer at all is none that fell silent
            return self._blind()
        if first:
            self.relief = max(reading - target, 0.0)
        else:
            self.relief *= math.exp(-(now - self.at) / 60.0 / self.cooling)
            self.relief += max(self.target - target, 0.0)
        self.target, self.at = target, now
        sense = 5.0 < reading < 70.0
        self.nonsense = 0 if sense else self.nonsense + 1
        self.hot = self.hot + 1 if sense and reading > target + 2.0 + self.relief else 0
        self.too_hot = self.too_hot + 1 if sense and reading > 42.0 else 0
        trip = self.hot >= 3 or self.too_hot >= 2 or (sense and reading > 45.0)
        self.off |= trip
        return ["hot"] * int(trip) + self._blind()

    def _blind(self) -> list[str]:
        self.off |= self.nonsense >= 3
        return ["thermometer"] * (self.nonsense >= 3)


def test_heat_is_judged_as_sample_by_sample() -> None:
    rng = np.random.default_rng(1)
    for cooling in (90.0, 90.0, 30.0, 190.0, 90.0, 15.0, 60.0, 90.0):
        config = SafetyConfig(cooling=cooling)
        heat, twins, now = Heat(N, config), [Thermostat(cooling) for _ in range(N)], 0.0
        target = np.where(rng.random(N) < 0.9, 37.0, np.nan)
        for _ in range(60):
            now += float(rng.choice([60.0, 61.0, 600.0]))
            change = rng.random(N) < 0.05
            target = np.where(change, rng.choice([30.0, 37.0, 40.0, 42.0, np.nan], N), target)
            odd = rng.choice([5.0, 5.1, 70.0, 69.9, 42.0, 42.1, 45.0, 45.1, np.nan, np.inf, -3.0], N)
            near = np.nan_to_num(target, nan=37.0) + rng.uniform(-1.0, 2.6, N)
            reading = np.where(rng.random(N) < 0.15, odd, near)
            reading = np.where(rng.random(N) < 0.3, np.round(near) + 2.0, reading)
            fresh = rng.random(N) < 0.9
            findings = heat.check(reading, fresh, target, now)
            rows = zip(twins, reading, fresh, target, strict=True)
            assert told(findings) == [t.judge(r, f, g, now) for t, r, f, g in rows]
            assert heat.off.tolist() == [t.off for t in twins]
            same(vars(heat), twins, _relief_c="relief", _target_c="target", _thermo_s="at")
            same(vars(heat), twins, _hot="hot", _too_hot="too_hot", _nonsense="nonsense")
            if rng.random() < 0.1:
                heat = resumed(heat, Heat(N, config))


# -- changes that nothing explains -----------------------------------------------------------------------------------


@dataclass
class Culture:
    """One culture's readings against growth, doses and noise."""

    volume: float
    c: SafetyConfig
    max_rate: float
    od: float = math.nan
    at: float = math.nan
    since: float = 0.0
    least: float = 0.0  # dosed since then, where `since` is the most
    suspect: float = math.nan
    suspect_at: float = math.nan
    suspects: int = 0
    excess: float = 0.0
    deficit: float = 0.0
    futile: float = 0.0
    over: list[int] = field(default_factory=lambda: [0, 0, 0])
    helpless: float = math.nan  # highest OD since full feed was found not to be enough
    eased: int = 0

    def __post_init__(self) -> None:
        self.mu = self.c.mu_max

    def band(self, od: float, minutes: float) -> tuple[float, float]:
        tolerance = max(self.c.jump, self.c.jump_fraction * abs(od))
        low = max(od, 0.0) * math.exp(-1.6 * self.since / self.volume - self.c.death * minutes)
        return low - tolerance, max(od, 0.0) * math.exp(min(self.c.mu_max * minutes, 5.0)) + tolerance

    def judge(self, od: float, t: float, believed: bool, setpoint: float) -> list[str]:
        if not believed:
            return []
        kinds = self._judge(od, t, setpoint)
        return kinds + ["cannot_hold"] * (not math.isnan(self.helpless))

    def _judge(self, od: float, t: float, setpoint: float) -> list[str]:
        if math.isnan(self.od):
            return self.take(od, t, [])
        low, high = self.band(self.od, t - self.at)
        if low <= od <= high:
            self.suspects = 0
            return self.take(od, t, self.accumulate(od, t, setpoint))
        near = self.band(self.suspect, t - self.suspect_at) if not math.isnan(self.suspect) else (math.inf, -math.inf)
        self.suspects = self.suspects + 1 if near[0] <= od <= near[1] else 1
        self.suspect, self.suspect_at = od, t
        down = od < low
        if self.suspects < (3 if down else 6):
            return ["falls" if down else "jump"]
        self.excess = self.deficit = 0.0
        self.suspects = 0
        return self.take(od, t, ["falls+" if down else "jump"])

    def take(self, od: float, t: float, kinds: list[str]) -> list[str]:
        self.od, self.at, self.since, self.least = od, t, 0.0, 0.0
        return kinds

    def accumulate(self, od: float, t: float, setpoint: float) -> list[str]:
        if od <= 0.05 or self.od <= 0.05:
            return []
        c, dt, d, x = self.c, max(t - self.at, 1e-3), self.since / self.volume, math.log(od / self.od)
        least = self.least / self.volume
        rise = x - min(c.mu_max, self.mu + 0.01) * dt + 0.5 * least if least > 0.0 else min(x - c.mu_max * dt, 0.0)
        self.excess = max(self.excess + rise, 0.0)
        self.deficit = max(self.deficit - x - 1.6 * d - c.death * dt, 0.0)
        full = least / dt >= 0.8 * self.max_rate * 60.0 / self.volume
        short = full and od > (1.0 + c.drift) * setpoint
        self.futile = max(self.futile + x + 0.004 * dt, 0.0) if full else 0.0
        self.mu += (1.0 - math.exp(-dt / 60.0)) * (min(max((x + d) / dt, 0.0), c.mu_max) - self.mu)
        limit = c.drift + 6.0 * math.hypot(c.noise_od, c.noise_fraction * od) / od
        self.over = [
            k + 1 if s > limit else 0 for k, s in zip(self.over, (self.excess, self.deficit, self.futile), strict=True)
        ]
        rising, falling, helpless = (k >= 3 for k in self.over)
        kinds = ["no_dilution+"] * rising + ["falls+"] * falling
        self.excess, self.deficit = self.excess * (not rising), self.deficit * (not falling)
        self.futile *= not ((helpless and short) or rising)
        self.last(helpless and short and not rising, od, short, limit)
        return kinds

    def last(self, begins: bool, od: float, short: bool, limit: float) -> None:
        if math.isnan(self.helpless):
            self.eased, self.helpless = 0, od if begins else math.nan
            return
        self.helpless = max(self.helpless, od)
        falls = math.log(od / self.helpless) < -limit
        self.eased = 0 if short and not falls else self.eased + 1
        if self.eased >= 3:
            self.helpless = math.nan


def test_changes_are_judged_as_sample_by_sample() -> None:
    """Cultures that grow, are fed, stand still or die, pumps that give half or twice, steps, bubbles, gaps.

    By the limits that hold where nothing is set, and by some that are set; with the largest rate of another bench.
    """
    rng = np.random.default_rng(2)
    seen: set[str] = set()
    others = (
        SafetyConfig(jump=0.2, mu_max=0.03),
        SafetyConfig(jump_fraction=0.3, death=0.03),
        SafetyConfig(mu_max=0.01, drift=0.2),
        SafetyConfig(noise_od=0.02, noise_fraction=0.001),
        SafetyConfig(noise_od=0.001, noise_fraction=0.03, drift=0.02),
    )
    for k, config in enumerate([C] * 6 + [*others]):
        given = (config, 0.006 if k % 3 == 2 else 0.02, TUBES)
        change, twins = UnexplainedChange(*given), [Culture(tube, *given[:2]) for tube in TUBES.tolist()]
        minute = 0.0
        true = rng.choice([0.04, 0.055, 0.3, 0.5, 1.2], N)
        mu, gain = rng.choice([-0.03, -0.008, 0.0, 0.02, 0.035, 0.05], N), rng.choice([0.0, 0.4, 0.6, 1.0, 1.5, 1.8], N)
        feeds, setpoint = rng.choice([0.0, 0.5, 0.96, 1.2], N), rng.choice([0.04, 0.3, 0.5, 2.0], N)
        for _ in range(60):
            dt = float(rng.choice([0.0, 0.5, 1.0, 2.0, 7.0], p=[0.03, 0.1, 0.67, 0.1, 0.1]))
            feed = feeds * (rng.random(N) < 0.95)
            setpoint = np.where(rng.random(N) < 0.01, 2.0, setpoint)
            low = feed * rng.choice([1.0, 0.5, 0.0], N, p=[0.8, 0.1, 0.1])
            change.dosed(feed, low)
            for twin, ml, least_ml in zip(twins, feed, low, strict=True):
                twin.since, twin.least = twin.since + ml, twin.least + least_ml
            true = np.clip(true * np.exp(mu * dt - gain * feed / TUBES), 0.02, 3.0)
            true = np.where(rng.random(N) < 0.01, true * rng.choice([0.6, 0.93, 1.07, 1.5], N), true)
            minute += dt
            bubble = np.where(rng.random(N) < 0.05, rng.uniform(-0.1, 0.15, N), 0.0)
            od, believed = true + 0.003 * rng.standard_normal(N) + bubble, rng.random(N) < 0.95
            od = np.where(np.arange(N) % 2, od, np.round(od, 2))  # 0.05 itself among them
            takes = change.takes(od, np.full(N, 60.0 * minute), believed)
            findings = told(change.check(od, np.full(N, 60.0 * minute), believed, setpoint))
            if dt:  # a second sample of the same minute leaves the time as it was
                assert takes.tolist() == (change._at == minute).tolist()
            rows = zip(twins, od, believed, setpoint, strict=True)
            expected = [t.judge(o, minute, b, s) for t, o, b, s in rows]
            assert [sorted(kinds) for kinds in findings] == [sorted(kinds) for kinds in expected]
            seen |= {kind for kinds in expected for kind in kinds}
            same(
                vars(change), twins, _od="od", _at="at", _since_ml="since", _suspect="suspect", _mu="mu",
                _suspect_at="suspect_at", _suspects="suspects", _excess="excess", _deficit="deficit",
                _futile="futile", _over="over", _helpless_od="helpless", _eased="eased",
            )  # fmt: skip
            if rng.random() < 0.05:
                change = resumed(change, UnexplainedChange(*given))
    assert seen == {"jump", "falls", "falls+", "no_dilution+", "cannot_hold"}


@pytest.mark.parametrize(("reading", "kinds"), [(0.18, []), (0.2, ["jump"])])
def test_after_a_night_growth_explains_a_factor_of_150_and_no_more(reading: float, kinds: list[str]) -> None:
    change, one = UnexplainedChange(C, 0.02, np.full(1, 20.0)), np.ones(1)
    change.check(0.001 * one, 0.0 * one, one > 0.0, one)  # exp(5) = 148, and 0.04 of noise
    assert told(change.check(reading * one, 6e4 * one, one > 0.0, one), 1) == [kinds]


@pytest.mark.parametrize(
    ("key", "least", "less", "allowed"),
    [("od_max", 1.5, 1.49, "1.5 to 10"), ("stale_s", 66.0, 65.9, "66 to 7200"), ("lost_s", 100, 99.9, "100 to 14400")],
)
def test_limits_that_rest_on_one_another(key: str, least: float, less: float, allowed: str) -> None:
    SafetyConfig(**{key: least + 1e-9}).ages_s(Bench())
    if key != "stale_s":  # 1.1 periods are not 66 to the last bit
        SafetyConfig(**{key: least}).ages_s(Bench())
    with pytest.raises(ValueError, match=rf"safety\.{key} = {less}( OD)?: allowed {allowed}"):
        SafetyConfig(**{key: less}).ages_s(Bench())


def test_ages_follow_the_period_of_the_bench() -> None:
    assert SafetyConfig().ages_s(Bench()) == (100.0, 180.0)
    assert SafetyConfig().ages_s(Bench(period_s=150.0)) == (190.0, 450.0)
    assert SafetyConfig(stale_s=500.0).ages_s(Bench()) == (500.0, 500.0)
    with pytest.raises(ValueError, match=r"safety\.stale_s = 100.0: allowed 165 to 7200"):
        Interlock(1, SafetyConfig(stale_s=100.0), Bench(period_s=150.0))


def test_each_vial_has_its_own_level_and_dilution() -> None:
    """The ledger is full 5 mL above each tube, and at what a vial holds where that is less. And 5 mL into 5 mL leave
    exp(-1) of an OD of 0.8, 0.29; into 20 mL they leave 0.62, and 0.29 is no culture's."""

    def look(interlock: Interlock, minute: int, od: float, rate: float = 0.0) -> Any:
        n = len(interlock.budget.fed_ml)
        m = Measurement(np.full(n, 60.0 * minute), np.full(n, od), np.full(n, 37.0), np.full(n, True), None)
        return interlock.check(m, np.full(n, rate), np.full(n, 0.5), np.full(n, np.nan), 60.0 * minute)

    full = Interlock(3, SafetyConfig(ml_per_minute=1e3), Bench(volume_ml=12.0), np.array([12.0, 20.0, 28.0]), 30.0)
    for k in range(40):
        rate = look(full, k, 0.5 + 0.001 * (k % 7), 0.01).rate
        full.confirm(Receipt(60.0 * rate, (), np.zeros(3)), 60.0 * k)
    assert full.budget.fed_ml.tolist() == pytest.approx([4.8, 4.8, 1.8])
    thinned = Interlock(2, SafetyConfig(), Bench(volume_ml=20.0), np.array([5.0, 20.0]))
    assert look(thinned, 0, 0.8).kinds == ((), ())
    thinned.confirm(Receipt(np.full(2, 5.0), (), np.full(2, 20.0)), 0.0)
    assert look(thinned, 1, 0.294).kinds == ((), ("falls",))


# -- conclusions -----------------------------------------------------------------------------------------------------


Check = Callable[..., tuple[float, Response, tuple[str, ...], str]]


def one(config: SafetyConfig = C) -> tuple[Interlock, Check]:
    """A reactor, and how to ask about it: minute, OD -> rate, response, kinds, line."""
    interlock = Interlock(1, config)

    def check(
        minute: float, od: float, rate: float = 0.01, fresh: bool = True, fault: Fault | None = None, **m: Any
    ) -> Any:
        vitals = Vitals(np.zeros(1), np.full(1, 9000.0), (fault,))
        of = Measurement(np.full(1, 60.0 * minute), np.array([od]), np.full(1, 37.0), np.array([fresh]), vitals)
        setpoint = np.array([m.get("setpoint", 0.5)])
        v = interlock.check(of, np.array([rate]), setpoint, np.full(1, 37.0), 60.0 * minute)
        return v.rate[0], Response(v.response[0]), v.kinds[0], v.reasons[0] or ""

    return interlock, check


@pytest.mark.parametrize("response", ["pumps_off", "hold", "stop"])
def test_after_a_fall_nothing_is_dosed_for_five_minutes_also_over_a_restart(response: str) -> None:
    config = SafetyConfig(responses=Responses(falls=response))
    interlock, check = one(config)
    assert check(0, 0.5)[:3] == (0.01, Response.PASS, ())
    for minute, od in ((1, 0.3), (2, 0.301), (3, 0.302)):  # the third is believed, and the pause begins
        assert check(minute, od)[2] == ("falls",)
    for minute in (4, 5, 6, 7):
        before, (interlock, check) = interlock, one(config)
        interlock.restore(json.loads(json.dumps(before.state())))
        rate, code, kinds, line = check(minute, 0.3 + 0.001 * minute)
        assert (rate, kinds) == (0.0, ("falls",))
        assert code == (Response.STOP if response == "stop" else Response.HOLD)
        assert line == f"falls: {FallsPause(minutes=8.0 - minute).sentence}; no dose; {FallsPause.remedy}"
    rate, code, kinds, line = check(8, 0.308)
    assert kinds == ()
    assert (rate, code) == ((0.0, Response.STOP) if response == "stop" else (0.01, Response.PASS))
    assert line == ("stopped earlier in this run" if response == "stop" else "")


def test_a_pause_is_not_said_of_samples_that_are_not_new_and_not_twice() -> None:
    _, check = one()
    for minute, od in ((0, 0.5), (1, 0.3), (2, 0.301), (3, 0.302)):
        check(minute, od)
    assert check(3.5, 0.3, fresh=False) == (0.0, Response.PASS, (), "")
    assert check(4, 0.1)[1:3] == (Response.PUMPS_OFF, ("falls",))


def test_the_worst_reason_counts_and_what_a_device_says_is_passed_on() -> None:
    _, check = one()
    found = check(0, 0.5, fault=StalledFault("no sample"))
    assert found == (0.0, Response.HOLD, ("stalled",), "stalled: no sample; no dose")
    rate, code, kinds, line = check(1, 14.0, fault=PumpFault("Pump1 on"), rate=0.03)
    assert (rate, code, kinds) == (0.0, Response.PUMPS_OFF, ("pump", "spectrometer", "limit"))
    assert line.count(" | ") == 2
    assert check(2, 0.5, rate=0.03)[:3] == (0.02, Response.PASS, ("limit",))


@pytest.mark.parametrize(
    ("given", "sound", "target"),
    [(1.5, True, 1.5), (0.01, True, 0.05), *((given, False, 0.5) for given in (1.51, 0.0, -0.3, np.nan, np.inf))],
)
def test_the_target_for_the_regulation_on_board_is_a_sane_one(given: float, sound: bool, target: float) -> None:
    interlock = Interlock(1)
    m = Measurement(np.zeros(1), np.array([0.5]), np.full(1, 37.0), np.array([True]))
    verdict = interlock.check(m, np.array([0.01]), np.array([given]), np.full(1, 37.0), 0.0)
    assert verdict.setpoint[0] == target
    assert verdict.kinds[0] == (() if sound else ("setpoint",))


def test_what_is_latched_is_never_loosened_and_only_the_rows_meant() -> None:
    interlock, three = Interlock(3), np.ones(3)
    m = Measurement(np.zeros(3), 0.5 * three, 37.0 * three, np.ones(3, bool))
    interlock.latch(Response.STOP, np.array([True, False, False]))
    interlock.latch(Response.REGULATE, np.array([True, False, True]))
    verdict = interlock.check(m, 0.01 * three, 0.5 * three, 37.0 * three, 0.0)
    assert verdict.response.tolist() == [Response.STOP, Response.PASS, Response.REGULATE]
    stopped, left = "stopped earlier in this run", "handed over to the on-board regulation earlier in this run"
    assert verdict.reasons == [stopped, None, left]


@pytest.mark.parametrize(("jump", "believed"), [("hold", [False, True, False]), ("report", [True, True, False])])
def test_a_step_is_acted_on_only_where_it_is_no_more_than_reported(jump: str, believed: list[bool]) -> None:
    interlock = Interlock(3, SafetyConfig(responses=Responses(jump=jump)))
    for minute, od, fresh in ((0, [0.5, 0.5, 0.5], True), (1, [0.8, 0.51, 0.51], np.array([True, True, False]))):
        of = Measurement(np.full(3, 60.0 * minute), np.array(od), np.full(3, 37.0), np.full(3, True) & fresh)
        answer = interlock.believes(of).tolist()
        verdict = interlock.check(of, np.full(3, 0.01), np.full(3, 0.5), np.full(3, 37.0), 60.0 * minute)
    assert answer == believed
    assert (verdict.rate > 0.0).tolist() == believed
    assert verdict.kinds[0] == ("jump",)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("_latched", [0.5], "_latched: .*no such code"),
        ("_latched", [5.0], "no such code"),
        ("_hold_kind", [-2.0], "_hold_kind: .*no such code"),
        ("_hold_kind", [float(len(PAUSES))], "no such code"),
        ("fed_ml", [1.0, 2.0], r"fed_ml has shape \(2,\), this run needs \(1,\)"),
        ("_dose_ml", [[0.0, 0.0]], r"_dose_ml has shape \(1, 2\), this run needs \(1, 4\)"),
    ],
)
def test_a_damaged_state_is_named(key: str, value: Any, words: str) -> None:
    state = Interlock(1).state()
    with pytest.raises(ValueError, match=rf"interlock.*{words}"):
        Interlock(1).restore({**state, key: value})
    if isinstance(value, list) and len(value) == 1:  # one damaged reactor of two
        with pytest.raises(ValueError, match="interlock"):
            Interlock(2).restore({**Interlock(2).state(), key: [state[key][0], value[0]]})


# -- settings of one's own, and reactors that are not alike -----------------------------------------------------------


def test_each_limit_of_a_sample_is_the_one_that_is_set() -> None:
    """None of these would be told, or all of them, by the limits that hold where nothing is set."""
    for config, first, minute, second, kind in (
        (SafetyConfig(od_max=2.0), 1.99, 1, 2.01, "impossible"),
        (SafetyConfig(od_min=0.02), 0.03, 1, 0.01, "impossible"),
        (SafetyConfig(jump=0.2), 0.5, 1, 0.73, "jump"),
        (SafetyConfig(death=0.03), 0.5, 20, 0.22, "falls"),
    ):
        _, check = one(config)
        assert [check(0, first, rate=0.0)[2], check(minute, second, rate=0.0)[2]] == [(), (kind,)], config


def test_a_pause_lasts_as_long_as_is_set_and_in_the_reactor_that_it_is_for() -> None:
    """OD of the second falls at once; 12 min later it is dosed again, and the first was dosed all along."""
    interlock, dosed = Interlock(2, SafetyConfig(cooldown=12.0)), []
    for k in range(16):
        od = np.array([0.5, 0.5 if k == 0 else 0.3]) + 0.001 * (k % 5)
        m = Measurement(np.full(2, 60.0 * k), od, np.full(2, 37.0), np.ones(2, bool))
        verdict = interlock.check(m, np.array([0.01, 0.002]), np.full(2, 0.5), np.full(2, np.nan), 60.0 * k)
        interlock.confirm(Receipt(60.0 * verdict.rate), 60.0 * k)
        dosed.append(verdict.rate.tolist())
    assert [first for first, _ in dosed] == [0.01] * 16
    assert [second for _, second in dosed] == [0.002] + [0.0] * 14 + [0.002]


def test_a_bench_of_another_period_and_cap_counts_in_its_own_doses() -> None:
    """Every 2 min 0.006 mL/s at most, 0.72 mL: a minute holds 1.8 mL, and three doses that were not given are told."""
    bench = Bench(period_s=120.0, max_rate=0.006)
    budget, yes = FeedBudget(C, bench, np.full(1, 14.0), np.full(1, 19.0)), np.array([True])
    for k in range(4):
        allowed, findings = budget.check(np.array([0.02]), yes, 120.0 * k)
        budget.grant(allowed)
    seen = [{"rate": 0.02, "most": 0.006}, {"owed_ml": pytest.approx(2.16)}]
    assert (allowed[0], [f.of(0).fields for f in findings if f.rows[0]]) == (0.006, seen)
    budget.book(np.array([1.2]), np.array([9.0]), 480.0)
    allowed, findings = budget.check(np.array([0.006]), yes, 500.0)
    left = {"left_ml": pytest.approx(0.6), "asked_ml": pytest.approx(0.72)}
    assert [f.of(0).fields for f in findings if f.rows[0]] == [left]
    assert allowed[0] == 0.0


def test_a_reason_speaks_of_the_numbers_of_its_own_reactor() -> None:
    interlock = Interlock(4, SafetyConfig(controller_patience=1), Bench(bottle_ml=9.0))
    interlock.budget.book(np.array([8.7, 0.0, 0.0, 0.0]), np.array([40.0, 0.0, 0.0, 0.0]), -7200.0)

    def found(minute: int, od: list[float], rate: list[float], warm: list[float]) -> list[Any]:
        vitals = Vitals(np.zeros(4), np.array([9000.0, 8000.0, 7000.0, 2.0]), (None,) * 4)
        m = Measurement(np.full(4, 60.0 * minute), np.array(od), np.array(warm), np.ones(4, bool), vitals)
        target = np.array([36.0, 37.0, 35.0, 34.0])
        verdict = interlock.check(m, np.array(rate), np.array([0.5, 0.6, 1.7, 0.8]), target, 60.0 * minute)
        return [(faults[0].kind, *faults[0].fields.values()) for faults in verdict.faults]

    assert found(0, [0.6, 0.5, 0.7, 0.8], [0.01, 0.03, 0.004, 0.004], [45.1, 37.0, 35.0, 34.0]) == [
        ("hot", 45.1, 36.0), ("limit", 0.03, 0.02), ("setpoint", 1.7, 1.5), ("spectrometer", 0.8, 2.0)
    ]  # fmt: skip
    assert found(1, [0.61, 0.71, 4.2, 0.81], [-0.02, 0.0, 0.0, 0.0], [36.0, 37.0, 35.0, 34.0]) == [
        ("controller_lost", 1.0), ("jump", 0.5, 0.71), ("impossible", 4.2, 7000.0, -0.1, 4.0),
        ("spectrometer", 0.81, 2.0),
    ]  # fmt: skip
    assert interlock.state()["_latched"] == [Response.REGULATE, 0.0, 0.0, 0.0]


def test_what_was_fed_at_least_is_booked_beside_what_was_fed_at_most() -> None:
    interlock, level = Interlock(3), []
    for waste in (np.zeros(3), np.full(3, 0.5), None):  # one without waste leaves the level at its tube
        interlock.confirm(Receipt(np.zeros(3) + 1.0, (), waste, low_ml=np.ones(3)), 0.0)
        level.append(interlock.budget.volume_ml[0])
    assert level == [21.0, 21.5, 20.0]
    interlock = Interlock(3)
    interlock.confirm(Receipt(np.array([1.2, 0.6, 0.4]), low_ml=np.array([0.3, 0.6, 0.0])), 60.0)
    interlock.confirm(Receipt(np.array([0.1, 0.2, 0.3])), 120.0)
    state = interlock.state()
    assert state["_since_ml"] == pytest.approx([1.3, 0.8, 0.7])
    assert state["_since_low_ml"] == pytest.approx([0.4, 0.8, 0.3])
    assert state["fed_ml"] == pytest.approx([1.3, 0.8, 0.7])
