"""What the device's software does for one reactor: outputs, measurements, experiment cycle, pumps, thermostat.

Every activity that the device runs in a thread, or that makes a caller wait, is a generator that yields the seconds it
sleeps; `emulator_device` runs them on device time. Races between threads of the real software are therefore the same
races between generators. Source: docs/device.md, checked against runs of the real software described there.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import Any, Protocol

from hardware.emulator.od_regulation import AppError, feed_duty, zigzag
from hardware.emulator.sysdata import (
    LIGHTS,
    PUMPS,
    SLOTS,
    add_terminal,
    append_records,
    clear_terminal,
    fresh_sysdata,
    thin_records,
)
from hardware.emulator.vial import Bench, BenchConfig, Sample

__all__ = ["AppError", "Board", "BusStuck", "ProcessDied", "ReactorApp", "Steps"]

Steps = Generator[float, None, None]

PERIOD_FACTOR = 1.05  # pump period over cycle time: 63 s
EXPOSURE_S = 0.97  # one spectrometer reading
READINGS = 4
READING_PAUSE_S = 0.25
SETTLE_S = 5.0
BUS_S = 0.02  # a register written and read back
OFF_SHARE, QUIET_SHARE = 0.2, 0.8  # of a pump's start delay: until a running motor stops, until the pause is counted
CYCLE_EXTRA_S = 0.05  # what a cycle's bookkeeping adds to its 60 s
FILE_DUMP_S = 0.2  # writing the whole state; startTimeRaw reads 0 meanwhile
FEED_CAP = 0.02  # the on-board regulator's own limit


class BusStuck(Exception):
    """The global bus lock is never released: the caller waits for ever."""


class ProcessDied(Exception):
    """The software ended itself (exit code 4)."""


class Board(Protocol):
    """What the software of one reactor needs of the computer it runs on."""

    def now(self) -> float:
        """Device time, s, never jumps."""
        ...

    def wall(self) -> float:
        """The board's clock, s since 1970; jumps when it is set."""
        ...

    def stamp(self) -> str:
        """The board's clock as "YYYY-MM-DD HH:MM:SS"."""
        ...

    def http_date(self) -> str:
        """The board's clock as an RFC 1123 string."""
        ...

    def spawn(self, steps: Steps, owner: str) -> None:
        """Start a thread; `owner` names it for fault injection."""
        ...

    def bus(self, name: str) -> None:
        """One access to a chip of a reactor. Raises: BusStuck, ProcessDied."""
        ...

    def write_row(self, name: str) -> None:
        """One line of a data file, under the bus lock. Raises: BusStuck."""
        ...

    def uniform(self, low: float, high: float) -> float:
        """A random number: how busy the board happens to be."""
        ...


class ReactorApp:
    """The software's view of reactor `name`; `data` is its sysData.

    Args:
      name: M0 to M7; board: the computer; bench: what hangs on the cable, None for an empty position;
      device_id: what its IR thermometer answers as identity; selected: reactor shown on the web page.
    """

    def __init__(self, name: str, board: Board, bench: Bench | None, device_id: str, selected: str) -> None:
        self.name, self.board, self.bench, self.device_id = name, board, bench, device_id
        self.initialise(selected)

    @property
    def answers(self) -> bool:
        """Does a reactor hang on the cable?"""
        return self.bench is not None and not self.bench.faults.unplugged

    def initialise(self, selected: str) -> None:
        """`initialise()`: everything forgotten. Threads of before stay alive, as they do on the device."""
        self.data: dict[str, Any] = fresh_sysdata(self.device_id if self.answers else "", selected)
        self._threads = dict.fromkeys((*PUMPS, "Thermostat"), 0)
        self._started: float | None = None
        self.terminal("System Initialised")

    def terminal(self, text: str) -> None:
        """One line in the web page's log."""
        add_terminal(self.data, self.board.stamp(), text)

    def _hardware(self) -> Bench:
        """The reactor behind the bus. Raises: BusStuck, ProcessDied (absent or unplugged reactor)."""
        self.board.bus(self.name)
        if self.data["present"] == 0 or self.bench is None or self.bench.faults.unplugged:
            raise ProcessDied(f"access to absent reactor {self.name}")
        return self.bench

    # -- outputs ---------------------------------------------------------------------------------------------------

    def set_target(self, item: str, value: float) -> Steps:
        """`SetOutputTarget`: clamp, store, and restart the output if it is on."""
        output = self.data[item]
        if value < output["min"]:
            value = output["min"]
        if value > output["max"]:
            value = output["max"]
        output["target"] = value
        if output["ON"] == 1 and item not in ("OD", "Thermostat"):
            yield from self.set_on(item, 0)
            yield from self.set_on(item, 1)

    def set_on(self, item: str, force: int) -> Steps:
        """`SetOutputOn`: 1 on, 0 off, anything else toggles."""
        output = self.data[item]
        output["ON"] = force if force in (0, 1) else int(output["ON"] == 0)
        yield from self._apply(item)

    def _apply(self, item: str) -> Steps:
        """`SetOutput`: make the electronics do what `ON` and `target` say.

        Raises: AppError for an item that drives nothing; its flag is set by then.
        """
        output = self.data[item]
        if item == "Stir":
            yield from self._stir()
        elif item == "Heat":
            self._hardware().set_heat(float(output["target"] * output["ON"]), self.board.now())
        elif item in LIGHTS or item == "UV":
            self._hardware()
        elif item == "LASER650":
            self._hardware().set_laser(output["target"] * output["ON"] > 0, self.board.now())
        elif item == "Thermostat":
            self.board.spawn(self._thermostat(), f"{self.name}/Thermostat")
        elif item in PUMPS:
            if output["target"] == 0:
                output["ON"] = 0
            self.board.spawn(self._pump(item), f"{self.name}/{item}")
        elif item == "OD":
            yield from self.set_on("Pump1", 0)
            yield from self.set_on("Pump2", 0)
        elif item == "Zigzag":
            output["target"] = 5.0
            output["SwitchPoint"] = self.data["Experiment"]["cycles"]
        else:
            raise AppError(f"{item} is no output")

    def _stir(self) -> Steps:
        """Kick at full power, then down to the target; off at once."""
        stir = self.data["Stir"]
        if stir["target"] * stir["ON"] > 0:
            self._hardware().set_stirrer(1.0, self.board.now())
            yield 1.5
            for above in (0.4, 0.8):
                if stir["target"] > above and stir["ON"] == 1:
                    yield 0.75
        self._hardware().set_stirrer(stir["target"] * stir["ON"], self.board.now())

    def everything_off(self) -> Steps:
        """`turnEverythingOff`: lights, laser, pumps, stirrer, heater, thermostat."""
        for item in (*LIGHTS, "LASER650", *PUMPS, "Stir", "Heat", "UV"):
            self.data[item]["ON"] = 0
        bench, now = self._hardware(), self.board.now()
        for pump in PUMPS:
            bench.drive(pump, 0, now)
        bench.set_laser(False, now)
        yield BUS_S
        for item in ("Stir", "Thermostat", "Heat", "UV", *PUMPS):
            yield from self.set_on(item, 0)

    def _pump(self, item: str) -> Steps:
        """`PumpModulation`: one period of 63 s; a newer thread of the same pump takes over.

        Five registers are written one after another: In1, In2, In1, In2 to off, then the one that drives to on.
        """
        pump, board = self.data[item], self.board
        mine = self._threads[item] = (self._threads[item] + 1) % 100
        config = self.bench.config if self.bench is not None else BenchConfig()
        delay = board.uniform(config.pump_start_low_s, config.pump_start_high_s)
        yield OFF_SHARE * delay
        if abs(pump["target"] * pump["ON"]) != 1 and mine == self._threads[item]:
            self._hardware().drive(item, 0, board.now())
        yield (QUIET_SHARE - OFF_SHARE) * delay
        if pump["ON"] == 0:
            return
        began = board.wall()
        period = PERIOD_FACTOR * self.data["Experiment"]["cycleTime"]
        on_s = period * abs(pump["target"])
        if math.isnan(on_s):
            raise AppError("sleep length is not a number")
        yield (1.0 - QUIET_SHARE) * delay
        bench = self._hardware()
        if mine == self._threads[item] and pump["target"] != 0:
            bench.drive(item, 1 if pump["target"] > 0 else -1, board.now())
        yield on_s + board.uniform(bench.config.on_time_bias_low_s, bench.config.on_time_bias_high_s)
        if abs(pump["target"]) != 1 and mine == self._threads[item]:
            self._hardware().drive(item, 0, board.now())
        pause = period - round(board.wall() - began, 2)
        if pause > 0.0:
            yield pause
        if pump["ON"] == 1 and mine == self._threads[item]:
            board.spawn(self._pump(item), f"{self.name}/{item}")

    def _thermostat(self) -> Steps:
        """`Thermostat`: one step of the PI law with feed-forward, every 30 s (docs/device.md, Thermostat)."""
        data, thermostat, heat = self.data, self.data["Thermostat"], self.data["Heat"]
        mine = self._threads["Thermostat"] = (self._threads["Thermostat"] + 1) % 100
        if thermostat["ON"] == 0:
            yield from self.set_on("Heat", 0)
            return
        self.measure_temperature("IR")
        temperature, outside = data["ThermometerIR"]["current"], data["ThermometerExternal"]["current"]
        feed_forward = 0.0
        if outside > 0.0:
            feed = data["Pump1"]["target"] * data["Pump1"]["ON"] * data["OD"]["ON"]
            feed_forward = 2.5 * (temperature - outside) * feed
        error, step = thermostat["target"] - temperature, thermostat["cycleTime"]
        near = abs(error) < 2.0
        integral = thermostat["Integral"] + (0.0005 * step * error if near else 0.0)
        moved = abs(thermostat["target"] - thermostat["last"]) > 2.0
        thermostat["Integral"] = 0.0 if moved else min(max(integral, 0.0), 1.0)
        duty = (0.25 if near else 0.5) * error + thermostat["Integral"] + feed_forward
        heat["ON"] = int(not duty < 0.0)
        heat["target"] = min(max(duty, 0.0), 1.0)
        thermostat["last"] = thermostat["target"]
        yield from self._apply("Heat")
        yield step
        if thermostat["ON"] == 1 and mine == self._threads["Thermostat"]:
            self.board.spawn(self._thermostat(), f"{self.name}/Thermostat")
        else:
            heat["ON"], heat["target"] = 0, 0
            yield from self._apply("Heat")

    # -- measurements ----------------------------------------------------------------------------------------------

    def measure_temperature(self, which: str) -> None:
        """`MeasureTemp`. Raises: AppError for another name, or an internal thermometer that does not answer."""
        if which not in ("IR", "Internal", "External"):
            raise AppError(f"no thermometer {which}")
        meter = self.data[f"Thermometer{which}"]
        self.board.bus(self.name)
        if which == "Internal" and self.data["present"] and not self.answers:
            self.data["present"] = 0
            raise AppError("internal thermometer does not answer")
        value = self._hardware().temperature(which, self.board.now())
        meter["current"] = value if value <= 100.0 else meter["current"]

    def expose(self, seconds: float) -> Generator[float, None, int]:
        """Laser on, one reading, laser off; counts. Another thread that measures at the same time spoils it."""
        yield from self.set_on("LASER650", 1)
        self._hardware().begin_exposure(self.board.now())
        yield seconds
        raw = self._hardware().counts(self.board.now(), seconds)
        yield from self.set_on("LASER650", 0)
        self.data["AS7341"]["current"]["ADC0"] = raw
        return raw

    def measure_od(self) -> Steps:
        """`MeasureOD`: OD = b r + a r^2 with r = log10(zero / raw); 0 if raw is 0. Raises: AppError for a zero of 0."""
        raw = yield from self.expose(EXPOSURE_S)
        zero, od = self.data["OD0"], self.data["OD"]
        zero["raw"] = float(raw)
        if abs(raw) <= 0.001:
            od["current"] = 0
            return
        if not zero["target"] > 0.0:
            raise AppError("logarithm of a zero of 0")
        r = math.log10(zero["target"] / raw)
        od["current"] = r * zero["LASERb"] + r * r * zero["LASERa"]

    def measure_fluorescence(self) -> Steps:
        """`MeasureFP`: about a second per enabled slot; the emulated cultures do not fluoresce."""
        for slot in SLOTS:
            if self.data[slot]["ON"] == 1:
                self._hardware()
                yield 1.0
                self.data[slot].update({"Base": 120.0, "Emit1": 0.0, "Emit2": 0.0})

    def calibrate(self, item: str, raw: float, od: float) -> None:
        """`CalibrateOD`: the zero with which `raw` reads as `od` (docs/device.md, Blank)."""
        od0 = self.data["OD0"]
        a, b = od0["LASERa"], od0["LASERb"]
        od = 0 if od < 0 else od
        zero = raw * 10.0 ** (math.sqrt(od / a + (b / (2 * a)) ** 2) - b / (2 * a))
        output = self.data[item]
        if zero < output["min"]:
            zero = output["min"]
        if zero > output["max"]:
            zero = output["max"]
        output["target"] = zero

    # -- experiment ------------------------------------------------------------------------------------------------

    def start_or_stop(self, value: int) -> Steps:
        """`Experiment/<value>`: starts only if value is not 0 and nothing runs; anything else stops."""
        data, experiment = self.data, self.data["Experiment"]
        if value and experiment["ON"] == 0:
            experiment["ON"] = 1
            self.terminal("Experiment Started")
            if experiment["cycles"] == 0:
                self._started = self.board.wall()
                experiment["startTime"] = self.board.stamp()
                experiment["startTimeRaw"] = self.board.http_date()
            data["Pump1"]["direction"] = data["Pump2"]["direction"] = 1.0
            yield from self.everything_off()
            yield from self.set_on("Thermostat", 1)
            yield BUS_S
            self.board.spawn(self._cycle(), f"{self.name}/Experiment")
            return
        experiment["ON"] = 0
        data["OD"]["ON"] = 0
        self.terminal("Experiment Stopping at end of cycle")
        for item in ("Pump1", "Pump2", "Stir", "Thermostat"):
            yield from self.set_on(item, 0)

    def _finish(self) -> Steps:
        """End of the last cycle."""
        yield from self.everything_off()
        self.terminal("Experiment Stopped")

    def _cycle(self) -> Steps:
        """`runExperiment`: one cycle of about 60 s (docs/device.md, Cycle)."""
        data, experiment, board = self.data, self.data["Experiment"], self.board
        mine = experiment["threadCount"] = (experiment["threadCount"] + 1) % 100
        began = board.wall()
        if self._started is None:
            raise AppError("the experiment has no start time")
        started = round(began - self._started, 2)
        experiment["cycles"] += 1
        self.terminal(f"Cycle {experiment['cycles']} Started")
        yield from self.set_on("Stir", 0)
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
        rest = experiment["cycleTime"] - round(board.wall() - began, 2)
        if rest < 0.0:
            self.terminal("Experiment Cycle Time is too short!!!")
        yield max(rest, 0.0) + CYCLE_EXTRA_S + board.uniform(0.0, 0.04)
        yield from self.set_on(data["Light"]["Excite"], 0)
        self.terminal(f"Cycle {experiment['cycles']} Complete")
        if experiment["ON"] and experiment["threadCount"] == mine:
            board.spawn(self._cycle(), f"{self.name}/Experiment")
        else:
            yield from self._finish()

    def _measure(self) -> Steps:
        """Four readings, their mean OD, three temperatures, fluorescence; `Measuring` is 1 meanwhile."""
        od = self.data["OD"]
        od["Measuring"] = 1
        total = 0.0
        for _ in range(READINGS):
            yield from self.measure_od()
            total += od["current"]
            yield READING_PAUSE_S
        od["current"] = total / READINGS
        for which in ("Internal", "External", "IR"):
            self.measure_temperature(which)
            yield BUS_S
        yield from self.measure_fluorescence()
        od["Measuring"] = 0

    def _act(self) -> Steps:
        """Regulation and light; then wait for the waste pump, then stir. Custom programs end at once on Python 3."""
        data = self.data
        if data["OD"]["ON"] == 1:
            yield from self._regulate()
        if data["Light"]["ON"] == 1:
            yield from self.set_on(data["Light"]["Excite"], 1)
        waste = data["Pump2"]
        period = PERIOD_FACTOR * data["Experiment"]["cycleTime"]
        yield period * abs(waste["target"]) * waste["ON"] + 0.5
        yield from self.set_on("Stir", 1)

    def _store(self, started: float) -> Steps:
        """Records, thinning, files."""
        data, experiment = self.data, self.data["Experiment"]
        if experiment["cycles"] % 10 == 9:
            clear_terminal(data, self.board.stamp())
        append_records(data, started)
        if self.bench is not None:
            self.bench.samples.append(Sample(self.board.now(), started, float(data["OD"]["current"])))
        thin_records(data)
        self.board.write_row(self.name)
        if experiment["cycles"] % 10 == 1:
            raw, experiment["startTimeRaw"] = experiment["startTimeRaw"], 0
            yield FILE_DUMP_S
            experiment["startTimeRaw"] = raw

    def _regulate(self) -> Steps:
        """`RegulateOD`: the on-board turbidostat (docs/device.md, Regulation)."""
        data, od, cycles = self.data, self.data["OD"], self.data["Experiment"]["cycles"]
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
        yield from self.set_on("Pump1", 1)
        yield from self.set_on("Pump2", 1)
        if swinging:
            od["target"] = restore
