"""The interlock: each reason, few false alarms on a noisy healthy plant, and thousands of random steps against it."""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from envs.bench import Bench
from envs.plant.plant import Plant, PlantConfig
from envs.plant.sensor import SensorConfig
from hardware.actuator import SPARE, THERMOSTAT, Actuator
from hardware.emulator.device import plant_preset
from hardware.messages import Fault, LinkFault
from hardware.reactor import Measurement, Receipt, Vitals
from hardware.safety.config import DONE, Response, SafetyConfig
from hardware.safety.interlock import Interlock, Ruling, kinds_of
from hardware.safety.messages import PAUSES, NoDilutionPause


class Drive:
    """One reactor told minute by minute what it reads and what is proposed."""

    def __init__(self, config: SafetyConfig | None = None, bench: Bench | None = None) -> None:
        self.interlock = Interlock(1, config, bench)
        self.minute = 0

    def __call__(
        self,
        od: float = 0.5,
        rate: float = 0.008,
        setpoint: float = 0.5,
        temperature: float = 37.0,
        target: float = 37.0,
        fault: Fault | None = None,
        raw: float = 9000.0,
        age: float = 0.0,
        fresh: bool = True,
        dosed: bool = True,
        **receipt: Any,
    ) -> Ruling:
        now = 60.0 * self.minute
        vitals = Vitals(np.array([age]), np.array([raw]), (fault,))
        m = Measurement(np.array([now]), np.array([od]), np.array([temperature]), np.array([fresh]), vitals)
        verdict = self.interlock.check(m, np.array([rate]), np.array([setpoint]), np.array([target]), now)
        feed = verdict.rate * 60.0 * dosed
        given = {"volume_ml": feed, "waste_ml": 4.0 * feed + 4.0} | receipt
        self.interlock.confirm(Receipt(**given), now)
        self.minute += 1
        return verdict

    def noisy(self, minutes: int, rng: np.random.Generator, **values: Any) -> None:
        """A healthy stretch at OD 0.5."""
        for _ in range(minutes):
            self(od=0.5 + 0.0036 * rng.standard_normal(), **values)


def filed(interlock: Interlock) -> Any:
    """Its state as the file has it."""
    return json.loads(json.dumps(interlock.state()).replace("-Infinity", "null").replace("NaN", "null"))


def only(verdict: Ruling) -> tuple[str, ...]:
    return verdict.kinds[0]


# -- every reason ----------------------------------------------------------------------------------------------------

EMPTY, TUBE = {"rate": 0.02}, {"rate": 0.02, "waste_ml": np.zeros(1)}
KINDS = {one.kind: one for one in Fault.__subclasses__() if one.__module__.startswith("hardware.")}
TRIGGERS: dict[str, tuple[list[dict[str, Any]], Response]] = {
    "setpoint": ([{"setpoint": 5.0}], Response.HOLD),
    "controller": (4 * [{"rate": -0.001}], Response.HOLD),
    "controller_lost": (5 * [{"rate": np.nan}], Response.REGULATE),
    "limit": ([{"rate": 0.5}], Response.PASS),
    "budget": (2 * [EMPTY], Response.HOLD),
    "bottle": (3 * [EMPTY], Response.HOLD),
    "overflow": (5 * [TUBE], Response.PUMPS_OFF),
    "undosed": (4 * [{"rate": 0.02, "dosed": False}], Response.PASS),
    "impossible": ([{"od": np.nan}], Response.HOLD),
    "spectrometer": ([{"od": 14.06, "raw": 1.0}], Response.PUMPS_OFF),
    "frozen": (3 * [{"od": 0.51234567}], Response.HOLD),
    "jump": ([{"od": 0.65}], Response.HOLD),
    "falls": ([{"od": 0.2}], Response.PUMPS_OFF),
    "stale": (2 * [{"fresh": False}], Response.HOLD),
    "lost": (4 * [{"fresh": False}], Response.PUMPS_OFF),
    "silent": (12 * [{"fresh": False}], Response.STOP),
    "hot": ([{"temperature": 45.5, "target": 42.0}], Response.HOLD),
    "thermometer": (3 * [{"temperature": np.nan}], Response.PASS),
}
OF_DEVICES = {
    **dict.fromkeys(("link", "selection", "absent", "restarted", "stalled", "mode", "blank"), Response.HOLD),
    **dict.fromkeys(("stopped", "pump"), Response.PUMPS_OFF), "overflow_pump": Response.HOLD, "identity": Response.STOP,
}  # fmt: skip
LIMITS = {"budget": (SafetyConfig(ml_per_hour=2.0), None), "bottle": (None, Bench(bottle_ml=2.5)),
          "silent": (SafetyConfig(silent=10.0), None)}  # fmt: skip


@pytest.mark.parametrize("kind", TRIGGERS | OF_DEVICES)
def test_every_reason_is_told_and_answered_as_declared_and_forgotten_unless_it_is_for_good(kind: str) -> None:
    steps, response = TRIGGERS.get(kind) or ([{"fault": KINDS[kind]("seen")}], OF_DEVICES[kind])
    drive = Drive(*LIMITS.get(kind, (None, None)))
    verdict = drive()
    assert (verdict.rate[0], verdict.response[0], verdict.reasons) == (0.008, Response.PASS, [None])
    for k, values in enumerate(steps):
        verdict = drive(**{"od": 0.501 + 0.001 * (k % 7), **values})
    assert only(verdict)[-1] == kind
    assert verdict.response[0] == response
    expected = {"limit": 0.02, "undosed": 0.02, "thermometer": 0.008}
    assert verdict.rate[0] == expected.get(kind, 0.0)
    assert verdict.heat_off[0] == (kind in ("hot", "thermometer"))
    assert 0.0 < verdict.setpoint[0] <= 1.5
    line = str(verdict.reasons[0])
    assert line.startswith(f"{kind}: ")
    assert line.endswith(f"{DONE[response]}; {verdict.faults[0][-1].remedy}".rstrip("; "))
    later = drive(od=0.512, raw=9000.0)
    assert later.heat_off[0] == verdict.heat_off[0]  # for good
    if response >= Response.REGULATE:
        assert later.response[0] == response
    else:
        assert later.rate[0] > 0.0 or kind in ("overflow", "bottle", "budget")


def test_what_a_reactor_tells_of_doses_that_it_does_not_take_stands_in_the_place_of_what_the_ledger_shows() -> None:
    drive, fault = Drive(), KINDS["undosed"]("its lock")
    for k in range(4):
        verdict = drive(od=0.5 + 0.001 * k, rate=0.02, dosed=False, fault=fault)
    assert verdict.faults == ((fault,),)


def test_every_declared_reason_is_tried() -> None:
    elsewhere = {"no_dilution", "cannot_hold", "fluorescence", "fluorescence_lost", "command_limit"}
    assert set(TRIGGERS) | set(OF_DEVICES) | elsewhere == set(KINDS)


# -- against a plant -------------------------------------------------------------------------------------------------

NOISY = SensorConfig(
    noise_floor=0.0033, noise_relative=0.003, noise_factor_sd=0.35, lag1=0.12, gain_cv=0.07, curvature=-0.1,
    blank_error=0.01, drift_per_h=0.002, outlier_rate=0.006, bubble_rate=0.002, zero_rate=0.0005, quantised=True,
)  # fmt: skip
LEVELS = np.linspace(0.0, 0.02, 17)


def cultivate(
    plant: PlantConfig, n: int, minutes: int, spoil: tuple[int, str, float] | None = None, setpoint: float | None = None
) -> tuple[Interlock, list[Ruling], Plant]:
    """N vials under an inverse law on 17 levels, setpoints 0.8, 0.65, 0.5, 0.3 for an hour each (or one for ever)."""
    vials = Plant(plant, n, np.random.default_rng(0))
    vials.reset(0.5, 37.0)
    interlock = Interlock(n, bench=Bench(bottle_ml=1e6))
    verdicts = []
    for k in range(minutes):
        if spoil is not None and k == spoil[0]:
            getattr(vials.feed, spoil[1])[:] = spoil[2]
        target = np.full(n, setpoint if setpoint is not None else (0.8, 0.65, 0.5, 0.3)[k // 60 % 4])
        od = vials.read_od()
        m = Measurement(np.full(n, 60.0 * k), od, vials.thermal.read(), np.ones(n, bool))
        wish = (0.025 + 0.8 * np.log(np.maximum(od, 1e-3) / target)) / 3.0
        rate = LEVELS[np.clip(np.round(np.nan_to_num(wish) / 0.00125), 0, 16).astype(int)]
        verdict = interlock.check(m, rate, target, np.full(n, 37.0), 60.0 * k)
        feed = 60.0 * verdict.rate
        interlock.confirm(Receipt(feed, (), 4.0 * feed + 4.0), 60.0 * k)
        vials.advance(1.0, feed, np.where(feed > 0.0, 4.0 * feed + 4.4, 0.0))
        verdicts.append(verdict)
    return interlock, verdicts, vials


def count(verdicts: list[Ruling], kind: str) -> int:
    return sum(kind in kinds for verdict in verdicts for kinds in verdict.kinds)


@pytest.mark.slow
@pytest.mark.parametrize("mu", [0.014, 0.025, 0.031])
def test_thirty_healthy_reactors_for_a_day_are_left_alone(mu: float) -> None:
    """Only outliers and bubbles are held back: 1.5 % of the minutes at most, nothing latches, no flow alarm."""
    healthy = replace(plant_preset("bench"), sensor=NOISY)
    healthy = replace(healthy, growth=replace(healthy.growth, mu=mu))
    interlock, verdicts, _ = cultivate(healthy, 30, 1440)
    held = np.array([v.response > Response.PASS for v in verdicts]).mean()
    assert held < 0.015
    assert count(verdicts, "no_dilution") == 0
    assert max(int(v.response.max()) for v in verdicts) <= Response.PUMPS_OFF
    assert count(verdicts, "jump") > 30  # the outliers are there
    if mu < 0.03:  # the fastest ones outgrow a weak pump head now and then, and that is true
        assert count(verdicts, "cannot_hold") == 0
    assert np.all(interlock.budget.volume_ml <= 20.0)


@pytest.mark.parametrize(
    ("spoilt", "value", "mu", "n", "minutes", "least"),
    [
        *((spoilt, 0.0, mu, 30, 25, 30) for spoilt in ("gain_factor", "media_left_ml") for mu in (0.014, 0.025)),
        ("gain_factor", 0.3, None, 20, 100, 19),  # once the culture outgrows it
    ],
)
def test_a_weak_pump_is_found(spoilt: str, value: float, mu: float | None, n: int, minutes: int, least: int) -> None:
    sound = replace(plant_preset("bench"), sensor=NOISY)
    sound = replace(sound, growth=replace(sound.growth, mu=mu or sound.growth.mu))
    _, verdicts, _ = cultivate(sound, n, 120 + minutes, (120, spoilt, value), 0.5)
    found = np.zeros(n, dtype=bool)
    for verdict in verdicts[120:]:
        found |= ["no_dilution" in kinds or "cannot_hold" in kinds for kinds in verdict.kinds]
    assert found.sum() >= least


@pytest.mark.parametrize("pause", PAUSES)
def test_a_refilled_bottle_ends_the_pause_of_a_feed_that_did_not_dilute_and_no_other(pause: type[Fault]) -> None:
    held = Drive().interlock.state() | {"_hold_until_s": [3600.0], "_hold_kind": [float(PAUSES.index(pause))]}
    drive = Drive()
    drive.interlock.restore(held)
    assert drive().rate[0] == 0.0
    drive.interlock.refilled(0, 500.0)
    assert (drive(od=0.501).rate[0] > 0.0) == (pause is NoDilutionPause)


def test_each_signal_s_command_is_cut_to_the_limits_of_its_own_actuator_and_told() -> None:
    """Rows: below, at, above the limits, and none; a line names what was asked and both limits."""
    config, bench = SafetyConfig(composition_low=30.0, composition_high=34.0), Bench(max_rate=0.013)
    interlock, lamp = Interlock(4, config, bench), Actuator("lamp", "%", 5.0, 85.0)
    limits = {SPARE[3]: (0.0, 0.013), SPARE[4]: (0.0, 0.013), THERMOSTAT: (30.0, 34.0), lamp: (5.0, 85.0)}
    for actuator, (low, high) in limits.items():
        given = interlock.command(actuator, np.array([low - 1.0, low, high + 0.004, np.nan]))
        np.testing.assert_array_equal(given, [low, low, high, np.nan])
    for told in ([actuator.name for actuator in limits], []):
        od, time = np.full(4, 0.5 + 0.001 * len(told)), np.full(4, 60.0 * (len(told) == 0))
        m = Measurement(time, od, np.full(4, 37.0), np.full(4, True))
        found = interlock.check(m, np.full(4, 0.008), np.full(4, 0.5), np.full(4, 37.0), time[0]).faults
        assert [[fault.fields["actuator"] for fault in faults] for faults in found] == [told, [], told, []]


# -- attacked --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seed", "period_s", "given", "most_ml"), [(0, 60.0, None, 3.0), (1, 30.0, None, 2.1), (2, 30.0, 0.84, 0.84)]
)
def test_thousands_of_random_steps_never_get_a_dose_past_a_limit(
    seed: int, period_s: float, given: float | None, most_ml: float
) -> None:
    rng = np.random.default_rng(seed)
    n, bench = 8, Bench(bottle_ml=150.0, period_s=period_s)
    c = SafetyConfig(ml_per_minute=given, ml_per_hour=30.0, silent=1e5)
    interlock = Interlock(n, c, bench)
    now, fed = 0.0, np.zeros(n)
    doses: list[tuple[float, np.ndarray]] = []
    level = np.full(n, 20.0)

    def strange(low: float, high: float) -> np.ndarray:
        values = rng.uniform(low, high, n)
        odd = rng.random(n) < 0.15
        return np.where(odd, rng.choice([np.nan, np.inf, -np.inf, 0.0, -1.0, 14.0, 1e300, 5.0], n), values)

    for _ in range(500):
        now += float(rng.choice([0.0, 1.0, 30.0, 60.0, 61.0, 150.0, 5000.0], p=[0.05, 0.1, 0.1, 0.5, 0.2, 0.04, 0.01]))
        fresh, od, rate, setpoint = rng.random(n) < 0.8, strange(0.45, 0.55), strange(0.0, 0.03), strange(0.3, 0.8)
        faults = tuple(LinkFault("x") if rng.random() < 0.05 else None for _ in range(n))
        vitals = Vitals(rng.uniform(0.0, 130.0, n), strange(4000.0, 12000.0), faults)
        m = Measurement(np.full(n, now), od, strange(36.0, 38.0), fresh, vitals)
        v = interlock.check(m, rate, setpoint, strange(36.0, 38.0), now)
        assert np.all((v.rate >= 0.0) & (v.rate <= bench.max_rate))
        assert np.all(v.rate[~fresh] == 0.0)
        assert np.all(v.rate[v.response > 0] == 0.0)
        with np.errstate(invalid="ignore"):
            bad = ~((od > -0.1) & (od < 4.0)) | ~((setpoint > 0.0) & (setpoint <= 1.5)) | ~(rate >= 0.0)
        assert np.all(v.rate[bad] == 0.0)
        assert all(v.rate[i] == 0.0 for i in range(n) if faults[i] is not None)
        told = zip(v.reasons, v.kinds, v.response, strict=True)
        assert all((line is None) == (not kinds) or code >= 3 for line, kinds, code in told)
        feed = v.rate * period_s
        waste = np.where(rng.random(n) < 0.1, 0.0, 4.0 * feed + 4.0)
        interlock.confirm(Receipt(feed, (), waste), now)
        level = np.where(waste > 0.0, np.maximum(level + feed - waste, 20.0), level + feed)
        doses.append((now, feed))
        fed += feed
        assert np.all(level <= 25.0 + 1e-9)
        assert np.all(fed <= bench.bottle_ml + 1e-9)
        assert np.all(sum(f for t, f in doses if now - t < 60.0) <= most_ml + 1e-9)
        assert np.all(sum(f for t, f in doses[-200:] if now - t < 3540.0) <= c.ml_per_hour + 1e-9)
        if rng.random() < 0.01:  # the program dies and comes back
            state = filed(interlock)
            interlock = Interlock(n, c, bench)
            interlock.restore(state)
    assert fed.sum() > 2.0


@pytest.mark.parametrize("period_s", [10.0, 20.0, 25.0, 60.0, 120.0])
def test_full_feed_is_within_the_budget_of_a_minute_at_every_period(period_s: float) -> None:
    interlock = Interlock(1, SafetyConfig(), Bench(period_s=period_s))
    late = np.random.default_rng(0).uniform(0.0, 0.1, 30) * period_s
    for k, now in enumerate(period_s * np.arange(30) + late):
        m = Measurement(np.array([now]), np.array([0.5 + 1e-3 * (k % 7)]), np.array([37.0]), np.array([True]))
        verdict = interlock.check(m, np.array([0.02]), np.array([0.45]), np.array([37.0]), now)
        assert "budget" not in verdict.kinds[0]
        feed = verdict.rate * period_s
        interlock.confirm(Receipt(feed, (), 4.0 * feed + 4.0), now)


def test_after_a_resume_a_reactor_is_stale_only_once_it_had_its_chance() -> None:
    def check(lock: Interlock, now: float, fresh: list[bool], age_s: list[float]) -> tuple[tuple[str, ...], ...]:
        vitals = Vitals(np.array(age_s), np.full(2, 9000.0), (None, None))
        m = Measurement(np.full(2, now), np.full(2, 0.5 + 1e-6 * now), np.full(2, 37.0), np.array(fresh), vitals)
        return lock.check(m, np.full(2, 0.01), np.full(2, 0.5), np.full(2, 37.0), now).kinds

    before, after = Interlock(2), Interlock(2)
    check(before, 600.0, [True, True], [0.0, 0.0])
    after.restore(filed(before))
    assert check(after, 3000.0, [True, False], [0.0, 20.0]) == ((), ())
    assert check(after, 3060.0, [True, False], [0.0, 80.0]) == ((), ())
    assert check(after, 3105.0, [True, False], [0.0, 125.0]) == ((), ("stale",))
    assert check(after, 3190.0, [True, False], [0.0, 210.0]) == ((), ("lost",))
    assert check(after, 3200.0, [False, True], [10.0, 0.0]) == ((), ())


# -- declarations ----------------------------------------------------------------------------------------------------


def test_a_pump_too_weak_for_the_setpoint_is_told_for_as_long_as_that_lasts() -> None:
    """Half the flow: 0.03 1/min dilute what grows with 0.031, so OD stays where it is, at full feed."""
    drive, rng, kinds, od = Drive(), np.random.default_rng(2), [], 0.7

    def live(minutes: int, pump: float, setpoint: float) -> None:
        nonlocal od
        for _ in range(minutes):
            rate = 0.02 if od > setpoint else 0.0
            verdict = drive(od=od * (1.0 + 0.006 * rng.standard_normal()), rate=rate, setpoint=setpoint)
            kinds.append(only(verdict))
            od *= float(np.exp(0.031 - pump * verdict.rate[0] * 60.0 / 20.0))

    live(80, 0.5, 0.5)
    first = kinds.index(("cannot_hold",))
    assert first < 40
    assert all(kind == ("cannot_hold",) for kind in kinds[first:])
    state, drive.interlock = filed(drive.interlock), Interlock(1)
    drive.interlock.restore(state)
    live(10, 0.5, 0.5)
    assert kinds[-8:] == [("cannot_hold",)] * 8
    live(5, 0.5, 1.0)  # a setpoint it can hold: told until three samples say so
    assert kinds[-3:] == [()] * 3
    live(60, 0.5, 0.5)
    assert kinds[-1] == ("cannot_hold",)
    live(15, 1.0, 0.5)  # the pump is sound again: OD falls
    assert kinds[-1] == ()
    assert od > 0.5


def test_full_feed_at_the_setpoint_is_no_trouble() -> None:
    """Nor is a long way down, as long as OD falls."""
    for mu, start in ((0.06, 0.5), (0.04, 1.4)):
        drive, rng, od = Drive(), np.random.default_rng(3), start
        for _ in range(60):
            verdict = drive(od=od * (1.0 + 0.006 * rng.standard_normal()), rate=0.02, setpoint=0.5)
            assert "cannot_hold" not in only(verdict)
            od *= float(np.exp(mu - 0.06 * (verdict.rate[0] > 0.0)))


def test_the_kinds_in_a_line_of_reasons() -> None:
    line = "jump: OD 0.5 to 0.9; no dose; check | cannot_hold: full feed: weak; reported; see"
    assert kinds_of(line) == ["jump", "cannot_hold"]
    assert kinds_of("") == kinds_of("handed over to the on-board regulation earlier in this run") == []
