"""Tags of TensorBoard's curves, their descriptions, and their layout on the custom page.

docs/tensorboard.md explains the same tags to users.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

ERROR_UNITS = {"density": "OD", "relative": "periods of full pump"}
"""Task -> unit of its steady error; a guest adds its own."""
BAND = 0.05  # largest error of a settled culture, as a fraction of the setpoint
POPULATION = {"iqm": "mean of the middle half of the agents", "min": "lowest agent", "max": "highest agent"}


@dataclass(frozen=True)
class Curve:
    """Description of a tag. unit: unit of its values, "" for none. what: meaning of its values."""

    unit: str
    what: str

    @property
    def text(self) -> str:
        """Text that TensorBoard shows."""
        return f"{self.what}. Unit: {self.unit or 'none'}."


CURVES = {
    # training, over environment steps
    "train/return": Curve("OD² for env=sim", "return of the last training episode, with exploration; minus its cost"),
    "train/loss": Curve("squared TD error", "mean loss of the updates since the last point"),
    "train/epsilon": Curve("", "fraction of random actions"),
    "q/min": Curve("reward", "lowest Q value of a minibatch"),
    "q/max": Curve("reward", "highest Q value of a minibatch; no return is above 0"),
    "eval/regret_pct": Curve("%", "regret of the greedy policy on the selection grid: its cost above the optimum's"),
    "eval/steady_abs_error": Curve("OD for env=sim", "steady error at the worst setpoint, on the selection grid"),
    "kept/regret_pct": Curve("%", "regret of the kept policy on the selection grid"),
    "kept/steady_abs_error": Curve("OD for env=sim", "steady error of the kept policy on the selection grid"),
    "limit/regret_pct": Curve("%", "regret that training aims for"),
    "limit/steady_abs_error": Curve("OD for env=sim", "steady error that training aims for"),
    "speed/steps_per_s": Curve("1/s", "environment steps of all agents together"),
    # a deployment, over minutes of the run
    "culture/od": Curve("OD", "optical density as measured"),
    "culture/setpoint": Curve("OD", "setpoint of the density"),
    "culture/setpoint_low": Curve("OD", "5 % below the setpoint"),
    "culture/setpoint_high": Curve("OD", "5 % above the setpoint"),
    "culture/temperature_degc": Curve("°C", "temperature of the vial"),
    "culture/temperature_target_degc": Curve("°C", "target of the thermostat"),
    "pump/rate_ml_s": Curve("mL/s", "mean feed rate of the coming period, after the interlock"),
    "safety/interlock": Curve("", "1 if the interlock raised an alarm or there was a warning"),
    "controller/q_best": Curve("reward", "Q value of the chosen pump rate"),
    "controller/q_lead": Curve("reward", "Q value of the chosen pump rate minus that of the second best"),
    "controller/error": Curve("periods of full pump", "estimated error, an input of the policy"),
    "controller/growth_share": Curve("", "estimated growth share, an input of the policy"),
    "controller/supervised": Curve("", "1 if the supervisor's controller acts in place of the policy"),
    "controller/alarm": Curve("", "1 if the supervisor acts because innovations do not fit the estimate"),
    "controller/noted": Curve("", "1 if readings are far noisier than the estimator expects"),
    "controller/error_sd": Curve("periods of full pump", "standard deviation of the estimated error"),
    "controller/growth_share_sd": Curve("", "standard deviation of the estimated growth share"),
    "controller/true_error": Curve("periods of full pump", "true error, in a simulation"),
    "controller/true_growth_share": Curve("", "true growth share, in a simulation"),
    "controller/od_estimate": Curve("OD", "estimated density"),
    "controller/mu": Curve("1/min", "estimated growth rate"),
    "controller/gain": Curve("", "estimated pump gain, 1 = the model's"),
    "controller/noise": Curve("", "scatter of the readings divided by the assumed scatter"),
    "controller/p": Curve("mL/s; 1/min for pi_tuned", "proportional part of a PI"),
    "controller/i": Curve("1/min", "integral part of pi_tuned"),
    "controller/i1": Curve("mL/s", "first integral part of the device's PI"),
    "controller/i2": Curve("mL/s", "second integral part of the device's PI"),
    # results, at the end of a run
    "result/regret_pct": Curve("%", "regret on the reported grid: cost above the optimum's"),
    "result/steady_abs_error": Curve("OD for env=sim", "steady error at the worst setpoint"),
    "result/ise": Curve("OD² min", "integral of the squared error over the schedule"),
    "result/medium_ml": Curve("mL", "fresh medium used by all reactors"),
}
PICTURES = {
    "figures/learning": "cost per episode; regret of the greedy policy",
    "figures/policy_map": "pump rate over OD and setpoint, learned and optimal",
    "figures/trajectories": "closed loops of the learned policy and of the optimum",
    "figures/closed_loop": "OD with its setpoint, pump rate and temperature of a deployment",
    "figures/certificate": "proven bounds on the closed loop",
}


def described(tag: str) -> str:
    """Return the description of a tag; for a tag of several agents it names the statistic."""
    base, _, end = tag.rpartition("/")
    if base in CURVES and end in POPULATION:
        return f"{CURVES[base].text} {POPULATION[end].capitalize()}."
    return CURVES[tag].text if tag in CURVES else PICTURES.get(tag, "")


@dataclass(frozen=True)
class Chart:
    """Chart of the custom page. lines: tags drawn as lines. bands: (middle, low, high), tags of a line and its band."""

    lines: Sequence[str] = ()
    bands: Sequence[tuple[str, str, str]] = ()


def line(tag: str) -> tuple[str, str, str]:
    """Return a band of width zero, which TensorBoard draws as a line."""
    return (tag, tag, tag)


TRAINING: Mapping[str, Mapping[str, Chart]] = {
    "Learning": {
        "Regret of the greedy policy, its limit, %": Chart(["eval/regret_pct", "limit/regret_pct"]),
        "Steady error at the worst setpoint, its limit": Chart(["eval/steady_abs_error", "limit/steady_abs_error"]),
        "Loss": Chart(["train/loss"]),
        "Q values": Chart(["q/min", "q/max"]),
        "Exploration, share of random actions": Chart(["train/epsilon"]),
        "Reward per episode": Chart(["train/return"]),
    }
}


def of_population(pages: Mapping[str, Mapping[str, Chart]]) -> Mapping[str, Mapping[str, Chart]]:
    """Build the charts of several agents: mean of the middle half as a line, range of all agents as its band."""

    def band(tag: str) -> tuple[str, str, str]:
        one = tag.startswith("limit/") or tag == "train/epsilon"
        return line(tag) if one else (f"{tag}/iqm", f"{tag}/min", f"{tag}/max")

    return {  # reversed, because TensorBoard shows charts with bands in reverse order
        f"{page}, several agents": {t: Chart(bands=[band(x) for x in charts[t].lines]) for t in reversed(list(charts))}
        for page, charts in pages.items()
    }


DEPLOYMENT: Mapping[str, Mapping[str, Chart]] = {
    "Density": {
        "OD and setpoint with its band of 5 %": Chart(
            bands=[("culture/setpoint", "culture/setpoint_low", "culture/setpoint_high"), line("culture/od")]
        ),
    },
    "Pump, heat, interlock": {
        "Pump rate, mL/s": Chart(["pump/rate_ml_s"]),
        "Temperature, °C": Chart(["culture/temperature_degc", "culture/temperature_target_degc"]),
        "Interlock and warnings": Chart(["safety/interlock", "controller/supervised"]),
    },
}
COLUMNS = {"aim": "culture/aim"}
"""Column that a signal adds to a recording -> its tag. A column that is not listed has the tag further/COLUMN."""
CALLED: dict[str, str] = {}
"""Column of a signal -> name of the signal in tags and tables, where it differs from the column."""
PAGES: dict[str, Mapping[str, Mapping[str, Chart]]] = {}
"""Column of a signal -> further pages of charts, beside those of `DEPLOYMENT`, for a run with that signal."""


def signals_in(windows: Sequence[Mapping[str, object]]) -> list[str]:
    """List the columns of all signals, other than density, that have a setpoint in any window of a summary."""
    ends = [key for window in windows for key in window if key.endswith("_setpoint")]
    return list(dict.fromkeys(key.removesuffix("_setpoint") for key in ends))


def error_tag(signal: str) -> str:
    """Return the tag of a signal's mean error over a run. Args: signal: the signal's column."""
    return f"result/{CALLED.get(signal, signal)}_abs_error"


@dataclass(frozen=True)
class Column:
    """Column of the HPARAMS table. what: its description. number: whether it holds numbers, not text."""

    title: str
    what: str
    number: bool = False


PARAMETERS = {
    "decides": Column("agent or controller", "preset of hyper-parameters, or controller"),
    "on": Column("model or plant", "model used in training, or controlled plant"),
    "seed": Column("seed", "seed of the agent, or of the simulated vials", number=True),
    "mu": Column("mu, 1/min", "growth rate of the model or plant", number=True),
    "tau": Column("tau", "volume over 60 times the flow of the pump", number=True),
    "command": Column("command", "train or deploy"),
    "scenario": Column("scenario", "schedule of a deployment"),
    "steps": Column("steps", "environment steps of training", number=True),
    "given": Column("given", "keys and values of the command line, also those that have no column in this table"),
}
"""All commands write these columns: TensorBoard takes the columns of all runs from one run and shows the first five."""

METRICS = {
    "result/regret_pct": "regret, %",
    "result/steady_abs_error": "worst-setpoint error, OD",
    "result/ise": "ISE, OD² min",
}


TABLES: tuple[dict[str, Any], ...] = (ERROR_UNITS, CURVES, COLUMNS, CALLED, PAGES, METRICS, PICTURES)


def add(
    units: Mapping[str, str],
    curves: Mapping[str, Curve],
    columns: Mapping[str, str],
    called: Mapping[str, str],
    pages: Mapping[str, Mapping[str, Mapping[str, Chart]]],
    metrics: Mapping[str, str],
    pictures: Mapping[str, str],
) -> None:
    """Register a guest's entries. Args: new entries of `ERROR_UNITS`, `CURVES`, `COLUMNS`, `CALLED`, `PAGES` etc."""
    for known, more in zip(TABLES, (units, curves, columns, called, pages, metrics, pictures), strict=True):
        known.update(more)
