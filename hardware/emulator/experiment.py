"""The experiment thread of one reactor: measure, regulate, stir, record, once a minute."""

from __future__ import annotations

from hardware.emulator.computer import AppError
from hardware.emulator.events import Steps
from hardware.emulator.od_regulation import feed_duty, zigzag
from hardware.emulator.optics import Optics
from hardware.emulator.outputs import BUS_S, Outputs
from hardware.emulator.position import Position
from hardware.emulator.pump_outputs import PERIOD_FACTOR
from hardware.emulator.sysdata import append_records, clear_terminal, thin_records
from hardware.emulator.vial import Sample

__all__ = ["Experiment"]

READINGS = 4
READING_PAUSE_S = 0.25
SETTLE_S = 5.0
CYCLE_EXTRA_S = 0.05  # what a cycle's bookkeeping adds to its 60 s
FILE_DUMP_S = 0.2  # writing the whole state; startTimeRaw reads 0 meanwhile
FEED_CAP = 0.02  # the on-board regulator's own limit


class Experiment:
    """The experiment of one reactor."""

    def __init__(self, position: Position, outputs: Outputs, optics: Optics) -> None:
        self._position, self._outputs, self._optics = position, outputs, optics
        self._started: float | None = None

    def forget(self) -> None:
        """As after `initialise()`: it was never started."""
        self._started = None

    def start_or_stop(self, value: int) -> Steps:
        """`Experiment/<value>`: starts only if value is not 0 and nothing runs; anything else stops."""
        data, experiment = self._position.data, self._position.data["Experiment"]
        if value and experiment["ON"] == 0:
            experiment["ON"] = 1
            self._position.terminal("Experiment Started")
            if experiment["cycles"] == 0:
                self._started = self._position.computer.wall()
                experiment["startTime"] = self._position.computer.stamp()
                experiment["startTimeRaw"] = self._position.computer.http_date()
            data["Pump1"]["direction"] = data["Pump2"]["direction"] = 1.0
            yield from self._outputs.everything_off()
            yield from self._outputs.set_on("Thermostat", 1)
            yield BUS_S
            self._position.computer.spawn(self._cycle(), f"{self._position.name}/Experiment")
            return
        experiment["ON"] = 0
        data["OD"]["ON"] = 0
        self._position.terminal("Experiment Stopping at end of cycle")
        for item in ("Pump1", "Pump2", "Stir", "Thermostat"):
            yield from self._outputs.set_on(item, 0)

    def _finish(self) -> Steps:
        """End of the last cycle."""
        yield from self._outputs.everything_off()
        self._position.terminal("Experiment Stopped")

    def _cycle(self) -> Steps:
        """`runExperiment`: one cycle of about 60 s (docs/device.md, Cycle)."""
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
        if experiment["ON"] == 0:
            experiment["cycles"] -= 1
            yield from self._finish()
            return
        yield from self._measure()
        yield from self._act()
        yield from self._store(started)
        if experiment["ON"] == 0:
            yield from self._finish()
            return
        rest = experiment["cycleTime"] - round(computer.wall() - began, 2)
        if rest < 0.0:
            self._position.terminal("Experiment Cycle Time is too short!!!")
        yield max(rest, 0.0) + CYCLE_EXTRA_S + computer.uniform(0.0, 0.04)
        yield from self._outputs.set_on(data["Light"]["Excite"], 0)
        self._position.terminal(f"Cycle {experiment['cycles']} Complete")
        if experiment["ON"] and experiment["threadCount"] == mine:
            computer.spawn(self._cycle(), f"{self._position.name}/Experiment")
        else:
            yield from self._finish()

    def _measure(self) -> Steps:
        """Four readings, their mean OD, three temperatures, fluorescence; `Measuring` is 1 meanwhile."""
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
        od["Measuring"] = 0

    def _act(self) -> Steps:
        """Regulation and light; then wait for the waste pump, then stir. Custom programs end at once on Python 3."""
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
        """Records, thinning, files."""
        data, experiment = self._position.data, self._position.data["Experiment"]
        if experiment["cycles"] % 10 == 9:
            clear_terminal(data, self._position.computer.stamp())
        append_records(data, started)
        if self._position.vial is not None:
            self._position.vial.samples.append(
                Sample(self._position.computer.now(), started, float(data["OD"]["current"]))
            )
        thin_records(data)
        self._position.computer.write_row(self._position.name)
        if experiment["cycles"] % 10 == 1:
            raw, experiment["startTimeRaw"] = experiment["startTimeRaw"], 0
            yield FILE_DUMP_S
            experiment["startTimeRaw"] = raw

    def _regulate(self) -> Steps:
        """`RegulateOD`: the on-board turbidostat (docs/device.md, Regulation)."""
        data, od, cycles = self._position.data, self._position.data["OD"], self._position.data["Experiment"]["cycles"]
        restore = od["target"]
        if data["Volume"]["target"] == 0:
            raise AppError("division by a volume of 0")
        swinging = data["Zigzag"]["ON"] == 1
        if swinging:
            zigzag(data)
        feed = 0.0 if cycles < 3 or len(data["time"]["record"]) < 2 else feed_duty(data)
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
        if swinging:
            od["target"] = restore
