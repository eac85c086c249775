"""Registration of everything that two species add to the core."""

from typing import Any

from conf import schema
from dqn import policy
from envs import scenario
from envs.coculture.task import CocultureConfig
from envs.scenario import Scenario
from experiments.coculture import laws
from experiments.coculture.base import SEEN, SEEN_AHEAD, SHARE
from experiments.coculture.config import OfBenchmark, OfDeploy, OfEmulator, OfStudy, OfTrain, completed
from experiments.coculture.program import Ratios, composed
from experiments.coculture.run import TwoSpecies
from experiments.comparison.config import BenchmarkConfig, StudyConfig
from experiments.control import guests
from experiments.control.config import DeployConfig
from experiments.laws import registry
from experiments.laws.registry import Part
from experiments.reporting import curves
from experiments.reporting.curves import Chart, Curve, line
from experiments.training import config as training
from experiments.training.config import TrainConfig
from hardware.family import family


def _task(config: CocultureConfig) -> Any:
    from experiments.coculture.task import Coculture  # imports PyTorch, which only a training needs

    return Coculture(config)


needs = "needs a policy; give policy=RUN/policy.npz of a training with env=coculture or env=coculture_preview"
plans = "needs the whole schedule of shares; give a scenario with ratios"
registry.hold(SHARE, "composition", {"policy": Part(missing=needs), "program": Part(missing=plans), "pair": Part()})
for kind, config, law, parts in (
    ("dqn", laws.LearnedLawConfig, laws.LearnedLaw, ("policy", "pair")),
    ("dqn_preview", laws.PreviewLawConfig, laws.LearnedLaw, ("policy", "pair")),
    ("pi", laws.PIConfig, laws.PI, ("pair",)),
    ("proportional", laws.ProportionalConfig, laws.Proportional, ("pair",)),
    ("inverse_dynamics", laws.InverseDynamicsConfig, laws.InverseDynamics, ("pair",)),
    ("bang_bang", laws.BangBangConfig, laws.BangBang, ("pair",)),
    ("myopic", laws.MyopicConfig, laws.Myopic, ("pair",)),
    ("midpoint", laws.MidpointConfig, laws.Midpoint, ("pair",)),
    ("receding", laws.RecedingConfig, laws.Receding, ("pair",)),
    ("optimum", laws.OptimumConfig, laws.Optimum, ("program", "pair")),
):
    registry.add(kind, config, law, "", parts, SHARE)
for observation in (SEEN, SEEN_AHEAD):
    policy.add(*observation)
training.add("coculture", CocultureConfig, _task, "", completed, ("pair",))
scenario.HEATED.append(composed)
for to, more in (
    (Scenario, Ratios),
    (DeployConfig, OfDeploy),
    (family("emulator").config, OfEmulator),
    (TrainConfig, OfTrain),
    (StudyConfig, OfStudy),
    (BenchmarkConfig, OfBenchmark),
):
    schema.add(to, more)
guests.add(TwoSpecies())
curves.add(
    units={"coculture": "of the share"},
    curves={
        "share/estimate": Curve("", "estimated share of the second species"),
        "share/low": Curve("", "lower end of the estimate's 95 % band"),
        "share/high": Curve("", "upper end of the estimate's 95 % band"),
        "share/setpoint": Curve("", "setpoint of the share"),
        "share/true": Curve("", "true share, in a simulation"),
        "share/fluorescence": Curve("counts", "measured fluorescence"),
        "controller/bias_e": Curve("", "estimated relative error of the first species' growth curve"),
        "controller/bias_p": Curve("", "estimated relative error of the second species' growth curve"),
        "controller/bias_e_sd": Curve("", "standard deviation of bias_e"),
        "controller/bias_p_sd": Curve("", "standard deviation of bias_p"),
        "controller/thermometer_error": Curve("degC", "estimated difference: true minus measured temperature"),
        "controller/dose_spread": Curve("", "estimated relative standard deviation of a dose, at least dose_cv"),
        "controller/dose_gain": Curve("", "estimated ratio of delivered to requested dose"),
        "controller/composition_od": Curve("OD", "density estimated by the composition's estimator"),
        "controller/pigment": Curve("counts", "estimated fluorescence of the pigment"),
        "result/share_abs_error": Curve("", "mean |share - setpoint| over all times with a setpoint"),
    },
    columns={
        "fluorescence": "share/fluorescence",
        "ratio_setpoint": "share/setpoint",
        "ratio": "share/estimate",
        "ratio_low": "share/low",
        "ratio_high": "share/high",
        "true_ratio": "share/true",
        "temperature_target_degc": "culture/temperature_target_degc",
    },
    called={"ratio": "share"},
    pages={
        "ratio": {
            "Two species": {
                "Share of the second species with its 95 % band": Chart(
                    bands=[("share/estimate", "share/low", "share/high"), line("share/setpoint")]
                ),
                "Fluorescence, counts": Chart(["share/fluorescence"]),
            }
        }
    },
    metrics={"result/share_abs_error": "error of the share"},
    pictures={"figures/composition": "share, temperature, OD and fluorescence of a deployment"},
)
