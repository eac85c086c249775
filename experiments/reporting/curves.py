"""What the curves in TensorBoard are called, what they mean, and how they are laid out on its custom page.

docs/tensorboard.md explains the same tags to whoever looks at them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = [
    "BAND", "CURVES", "DEPLOYMENT", "ERROR_UNITS", "METRICS", "PARAMETERS", "PICTURES", "POPULATION", "SHARES",
    "TRAINING", "Chart", "Column", "Curve", "described", "of_population",
]  # fmt: skip

ERROR_UNITS = {"density": "OD", "relative": "periods of full pump", "coculture": "of the share"}
"""Task -> unit of its steady error."""
BAND = 0.05  # of the setpoint: the band in which a culture counts as settled
POPULATION = {"iqm": "mean of the middle half of the agents", "min": "lowest agent", "max": "highest agent"}


@dataclass(frozen=True)
class Curve:
    """Unit and meaning of a tag; "" is the unit of a number without one."""

    unit: str
    what: str

    @property
    def text(self) -> str:
        """As TensorBoard shows it."""
        return f"{self.what}. Unit: {self.unit or 'none'}."


CURVES = {
    # training, over environment steps
    "train/return": Curve("OD² for env=sim", "reward of the episode that ended, minus its cost; the agent explores"),
    "train/loss": Curve("squared TD error", "loss of the updates since the last point"),
    "train/epsilon": Curve("", "share of actions taken at random"),
    "q/min": Curve("reward", "lowest Q value of a minibatch"),
    "q/max": Curve("reward", "highest Q value of a minibatch; no return is above 0"),
    "eval/regret_pct": Curve("%", "cost of the greedy policy beyond the optimum's, selection grid"),
    "eval/steady_abs_error": Curve("OD for env=sim", "error at rest at the worst setpoint, selection grid"),
    "kept/regret_pct": Curve("%", "regret of the policy that is kept, selection grid"),
    "kept/steady_abs_error": Curve("OD for env=sim", "error at rest of the policy that is kept, selection grid"),
    "limit/regret_pct": Curve("%", "regret that training aims for"),
    "limit/steady_abs_error": Curve("OD for env=sim", "error at rest that training aims for"),
    "speed/steps_per_s": Curve("1/s", "environment steps of all agents together"),
    # a deployment, over minutes of the run
    "culture/od": Curve("OD", "optical density as measured"),
    "culture/setpoint": Curve("OD", "density asked for"),
    "culture/setpoint_low": Curve("OD", "5 % below the setpoint"),
    "culture/setpoint_high": Curve("OD", "5 % above the setpoint"),
    "culture/temperature_degc": Curve("°C", "of the vial"),
    "culture/temperature_target_degc": Curve("°C", "the thermostat's target"),
    "pump/rate_ml_s": Curve("mL/s", "mean feed rate of the coming period, after the interlock"),
    "safety/interlock": Curve("", "1 where the interlock or a warning spoke"),
    "share/estimate": Curve("", "share of the second species as estimated"),
    "share/low": Curve("", "lower end of the estimate's 95 % band"),
    "share/high": Curve("", "upper end of the estimate's 95 % band"),
    "share/setpoint": Curve("", "share asked for"),
    "share/true": Curve("", "share in truth, which only a simulation knows"),
    "share/fluorescence": Curve("counts", "fluorescence as measured"),
    "controller/q_best": Curve("reward", "Q value of the chosen pump rate"),
    "controller/q_lead": Curve("reward", "its lead over the second best"),
    "controller/error": Curve("periods of full pump", "error that the policy saw"),
    "controller/growth_share": Curve("", "share of the pump that growth takes, as the policy saw it"),
    "controller/supervised": Curve("", "1 where the supervisor's law acts in place of the policy"),
    "controller/alarm": Curve("", "1 where it does because readings do not fit what the estimator believes"),
    "controller/error_sd": Curve("periods of full pump", "standard deviation of the error that the policy saw"),
    "controller/growth_share_sd": Curve("", "standard deviation of the growth share that it saw"),
    "controller/true_error": Curve("periods of full pump", "the error in truth, in a simulation"),
    "controller/true_growth_share": Curve("", "the growth share in truth, in a simulation"),
    "controller/od_estimate": Curve("OD", "density as the controller believes it"),
    "controller/mu": Curve("1/min", "growth rate as the controller believes it"),
    "controller/gain": Curve("", "pump gain as the controller believes it, 1 = the model's"),
    "controller/noise": Curve("", "scatter of the readings over the assumed one"),
    "controller/p": Curve("mL/s; 1/min for pi_tuned", "proportional part of a PI"),
    "controller/i": Curve("1/min", "integral part of pi_tuned"),
    "controller/i1": Curve("mL/s", "first integral part of the device's PI"),
    "controller/i2": Curve("mL/s", "second integral part of the device's PI"),
    "controller/bias_e": Curve("", "relative error of the first species' growth curve, as estimated"),
    "controller/bias_p": Curve("", "relative error of the second species' growth curve, as estimated"),
    "controller/bias_e_sd": Curve("", "how unsure the first of these errors is, sd"),
    "controller/bias_p_sd": Curve("", "how unsure the second of these errors is, sd"),
    "controller/thermometer_error": Curve("degC", "true less measured temperature, as estimated"),
    "controller/dose_spread": Curve("", "sd of a dose over its size, as estimated, at least as configured"),
    "controller/dose_gain": Curve("", "dose over the dose that was asked for, as estimated"),
    "controller/composition_od": Curve("OD", "density as the estimate of the share believes it"),
    "controller/pigment": Curve("counts", "fluorescence of the pigment as estimated"),
    # at the end
    "result/regret_pct": Curve("%", "cost beyond the optimum's on the reported grid"),
    "result/steady_abs_error": Curve("OD for env=sim", "error at rest at the worst setpoint"),
    "result/ise": Curve("OD² min", "integral of the squared error over the schedule"),
    "result/share_abs_error": Curve("", "mean error of the share, where one was asked for"),
    "result/medium_ml": Curve("mL", "fresh medium used by all reactors"),
}
PICTURES = {
    "figures/learning": "cost per episode; regret of the greedy policy",
    "figures/policy_map": "pump rate over OD and setpoint, learned and optimal",
    "figures/trajectories": "closed loops of the learned policy beside the optimum's",
    "figures/closed_loop": "OD over setpoint, pump rate, temperature of a deployment",
    "figures/composition": "share, temperature, OD and fluorescence of a deployment",
    "figures/certificate": "what is proven of the closed loop",
}


def described(tag: str) -> str:
    """Describe a tag for TensorBoard; statistics of a population say which."""
    base, _, end = tag.rpartition("/")
    if base in CURVES and end in POPULATION:
        return f"{CURVES[base].text} {POPULATION[end].capitalize()}."
    return CURVES[tag].text if tag in CURVES else PICTURES.get(tag, "")


@dataclass(frozen=True)
class Chart:
    """A chart of the custom page: tags as lines, or triples (middle, low, high), each a line with its band."""

    lines: Sequence[str] = ()
    bands: Sequence[tuple[str, str, str]] = ()


def _line(tag: str) -> tuple[str, str, str]:
    return (tag, tag, tag)


TRAINING: Mapping[str, Mapping[str, Chart]] = {
    "Learning": {
        "Regret of the greedy policy, its limit, %": Chart(["eval/regret_pct", "limit/regret_pct"]),
        "Error at rest at the worst setpoint, its limit": Chart(["eval/steady_abs_error", "limit/steady_abs_error"]),
        "Loss": Chart(["train/loss"]),
        "Q values": Chart(["q/min", "q/max"]),
        "Exploration, share of random actions": Chart(["train/epsilon"]),
        "Reward per episode": Chart(["train/return"]),
    }
}


def of_population(pages: Mapping[str, Mapping[str, Chart]]) -> Mapping[str, Mapping[str, Chart]]:
    """Build the same charts for several agents: mean of the middle half, with the range of all as its band."""

    def band(tag: str) -> tuple[str, str, str]:
        one = tag.startswith("limit/") or tag == "train/epsilon"
        return _line(tag) if one else (f"{tag}/iqm", f"{tag}/min", f"{tag}/max")

    return {  # TensorBoard shows charts with bands in reverse
        f"{page}, several agents": {t: Chart(bands=[band(x) for x in charts[t].lines]) for t in reversed(list(charts))}
        for page, charts in pages.items()
    }


DEPLOYMENT: Mapping[str, Mapping[str, Chart]] = {
    "Density": {
        "OD and setpoint with its band of 5 %": Chart(
            bands=[("culture/setpoint", "culture/setpoint_low", "culture/setpoint_high"), _line("culture/od")]
        ),
    },
    "Pump, heat, interlock": {
        "Pump rate, mL/s": Chart(["pump/rate_ml_s"]),
        "Temperature, °C": Chart(["culture/temperature_degc", "culture/temperature_target_degc"]),
        "Interlock and warnings": Chart(["safety/interlock", "controller/supervised"]),
    },
}
SHARES: Mapping[str, Mapping[str, Chart]] = {
    "Two species": {
        "Share of the second species with its 95 % band": Chart(
            bands=[("share/estimate", "share/low", "share/high"), _line("share/setpoint")]
        ),
        "Fluorescence, counts": Chart(["share/fluorescence"]),
    }
}


@dataclass(frozen=True)
class Column:
    """A column of the HPARAMS table."""

    title: str
    what: str
    number: bool = False


PARAMETERS = {
    "decides": Column("agent or controller", "preset of hyper-parameters, or what decided the pump rate"),
    "on": Column("model or plant", "what was learned on, or controlled"),
    "seed": Column("seed", "of the agent, or of the simulated vials", number=True),
    "mu": Column("mu, 1/min", "growth rate of the model or plant", number=True),
    "tau": Column("tau", "volume over 60 times the flow of the pump", number=True),
    "command": Column("command", "train or deploy"),
    "scenario": Column("scenario", "what a deployment was asked for"),
    "steps": Column("steps", "of training", number=True),
    "given": Column("given", "keys and values of the command line; a run whose columns are shown may lack some"),
}
"""The same columns for every command: TensorBoard reads them from one run and shows all runs under them, the first five
unasked.
"""

METRICS = {
    "result/regret_pct": "regret, %",
    "result/steady_abs_error": "worst-setpoint error, OD",
    "result/ise": "ISE, OD² min",
    "result/share_abs_error": "error of the share",
}
