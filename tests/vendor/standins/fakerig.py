"""The stand-ins of the Chi.Bio's electronics, extended; the vendor's app imports this file in their place.

It loads the stand-ins' own fakerig.py (CHIBIO_STANDINS), changes what a bench needs and takes its name. Read from the
environment: CHIBIO_T0, the monotonic second at which device time began, so that one clock goes on over restarts;
CHIBIO_VIALS, what differs from vial to vial; CHIBIO_UNIT, added to every identity.

In CHIBIO_RUN: pumps.log, every change of a motor, as the stand-ins write it; truth.jsonl, all vials every five device
seconds; vials.json, their state at the last change of a motor or poll; alive, the device second at which the
supervising pin was last toggled; control.json, what to change, taken at once: {"M0": {"x": 0.45, "internal_zero": 1}}.

A process that is killed leaves its vials. The next one takes them over: motors and heater went off one second after
the pin's last pulse, growth and cooling went on.
"""

import importlib.util
import json
import math
import mmap
import os
import struct
import sys
import threading
import time

RUN, ACCEL = os.environ["CHIBIO_RUN"], float(os.environ["CHIBIO_ACCEL"])
T0 = float(os.environ["CHIBIO_T0"])
UNIT = int(os.environ.get("CHIBIO_UNIT", "0"))
POLL_S = 0.03  # real seconds between two looks at control.json
ROW_S = 5.0  # device seconds between two rows of truth.jsonl
LATCH_S = 1.0  # after the last pulse of the supervising pin power is cut
SPILL_ML = 30.0  # a vial holds no more
AIR = 25.0  # degC


def now() -> float:
    """Device seconds since the bench began."""
    return (time.monotonic() - T0) * ACCEL


time.sim_now = now  # type: ignore[attr-defined]
spec = importlib.util.spec_from_file_location("fakerig", os.path.join(os.environ["CHIBIO_STANDINS"], "fakerig.py"))
assert spec is not None
assert spec.loader is not None
rig = importlib.util.module_from_spec(spec)
sys.modules["fakerig"] = rig
spec.loader.exec_module(rig)

with open(os.path.join(RUN, "alive"), "a+b") as file:
    if os.fstat(file.fileno()).st_size == 0:
        file.write(struct.pack("d", now()))
        file.flush()
    heart = mmap.mmap(file.fileno(), 8)
DIED = struct.unpack("d", heart[:8])[0]
STATE = ("x", "V", "T", "vin", "vout", "spilled", "peak", "on", "mu", "feed", "waste")


def step(vial, powered=True):
    """Bring a vial up to date, second by second: growth 1/min, flows mL/s, heat."""
    dt, vial.t = now() - vial.t, now()
    advance(vial, dt, powered)


def advance(vial, seconds, powered=True):
    motors = [vial.pump(k) if powered else 0.0 for k in range(4)]
    heat = vial.duty(vial.pwm, 0x3E) if powered else 0.0
    feed, waste = vial.feed * max(motors[0], 0.0), vial.waste * max(motors[1], 0.0)
    while seconds > 0.0:
        h = min(seconds, 1.0)
        seconds -= h
        vial.on = [total + abs(motor) * h for total, motor in zip(vial.on, motors, strict=True)]
        vial.x *= math.exp((vial.mu / 60.0 - feed / vial.V) * h)
        vial.V += feed * h
        vial.vin += feed * h
        taken = min(waste * h, max(vial.V - rig.VOL, 0.0))
        spilled = max(vial.V - taken - SPILL_ML, 0.0)
        vial.V -= taken + spilled
        vial.vout += taken
        vial.spilled += spilled
        vial.peak = max(vial.peak, vial.V)
        vial.T += h * (0.0012 * (AIR - vial.T) + 0.035 * heat)


def measure(vial):
    """A spectrometer's exposure: pyoverdine glows under LEDA; `dark` counts nothing, `glitch` fails the reading."""
    rig.LEDPD["LEDA"]["nm440"] = 0.05 * vial.x
    plain_measure(vial)
    if vial.fault.get("dark"):
        vial.adc = [0] * 6


def write8(address, register, value):
    if address == 0x39 and register == 0x80 and value == 0x0B:
        vial = rig.cur(address)
        vial.failing = vial.fault.get("glitch", 0) > 0
        vial.fault["glitch"] = max(vial.fault.get("glitch", 0) - 1, 0)
    plain_write8(address, register, value)


def read_u8(address, register):
    if address == 0x39 and 0x95 <= register <= 0xA0 and rig.cur(address).failing:
        raise OSError("stand-in: the spectrometer does not answer")
    return plain_read_u8(address, register)


def read_u16(address, register):
    """`internal_zero`: so many of the next readings of the internal thermometer are an empty register."""
    if address == 0x18:
        vial = rig.cur(address)
        if vial.fault.get("internal_zero", 0) > 0:
            vial.fault["internal_zero"] -= 1
            return 0
    return plain_read_u16(address, register)


def gpio(pin, value):
    if pin == "P8_11" and value:
        heart[:8] = struct.pack("d", now())


class Log:
    """pumps.log: every change of a motor, and with it the state of the vials on the disk."""

    def __init__(self, plain):
        self.plain = plain

    def write(self, line):
        self.plain.write(line)
        save()


def save():
    state = {
        m: {"t": vial.t, "pump": [vial.pump(k) for k in range(4)], "stir": vial.duty(vial.pwm, 6)}
        | {"heat": vial.duty(vial.pwm, 0x3E), "laser": vial.dac}
        | {name: getattr(vial, name) for name in STATE}
        for m, vial in rig.R.items()
    }
    text, path = json.dumps(state), os.path.join(RUN, "vials.json")
    with open(path + ".new", "w") as file:
        file.write(text)
    os.replace(path + ".new", path)
    return text


def take_over(vial, was):
    """What the vial did since the last process: powered up to the latch, then by itself."""
    for name in STATE:
        setattr(vial, name, was[name])
    cut = min(DIED + LATCH_S, now())
    for k, duty in enumerate(was["pump"]):
        base = 0x06 + 8 * k if duty >= 0 else 0x0A + 8 * k
        vial.pmp[base + 2], vial.pmp[base + 3] = int(abs(duty) * 4095) & 255, int(abs(duty) * 4095) >> 8
        if duty:
            rig.plog.write(f"{cut:.2f} {vial.m} Pump{k + 1} 0.000\n")
    vial.pwm[0x40], vial.pwm[0x41] = int(was["heat"] * 4095) & 255, int(was["heat"] * 4095) >> 8
    advance(vial, max(cut - was["t"], 0.0))
    vial.pmp, vial.pwm = [0] * 256, [0] * 256
    vial.t = max(cut, was["t"])
    step(vial)


def poll():
    """Take control.json as soon as it is there; write truth.jsonl."""
    control, written = os.path.join(RUN, "control.json"), -ROW_S
    while True:
        with rig.L:
            for vial in rig.R.values():
                step(vial)
            text = save()
            if os.path.exists(control):
                with open(control) as file:
                    wanted = json.load(file)
                for m, changes in wanted.items():
                    for key, value in changes.items():
                        if key in STATE:
                            setattr(rig.R[m], key, value)
                        else:
                            rig.R[m].fault[key] = value
                save()
                os.remove(control)
            if now() - written >= ROW_S:
                written = now()
                with open(os.path.join(RUN, "truth.jsonl"), "a") as file:
                    file.write(text + "\n")
        time.real_sleep(POLL_S)


plain_measure, plain_write8 = rig.Reactor.measure, rig.write8
plain_read_u8, plain_read_u16, plain_read_word = rig.readU8, rig.readU16, rig.read_word
rig.Reactor.step, rig.Reactor.measure = step, measure
rig.write8, rig.readU8, rig.readU16, rig.gpio = write8, read_u8, read_u16, gpio
rig.read_word = lambda address, register: plain_read_word(address, register) + (UNIT if register >= 0x3C else 0)
rig.tick = lambda: None
given = json.loads(os.environ.get("CHIBIO_VIALS", "{}"))
for name, vial in rig.R.items():
    vial.t, vial.T, vial.failing, vial.spilled, vial.peak = now(), 37.0, False, 0.0, rig.VOL
    vial.mu, vial.feed, vial.waste = rig.MU, rig.QFULL, rig.QFULL
    for key, value in given.get(name, {}).items():
        setattr(vial, key, value)
if os.path.exists(os.path.join(RUN, "vials.json")):
    with open(os.path.join(RUN, "vials.json")) as file:
        before = json.load(file)
    for name, vial in rig.R.items():
        take_over(vial, before[name])
rig.plog = Log(rig.plog)
threading.Thread(target=poll, daemon=True).start()
