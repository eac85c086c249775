"""What can go wrong in an unattended run of an emulated Chi.Bio, and how it is brought about: the table `FAULTS`."""

import os
import resource
from collections.abc import Callable

import numpy as np

from experiments.laws.base import Array, Mask
from hardware.emulator.faults import inject
from tests.campaigns.fault import Fault
from tests.campaigns.rehearsal import Rehearsal
from tests.campaigns.tracking import BAND_OD, STEP_OD, TOP_OD, outage, undosed

__all__ = ["FAULTS", "FAULTY"]

FAULTY = "M0"
"""The reactor that a fault of one reactor strikes; the others are its healthy neighbours."""

Act = Callable[[Rehearsal], None]


def set_(name: str, value: float = 1.0) -> Act:
    """Switch of the emulator (docs/emulator.md), at the faulty reactor where it belongs to one."""
    return lambda r: inject(r.device, name, FAULTY, value)


def post(*paths: str) -> Act:
    """Another client sends these commands."""

    def act(r: Rehearsal) -> None:
        for path in paths:
            r.device.submit("POST", path)

    return act


def again(act: Act, seconds: float) -> Act:
    """Now, and once more after a while: a first time in the middle of a dose passes with that dose."""

    def later(r: Rehearsal) -> None:
        run_device(r)
        act(r)

    def twice(r: Rehearsal) -> None:
        act(r)
        r.clock.at(r.clock.now() + seconds, lambda: later(r))

    return twice


def both(*acts: Act) -> Act:
    """One after another."""

    def act(r: Rehearsal) -> None:
        for one in acts:
            one(r)

    return act


def sticks(r: Rehearsal) -> None:
    """The feed pump's switch sticks for 8 s."""
    inject(r.device, "feed_stuck_open", FAULTY, 1.0)
    r.clock.at(r.clock.now() + 8.0, lambda: both(run_device, set_("feed_stuck_open", 0.0))(r))


def run_device(r: Rehearsal) -> None:
    """Bring the device up to the clock."""
    r.device.run_until(r.clock.now())


def vial_out(r: Rehearsal) -> None:
    """Nothing in the light path: more light than through clear medium."""
    inject(r.device, "od_offset", FAULTY, -float(r.device.vials[FAULTY].plant.apparent_od[0]) - 0.05)


def full_disk(r: Rehearsal) -> None:
    """The kernel refuses every byte beyond the journal's present size plus a part of a row."""
    limit = os.path.getsize(r.folder / "journal.jsonl") + 60
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


def free_disk(r: Rehearsal) -> None:
    """Bytes are taken again."""
    hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def torn(r: Rehearsal) -> None:
    """What a power cut leaves: the last rows of journal and recording end in the middle."""
    for path in (r.folder / "journal.jsonl", r.folder / "recordings" / f"{FAULTY}.csv"):
        os.truncate(path, os.path.getsize(path) - 7)


def typo(r: Rehearsal) -> None:
    """From now on the schedule of the faulty reactor asks for OD 5.0, which got past the check of its values."""
    r.loop.progress._setpoints[0] = 5.0


class _Broken:
    """A controller that has gone wrong: NaN, or the same rate whatever it sees, or an exception."""

    def __init__(self, rate: float | None) -> None:
        self.rate = rate

    def reset(self, n: int) -> None:
        """Nothing to forget."""

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        """The same for everybody. Raises: RuntimeError if there is no rate."""
        if self.rate is None:
            raise RuntimeError("the controller failed")
        return np.full(od.shape, self.rate)


def control(rate: float | None) -> Act:
    """Replace the controller of all reactors."""

    def act(r: Rehearsal) -> None:
        r.loop.density.law = _Broken(rate)

    return act


INF = np.inf
LINK = ("link", "stale", "lost", "restarted")
FLOW = ("no_dilution", "cannot_hold")
ONCE = "a single loss is read again, or the command repeated; the journal has it, and a dose hit by it a note"
HELD = "feedback makes up for it; only weighing doses (experiments.calibrate_pump) tells it from a change of growth"
GROWTH = "a culture may grow so; feedback makes up for it"

FAULTS: tuple[Fault, ...] = (
    # ---- pumps and tubes
    Fault("feed blocked", "feed pump delivers nothing", set_("pump_gain_factor", 0.0), FLOW,
          unheld="nothing dilutes it", error=INF),
    Fault("feed very weak", "feed pump delivers 20 %", set_("pump_gain_factor", 0.2), FLOW,
          unheld="a fifth of full dilution is less than growth", error=INF),
    Fault("feed weak", "feed pump delivers 50 %", set_("pump_gain_factor", 0.5), why_not=HELD,
          unheld="half of full dilution barely exceeds growth: two steps of 0.15 down are not followed", error=0.36),
    Fault("feed strong", "feed pump delivers 150 %", set_("pump_gain_factor", 1.5), why_not=HELD,
          error=0.14, band=0.12),
    Fault("feed sticks 8 s", "feed pump runs on at full power for 8 s", sticks, ("falls",), rogue=True,
          minutes=0.2, error=0.25 + BAND_OD),
    Fault("back-leak 0.3 mL", "0.3 mL flow back after each dose", set_("back_leak_ml", 0.3), why_not=HELD,
          band=0.08),
    Fault("bottle empty", "no fresh medium is left", set_("media_left_ml", 0.0), FLOW,
          unheld="nothing dilutes it", error=INF),
    Fault(
        "waste weak", "waste pump delivers 30 %", set_("waste_gain_factor", 0.3),
        why_not="it runs at least four times as long as the feed pump: the level stays",
    ),
    Fault(
        "waste blocked 10 min", "a clot that the next clearing dose frees", set_("waste_gain_factor", 0.0),
        end=set_("waste_gain_factor", 1.0), minutes=10.0,
        why_not="there is no level sensor; 10 mL of headroom take more than 15 min of feed",
    ),
    Fault(
        "waste stuck open", "waste pump runs for good", set_("waste_stuck_open"), stuck=True,
        why_not="the level is set by the height of the waste tube: it sucks air",
    ),
    Fault(
        "overflow pump blocked", "the overflow pump moves nothing", set_("overflow_gain_factor", 0.0),
        of_overflow_pump=True,
        why_not="nothing flows there unless the level rises: its tube is checked daily, like the waste tube",
    ),
    # ---- sensor
    Fault("OD frozen", "the spectrometer repeats its last count", set_("od_frozen"), ("frozen",),
          stops="nothing is known of the culture"),
    Fault("OD offset +0.3", "a bubble or condensation that stays", set_("od_offset", 0.3), ("jump",),
          error=0.3 + BAND_OD, band=0.3 + BAND_OD),
    Fault("OD offset -0.3", "the vial was turned", set_("od_offset", -0.3), ("falls",),
          error=0.3 + BAND_OD, band=0.3 + BAND_OD),
    Fault(
        "OD offset +0.05", "a fleck of film", set_("od_offset", 0.05),
        why_not="within what growth, dose and noise do in a minute; the culture is held that much too thin",
        error=0.05 + BAND_OD, band=0.05 + BAND_OD,
    ),
    Fault(
        "OD offset -0.05", "the blank is a little off", set_("od_offset", -0.05),
        why_not="within what growth, dose and noise do in a minute; the culture is held that much too dense",
        error=0.05 + BAND_OD, band=0.05 + BAND_OD,
    ),
    Fault("OD jumps once", "one reading 0.3 too high", set_("od_jump", 0.3), ("jump",)),
    Fault(
        "readings glitch", "every fifth reading fails, for 10 min", set_("spectrometer_glitch", 0.2),
        ("spectrometer", "impossible", "jump"), set_("spectrometer_glitch", 0.0), 10.0,
        error=undosed(10.0),
    ),
    Fault("spectrometer dead", "raw = 1, OD reads 12 to 14", set_("spectrometer_dead"), ("spectrometer",),
          stops="nothing is known of the culture"),
    Fault("spectrometer dark", "raw = 0, OD reads 0", set_("spectrometer_dark"), ("spectrometer",),
          stops="nothing is known of the culture"),
    Fault("vial removed", "nothing in the light path", vial_out, ("falls", "impossible"),
          unheld="what is measured is not the culture", error=INF),
    # ---- link
    Fault("a request is lost", "swallowed on the way", set_("lost_request", 1.0), wide=True, blind=True,
          end=set_("lost_request", 0.0), minutes=3.0, why_not=ONCE),
    Fault("three answers lost", "carried out, never answered", set_("lost_reply", 3.0),
          ("link", "note:no dose", "note:answer"),
          wide=True, blind=True, end=set_("lost_reply", 0.0), minutes=3.0, error=outage(3.0)),
    Fault("link down 5 min", "requests vanish (half-open)", set_("lost_request", -1.0), LINK,
          set_("lost_request", 0.0), 5.0, wide=True, blind=True, error=outage(5.0)),
    Fault("link down 30 min", "requests vanish (half-open)", set_("lost_request", -1.0), LINK,
          set_("lost_request", 0.0), 30.0, wide=True, blind=True, error=outage(30.0) + STEP_OD),
    Fault("answers vanish 5 min", "carried out, never answered", set_("lost_reply", -1.0), LINK,
          set_("lost_reply", 0.0), 5.0, wide=True, blind=True, error=outage(5.0)),
    Fault("connections reset 3 min", "before the request is read", set_("reset_before", -1.0), LINK,
          set_("reset_before", 0.0), 3.0, wide=True, blind=True, error=outage(3.0)),
    Fault("a connection is reset", "carried out, then reset", set_("reset_after", 1.0), wide=True, blind=True,
          end=set_("reset_after", 0.0), minutes=3.0, why_not=ONCE),
    Fault("slow network 1 s", "every request takes 1 s more, for 15 min", set_("slow_s", 1.0), end=set_("slow_s", 0.0),
          minutes=15.0, wide=True, why_not="reads and doses are still in time"),
    Fault("slow network 8 s", "every request takes 8 s more, for 15 min", set_("slow_s", 8.0),
          ("note:too slowly", "note:no dose", "undosed", *LINK), set_("slow_s", 0.0), 15.0, wide=True, blind=True,
          error=outage(15.0)),
    Fault("malformed JSON 3 min", "the state is broken JSON", set_("malformed", -1.0), LINK,
          set_("malformed", 0.0), 3.0, wide=True, blind=True, error=outage(3.0)),
    Fault("truncated answers 3 min", "half the state, then closed", set_("truncated", -1.0), LINK,
          set_("truncated", 0.0), 3.0, wide=True, blind=True, error=outage(3.0)),
    # ---- device
    Fault("worker restarted", "the web worker is replaced, all memory gone", set_("worker_wipe"), ("restarted",),
          minutes=5.0, wide=True, blind=True),
    Fault("request hangs 25 s", "longer than the client waits", set_("hang_s", 25.0), minutes=3.0, wide=True,
          blind=True, why_not=ONCE),
    Fault("request hangs 45 s", "the worker is killed after 30 s", set_("hang_s", 45.0), ("restarted",), minutes=5.0,
          wide=True, blind=True),
    Fault("server crashed", "the software ends; started again after 10 min", set_("crash"), LINK, set_("restart"), 10.0,
          wide=True, blind=True, error=outage(10.0)),
    Fault("board loses power", "its clock starts in 2026; started again after 10 min", set_("power_cut"), LINK,
          set_("restart"), 10.0, wide=True, blind=True, error=outage(10.0)),
    Fault("server lies 5 min", "204 to every command, nothing done", set_("lying", -1.0),
          ("selection", "note:not as set", "pump", "restarted", *LINK), set_("lying", 0.0), 5.0, wide=True, blind=True,
          error=outage(5.0)),
    Fault("bus dead, 204 lies", "the bus lock is never released", set_("bus_stuck"), ("restarted", *LINK), wide=True,
          blind=True, minutes=10.0, error=0.8),
    Fault("bus dies in a dose", "the pumps run on at full power", set_("bus_stuck_when_pumping"), ("restarted", *LINK),
          wide=True, blind=True, rogue=True, minutes=10.0, error=0.8),
    Fault("board's disk full", "a cycle cannot write its row and keeps the bus", set_("disk_full"),
          ("restarted", *LINK), set_("disk_full", 0.0), 10.0, wide=True, blind=True, error=outage(10.0)),
    Fault("reactor unplugged", "cable out; back and started again after 10 min", set_("unplugged"),
          ("absent", *LINK), both(set_("unplugged", 0.0), set_("restart")), 10.0, wide=True, blind=True,
          error=outage(10.0)),
    Fault("started without a reactor", "cable out, device started again after 10 min, reactor still missing",
          set_("unplugged"), ("absent",), set_("restart"), 10.0, wide=True, blind=True, gone=True,
          error=outage(10.0)),
    Fault("started without it in 3 s", "cable out, software ended and started again by a supervisor, reactor missing",
          both(set_("unplugged"), set_("crash")), ("absent",), set_("restart"), 0.05, wide=True, blind=True,
          gone=True, error=outage(3.0)),
    Fault("reactor marked absent", "a thermometer poll failed; started again after 10 min", set_("marked_absent"),
          ("absent", *LINK), set_("restart"), 10.0, wide=True, blind=True, error=outage(10.0)),
    Fault("measuring thread dead", "Experiment.ON stays 1, nothing happens", set_("cycle_dead"), ("stale", "stalled"),
          minutes=10.0, blind=True, error=outage(5.0)),
    Fault("board's clock +1 h", "set forward; a pump that runs repeats its dose at once", set_("clock_step", 3600.0),
          ("note:clock",), wide=True, minutes=3.0, rogue=True,
          blind=True),
    Fault("board's clock -10 min", "set back: a cycle that is going on stalls that long, of any reactor of the board",
          set_("clock_step", -600.0), ("stale", "stalled", "note:clock"), wide=True, minutes=15.0, blind=True,
          error=outage(5.0)),  # to that reactor it is a measuring thread that died
    # ---- other clients
    Fault("foreign selections", "another page selects, every third request, 10 min",
          set_("foreign_selects", 0.3), end=set_("foreign_selects", 0.0), minutes=10.0, wide=True, blind=True,
          why_not="a read is believed only if it names its reactor, and repeated until it does"),
    Fault("reactors never selected", "another page selects all the time, 10 min", set_("foreign_selects", 1.0),
          ("selection",), set_("foreign_selects", 0.0), 10.0, wide=True, blind=True, error=outage(10.0)),
    Fault("foreign regulation", "on-board regulation switched on", post(f"/SetOutputOn/OD/1/{FAULTY}"), ("mode",),
          post(f"/SetOutputOn/OD/0/{FAULTY}"), 10.0, rogue=True, error=outage(10.0)),
    Fault("foreign chemostat", "a mode that pumps is switched on", post(f"/SetOutputOn/Chemostat/1/{FAULTY}"),
          ("mode",), post(f"/SetOutputOn/Chemostat/0/{FAULTY}"), 10.0, error=outage(10.0)),
    Fault("foreign blank", "the zero is set anew", post(f"/CalibrateOD/OD0/{FAULTY}/20000/0"), ("blank",), blind=True,
          stops="somebody has to say which zero is right"),
    Fault("foreign pump", "the feed pump is switched on twice, 0.5 mL every 63 s",
          again(post(f"/SetOutputTarget/Pump1/{FAULTY}/0.008", f"/SetOutputOn/Pump1/1/{FAULTY}"), 95.0),
          ("pump", "note:pumps on", "mode"), rogue=True),
    Fault("foreign overflow pump off", "the overflow pump is switched off",
          lambda r: post(f"/SetOutputOn/{r.config.backend.overflow_pump.pump}/0/{FAULTY}")(r), ("note:overflow pump",),
          of_overflow_pump=True),
    Fault("foreign stop", "the experiment is stopped; started again after 10 min", post(f"/Experiment/0/{FAULTY}"),
          ("stopped",), post(f"/Experiment/1/{FAULTY}"), 10.0, blind=True, error=outage(10.0)),
    Fault("foreign thermostat off", "heating switched off", post(f"/SetOutputOn/Thermostat/0/{FAULTY}"),
          ("note:Thermostat",)),
    Fault("foreign temperature", "thermostat set to 30 degC", post(f"/SetOutputTarget/Thermostat/{FAULTY}/30"),
          ("note:Thermostat",)),
    Fault("foreign stirrer off", "stirrer switched off", post(f"/SetOutputOn/Stir/0/{FAULTY}"),
          why_not="the device's next cycle switches it on again"),
    Fault("foreign stirring", "stirrer set to 0.1", post(f"/SetOutputTarget/Stir/{FAULTY}/0.1"), ("note:Stir",)),
    # ---- culture and temperature
    Fault("temperature run-away", "heater at full power whatever it is told", set_("heater_runaway"), ("hot",),
          stops="the culture is being cooked"),
    Fault("stirrer dead", "does not turn", set_("stirrer_dead"),
          why_not="nothing senses the stirrer; OD settles by 8 % and growth halves, like a slow culture",
          error=0.08 * TOP_OD + BAND_OD, band=0.08 * TOP_OD + BAND_OD),
    Fault("medium swapped", "growth +20 %", set_("mu_factor", 1.2), why_not=GROWTH),
    Fault("growth -40 %", "burden, contamination, cold", set_("mu_factor", 0.6), why_not=GROWTH, recovery_min=20.0),
    Fault("growth stops", "lysis or starvation", set_("mu_factor", 0.0),
          why_not="a culture may do so; feedback stops dosing, OD stays",
          unheld="what is diluted too far does not grow back", error=0.2),
    # ---- this program and its computer
    Fault("program killed 2 min", "SIGKILL, resumed after 2 min", Rehearsal.kill, ("repair:", "end:killed"),
          minutes=2.0, wide=True, program=True, error=outage(2.0)),
    Fault("program killed 30 min", "SIGKILL, resumed after 30 min", Rehearsal.kill, ("repair:", "end:killed"),
          minutes=30.0, wide=True, program=True, error=outage(30.0) + STEP_OD),
    Fault("computer loses power", "torn last rows, resumed after 5 min", Rehearsal.kill, ("repair:Torn",), end=torn,
          minutes=5.0, wide=True, program=True, error=outage(5.0)),
    Fault("disk full", "no byte more; freed and resumed after 5 min", full_disk, ("end:journal",), end=free_disk,
          minutes=5.0, wide=True, program=True, error=outage(5.0)),
    Fault("controller raises", "an exception, resumed after 5 min", control(None), ("end:controller",),
          minutes=5.0, wide=True, program=True, error=outage(5.0)),
    Fault("controller says NaN", "no number any more", control(np.nan), ("controller", "controller_lost"), wide=True,
          rogue=True, error=0.3 + BAND_OD,
          unheld="the device's own regulation keeps to the setpoint of the hand-over"),
    Fault("controller asks 1 mL/s", "fifty times the limit", control(1.0), ("limit",), wide=True,
          unheld="every dose is the largest that the interlock lets pass", error=0.8),
    Fault("setpoint typo", "the schedule asks for OD 5.0", typo, ("setpoint",), stops="nobody knows what is asked"),
    # ---- beyond what a program can prevent: an overflow pump does
    Fault("feed stuck open", "feed pump at full power for good", set_("feed_stuck_open"), ("falls",), rogue=True,
          stuck=True, overflow="1 mL/s fills the headroom of 10 mL in 10 s, OD is measured every 60 s",
          unheld="it is washed out", error=INF),
    Fault("waste blocked", "waste pump delivers nothing for good", set_("waste_gain_factor", 0.0),
          why_not="without a level sensor it looks like faster growth; an overflow pump keeps the level at its tube",
          overflow="10 mL of headroom fill in 15 to 25 min of feed", error=0.15, band=0.12),
)  # fmt: skip
