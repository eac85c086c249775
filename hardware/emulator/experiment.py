"""The experiment thread of one reactor: measure, regulate, stir, record, once a minute."""

import math
from datetime import UTC, datetime
from email.utils import format_datetime

from hardware.emulator.computer import AppError, Steps
from hardware.emulator.optics import Optics
from hardware.emulator.outputs import BUS_S, PERIOD_FACTOR, Outputs, Position
from hardware.emulator.sysdata import SysData, append_records, clear_terminal, thin_records
from hardware.emulator.vial import StoredSample

READINGS = 4
READING_PAUSE_S = 0.25
SETTLE_S = 5.0
CYCLE_EXTRA_S = 0.05  # time that a cycle's bookkeeping adds to its 60 s
FILE_DUMP_S = 0.2  # to write the whole state; meanwhile startTimeRaw reads 0
FEED_CAP = 0.02  # the on-board regulator's own limit


class Experiment:
    def __init__(self, position: Position, outputs: Outputs, optics: Optics) -> None:
        self._position, self._outputs, self._optics = position, outputs, optics
        self._started: float | None = None

    def forget(self) -> None:
        """Reset the experiment as `initialise()` does: it was never started."""
        self._started = None

    def start_or_stop(self, value: int) -> Steps:
        """Carry out `Experiment/<value>`: start if value is not 0 and no experiment runs, else stop."""
        data, experiment = self._position.data, self._position.data["Experiment"]
        if value and experiment["ON"] == 0:
            experiment["ON"] = 1
            self._position.terminal("Experiment Started")
            if experiment["cycles"] == 0:
                self._started = self._position.computer.wall()
                experiment["startTime"] = self._position.computer.stamp()
                board = datetime.fromtimestamp(int(self._started), UTC)
                experiment["startTimeRaw"] = format_datetime(board, usegmt=True)  # as Flask writes it
            data["Pump1"]["direction"] = data["Pump2"]["direction"] = 1.0
            yield from self._outputs.everything_off()
            yield from self._outputs.set_on("Thermostat", 1)
            yield BUS_S
            self._position.spawn(self._cycle(), "Experiment")
            return
        experiment["ON"] = 0
        data["OD"]["ON"] = 0
        self._position.terminal("Experiment Stopping at end of cycle")
        for item in ("Pump1", "Pump2", "Stir", "Thermostat"):
            yield from self._outputs.set_on(item, 0)

    def _finish(self) -> Steps:
        yield from self._outputs.everything_off()
        self._position.terminal("Experiment Stopped")

    def _cycle(self) -> Steps:
        """Run one cycle of about 60 s, as `runExperiment` (docs/device.md, Cycle)."""
        data, experiment, computer = self._position.data, self._position.data["Experiment"], self._position.computer
        mine = experiment["threadCount"] = (experiment["threadCount"] + 1) % 100
        began = computer.wall()
        if self._started is None:
            raise AppError("the experiment has no start time")
        started = round(began - self._started, 2)
        experiment["cycles"] += 1
        self._position.terminal(f"Cycle {experiment['cycles']} Started")
        yield from self._outputs.set_on("Stir", 0)
        yield SETTLE_S
        if experiment["ON"] != 0:
            yield from self._measure()
        if experiment["ON"] == 0:  # the cycle does not count, and `Measuring` stays 1
            experiment["cycles"] -= 1
            yield from self._finish()
            return
        data["OD"]["Measuring"] = 0
        yield from self._act()
        yield from self._store(started)
        if experiment["ON"] == 0:
            yield from self._finish()
            return
        rest = experiment["cycleTime"] - round(computer.wall() - began, 2)
        if rest < 0.0:
            self._position.terminal("Experiment Cycle Time is too short!!!")
        yield max(rest, 0.0) + CYCLE_EXTRA_S + computer.rng.uniform(0.0, 0.04)
        yield from self._outputs.set_on(data["Light"]["Excite"], 0)
        self._position.terminal(f"Cycle {experiment['cycles']} Complete")
        if experiment["ON"] and experiment["threadCount"] == mine:
            self._position.spawn(self._cycle(), "Experiment")
        else:
            yield from self._finish()

    def _measure(self) -> Steps:
        """Measure the mean OD of four readings, three temperatures and fluorescence; set `Measuring` to 1."""
        od = self._position.data["OD"]
        od["Measuring"] = 1
        total = 0.0
        for _ in range(READINGS):
            yield from self._optics.measure_od()
            total += od["current"]
            yield READING_PAUSE_S
        od["current"] = total / READINGS
        for which in ("Internal", "External", "IR"):
            self._position.measure_temperature(which)
            yield BUS_S
        yield from self._optics.measure_fluorescence()

    def _act(self) -> Steps:
        """Regulate, switch the light, wait for the waste pump, stir. Custom programs end at once on Python 3."""
        data = self._position.data
        if data["OD"]["ON"] == 1:
            yield from self._regulate()
        if data["Light"]["ON"] == 1:
            yield from self._outputs.set_on(data["Light"]["Excite"], 1)
        waste = data["Pump2"]
        period = PERIOD_FACTOR * data["Experiment"]["cycleTime"]
        yield period * abs(waste["target"]) * waste["ON"] + 0.5
        yield from self._outputs.set_on("Stir", 1)

    def _store(self, started: float) -> Steps:
        data, experiment = self._position.data, self._position.data["Experiment"]
        if experiment["cycles"] % 10 == 9:
            clear_terminal(data, self._position.computer.stamp())
        append_records(data, started)
        if self._position.vial is not None:
            now, vial = self._position.computer.now(), self._position.vial
            vial.sync(now)
            culture_od = float(vial.plant.culture.od[0])
            vial.samples.append(StoredSample(now, started, float(data["OD"]["current"]), culture_od))
        thin_records(data)
        faults = self._position.computer.faults
        faults.bus_stuck = faults.bus_stuck or faults.disk_full  # a row is written under the bus lock
        self._position.computer.bus(self._position.name)
        if experiment["cycles"] % 10 == 1:
            raw, experiment["startTimeRaw"] = experiment["startTimeRaw"], 0
            yield FILE_DUMP_S
            experiment["startTimeRaw"] = raw

    def _regulate(self) -> Steps:
        """Run the on-board turbidostat, as `RegulateOD` (docs/device.md, Regulation)."""
        data, cycles = self._position.data, self._position.data["Experiment"]["cycles"]
        if data["Volume"]["target"] == 0:
            raise AppError("division by a volume of 0")
        feed = 0.0 if cycles < 3 or len(data["time"]["record"]) < 2 else _feed_duty(data)
        feed = min(max(feed, 0.0), FEED_CAP)
        if data["Chemostat"]["ON"] == 1:
            feed = float(data["Chemostat"]["p1"])
        data["Pump1"]["target"] = feed * data["Pump1"]["direction"]
        data["Pump2"]["target"] = (4.0 * feed + 0.07) * data["Pump2"]["direction"]
        if cycles % 5 == 1:
            data["Pump2"]["target"] = 0.25 * data["Pump2"]["direction"]
        if cycles > 15 and data["Pump1"]["target"] == 0 and not any(data["Pump1"]["record"][-10:-1]):
            data["Pump1"]["target"] = data["Pump2"]["target"] = 0.0
        yield from self._outputs.set_on("Pump1", 1)
        yield from self._outputs.set_on("Pump2", 1)


def _feed_duty(data: SysData) -> float:
    """Return the feed pump's duty before clipping: P on ln(x / r) per minute, two integrators, 0 after a jump up."""
    od, times = data["OD"], data["time"]["record"]
    now, before = od["current"], od["record"][-1]
    target = od["target"] if od["target"] > 0 else 1e-6
    minutes = (times[-1] - times[-2]) / 60.0
    growth = math.log(now / target) / minutes if now > 0 and minutes != 0 else 0.0
    feed = growth / (240.0 / data["Volume"]["target"])
    error, change = now - target, now - before
    if error < 0.01:
        od["Integral"] = 0
    elif abs(change) < 0.05 and error > 0.025:
        od["Integral"] += 0.1 * error
    if abs(error) > 0.1 and abs(change) < 0.05:
        od["Integral2"] = 0
    elif abs(change) < 0.1:
        od["Integral2"] += 0.01 * error
        feed *= 0.7
    return 0.0 if change > 0.04 else float(feed + od["Integral"] + od["Integral2"])
