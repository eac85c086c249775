"""Figures of a replay."""

from matplotlib.figure import Figure

from experiments.laws.base import Array
from experiments.replays.replay import AHEAD, Replayed
from experiments.reporting.charts import COLOURS, new_figure, pump_end


def replay_figure(found: Replayed, title: str) -> Figure:
    """Draw OD with its predicted band, growth rate, pump flow with alarms, and the doses of device and controller."""
    figure, axes = new_figure(10.0, 9.0, 4, sharex=True, height_ratios=(2.2, 1.0, 1.0, 1.2))
    hours = found.minutes / 60.0
    axes[0].fill_between(hours, found.low, found.high, color=COLOURS[1], alpha=0.3, lw=0, label=f"{AHEAD} ahead, 95 %")
    axes[0].plot(hours, found.od, ".", ms=2.5, color=COLOURS[0], label="reading")
    axes[0].plot(hours[~found.believed], found.od[~found.believed], "x", ms=4, color=COLOURS[3], label="rejected")
    axes[0].axhline(found.setpoint, color="black", lw=0.8, ls="--", label=f"setpoint {found.setpoint:.3g}")
    axes[0].set(title=title, ylabel="OD", ylim=(0.0, 1.15 * float(found.od[found.believed].max(initial=0.1))))
    axes[1].plot(hours, found.mu, color=COLOURS[2], lw=1.2)
    axes[1].set(ylabel="growth rate,\n1/min", ylim=(0.0, None))
    axes[2].plot(hours, 100.0 * found.gain, color=COLOURS[2], lw=1.2, label="estimated flow")
    alarms = [k for k, reason in enumerate(found.reasons) if reason]
    axes[2].plot(hours[alarms], [100.0] * len(alarms), "|", ms=9, color=COLOURS[3], label="interlock alarm")
    axes[2].set(ylabel="pump, % of\nits setting", ylim=(0.0, None))
    for ml, name, colour in ((found.given_ml, "device", COLOURS[0]), (found.decided_ml, "controller", COLOURS[1])):
        axes[3].plot(hours[ml > 0.0], ml[ml > 0.0], ".", ms=3, color=colour, label=name)
    axes[3].set(ylabel="dose, mL", xlabel="time, h", ylim=(0.0, None))
    for ax in (axes[0], axes[2], axes[3]):
        ax.legend(loc="upper left", ncols=4)
    return figure


def twin_figure(minutes: Array, od: Array, rate: Array, setpoint: float, title: str) -> Figure:
    """Draw the controller in closed loop on the twin: true OD, (K,), and pump rate, mL/s, (K,)."""
    figure, (top, bottom) = new_figure(10.0, 4.6, 2, sharex=True, height_ratios=(2.0, 1.0))
    top.axhline(setpoint, color="black", lw=0.8, ls="--")
    top.plot(minutes / 60.0, od, color=COLOURS[0], lw=1.2)
    top.set(title=title, ylabel="OD")
    bottom.step(minutes / 60.0, 1000.0 * rate, where="post", color=COLOURS[1], lw=1.0)
    bottom.set(ylabel="pump rate, µL/s", xlabel="time, h", ylim=(-0.5, pump_end(rate)))
    return figure
