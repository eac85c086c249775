"""Checks before a run: one line each, passed or with a remedy. They change only which reactor is selected."""

import math
import shutil
from collections.abc import Iterator
from email.utils import parsedate_to_datetime
from pathlib import Path

from envs.bench import VIAL_ML, Bench
from hardware.chibio.config import ChiBioConfig
from hardware.chibio.connection import Connection
from hardware.chibio.dosing import MAX_FEED_DUTY, ReactorCalibration
from hardware.chibio.fluorescence import HIDDEN, FluorescenceSlotConfig
from hardware.chibio.protocol import PERIOD_S, UNSET_BLANK, DeviceState, Permitted
from hardware.clock import Clock, DeviceClock
from hardware.errors import ReactorError
from hardware.family import Check
from hardware.link.transport import Transport
from hardware.logbook import no_log

MARGIN = 1.1  # over the feed pump's flow: pumps differ from their calibration
FULL_SCALE = 65535.0  # counts of the spectrometer
FREE_MB = 1000.0  # a week of eight reactors writes about 240 MB (docs/faults.md)


def preflight(
    transport: Transport,
    clock: Clock,
    config: ChiBioConfig,
    calibrations: list[ReactorCalibration],
    folder: Path | None = None,
    bench: Bench | None = None,
) -> list[Check]:
    """Check disk, overflow pump, connection, clock; per reactor presence, identity, blank, modes, sensors and pumps.

    Args: as for `ChiBioReactors`; folder: the run's folder, whose disk is checked.
    Raises: nothing about the device; a check that cannot be made counts as failed.
    """
    checks = [_disk(folder)] if folder is not None else []
    fullest_ml = float((bench or Bench()).volumes(config.reactors).max())
    checks.append(_overflow_pump(config, calibrations, VIAL_ML - fullest_ml))
    try:
        checks += [_link(transport, clock, config.speed), _board_clock(transport, clock, config)]
    except ReactorError as error:
        return [*checks, Check("connection", False, str(error), "check cable, address and that the server runs")]
    for name, calibration in zip(config.reactors, calibrations, strict=True):
        connection = Connection(name, Permitted(config.reactors), transport, clock, no_log)
        try:
            state = connection.read()
            if not state.running:
                connection.probe()  # a device that never ran an experiment shows no temperature yet
                state = connection.read()
        except ReactorError as error:
            remedy = f"stop the server and plug it in, or remove {name} from backend.reactors"
            checks.append(Check(f"{name} present", False, str(error), remedy))
            continue
        found = f"identity {state.device_id}, software {state.version or 'unnamed'}"
        checks += [Check(f"{name} present", True, found), *_reactor(name, state, calibration, config)]
        if config.fluorescence.measure:
            checks.append(_fluorescence(name, state, config.fluorescence))
    return checks


def _disk(folder: Path) -> Check:
    free = shutil.disk_usage(folder).free / 1e6
    return Check("disk", free > FREE_MB, f"{free:.0f} MB free", f"free at least {FREE_MB:.0f} MB under {folder}")


def _link(transport: Transport, clock: Clock, speed: float) -> Check:
    """Check how fast the device answers, device s. A fast emulator's time depends on the load of the computer."""
    start = clock.now()
    for _ in range(3):
        transport.get("/getSysdata/")
    took = (clock.now() - start) / 3.0
    remedy = "close web pages; use a faster link" if speed <= 1.0 else f"a lower backend.speed than {speed:g}"
    return Check("connection", took < 2.0, f"{took:.2f} s per answer", remedy, required=speed <= 1.0)


def _board_clock(transport: Transport, clock: Clock, config: ChiBioConfig) -> Check:
    """Check that the board's clock runs evenly; its absolute time does not matter (docs/device.md, Failures)."""
    dates, times = [], []
    for pause in (5.0, 0.0):
        reply = transport.get("/getSysdata/")
        times.append(clock.now())
        try:
            dates.append(parsedate_to_datetime(reply.date).timestamp())
        except ValueError:
            return Check("board clock", True, "not visible over this link", required=False)
        clock.sleep(pause)
    passed_s = times[1] - times[0]
    drift = (dates[1] - dates[0]) - (DeviceClock(config.speed).to_real(passed_s) if config.speed else passed_s)
    seen = f"{drift:+.1f} s against this computer"
    return Check("board clock", abs(drift) < 2.5, seen, "stop clock corrections on the board")


def _overflow_pump(config: ChiBioConfig, calibrations: list[ReactorCalibration], room_ml: float) -> Check:
    """Check which failures the overflow pump covers. Args: room_ml: free volume above the fullest culture, mL."""
    overflow, feed = config.overflow_pump, max(calibration.feed.flow_ml_s for calibration in calibrations)
    if not overflow.pump:
        return Check(
            "overflow pump",
            False,
            f"none: with a blocked waste tube a vial overflows after about {room_ml:.0f} mL of feed",
            "a second waste tube on Pump3, backend.overflow_pump.pump=Pump3 (docs/device.md)",
            required=False,
        )
    covers = "a blocked waste tube" + " and a feed motor stuck on" * (overflow.removes_ml_s > MARGIN * feed)
    return Check(
        "overflow pump",
        overflow.removes_ml_s > MAX_FEED_DUTY * feed,
        f"{overflow.pump} at duty {overflow.duty:g} takes {overflow.removes_ml_s:.2f} mL/s, feed pump {feed:.2f} mL/s "
        f"at full power: covers {covers}; verified on when the run starts",
        "less than the largest feed: raise backend.overflow_pump.duty",
        required=False,
    )


def _fluorescence(name: str, state: DeviceState, config: FluorescenceSlotConfig) -> Check:
    what = f"{name} fluorescence"
    slot, found = config.own(state), config.wrong(state)
    if slot is None:
        return Check(what, False, f"{config.slot} is {HIDDEN}", "or set backend.fluorescence.measure=false")
    if found:
        return Check(what, True, f"{slot.name} is {found}: the run switches it on as configured")
    if state.cycles == 0 or slot.base == 0.0 == slot.emission:
        return Check(what, True, f"{slot.name} on, no measurement yet")
    return Check(
        what,
        0.0 < slot.counts < FULL_SCALE,  # not nan
        f"{slot.name}: {slot.counts:.0f} counts of {slot.band}, base {slot.base:.0f}",
        f"at 0 check {slot.led} and the spectrometer; at {FULL_SCALE:.0f} lower backend.fluorescence.gain",
    )


def _reactor(name: str, state: DeviceState, calibration: ReactorCalibration, config: ChiBioConfig) -> Iterator[Check]:
    blank = calibration.blank if math.isfinite(calibration.blank) else state.blank
    source = "stored" if math.isfinite(calibration.blank) else "of the device"
    yield Check(
        f"{name} blank",
        3000.0 <= blank <= 60000.0 and blank != UNSET_BLANK,
        f"{blank:.0f} counts ({source})",
        "measure it with clear medium: python -m experiments.blank",
    )
    modes = config.fluorescence.others_on(state)
    yield Check(
        f"{name} modes",
        not modes and not state.regulating,
        ", ".join([*modes, *(["OD regulation"] if state.regulating else [])]) or "none active",
        "switch them off in the web page (OD regulation is switched off by the run itself)",
        required=bool(modes),
    )
    yield Check(
        f"{name} temperature",
        10.0 < state.temperature < 45.0,
        f"{state.temperature:.1f} degC",
        "check that the vial is seated under the thermometer",
    )
    yield Check(
        f"{name} light sensor",
        state.cycles == 0 or state.raw >= 5.0,
        f"raw {state.raw:.0f} after {state.cycles} cycles",
        "check the spectrometer; restart the device",
    )
    feed, waste = calibration.feed, calibration.waste
    same = all(not p.device_id or p.device_id == state.device_id for p in (feed, waste))
    dates = f"feed {feed.date or 'never weighed'}, waste {waste.date or 'never weighed'}"
    yield Check(
        f"{name} pump calibration",
        calibration.calibrated and same,
        dates + ("" if same else ", on another unit"),
        f"python -m experiments.calibrate_pump reactor={name}; until then {feed.flow_ml_s:g} mL/s is assumed",
        required=False,
    )
    stronger = 4.0 * waste.flow_ml_s / feed.flow_ml_s
    yield Check(
        f"{name} waste over feed",
        stronger >= 1.5,
        f"waste moves {stronger:.1f} times the feed in its on-time",
        "exchange or repair the waste pump",
    )
    on = config.overflow_pump.others_on(state)
    yield Check(
        f"{name} pumps",
        not on,
        f"{on or 'all'} {'on' if on else 'off'}",
        f"an earlier client left them on, each repeats its dose every {PERIOD_S:.0f} s; the run switches them off",
        required=False,
    )
