"""The config of `replay`."""

from dataclasses import dataclass
from typing import Any

from conf.schema import part, setting
from envs.bench import Bench
from envs.identification.calibration import IdentifyConfig
from experiments.laws import registry
from experiments.laws.density.learned import LearnedConfig
from experiments.recordings.config import Source
from hardware.safety.config import SafetyConfig

__all__ = ["ReplayConfig"]


@dataclass(frozen=True)
class ReplayConfig(Source):
    """A recording, and the controller, the estimator and the interlock that go through it."""

    controller: Any = part(LearnedConfig, "what decides the pump rate", registry.config_at)
    policy: str = setting("shipped", "of controller=dqn: `shipped`, a policy.npz, a run folder, or `latest`")
    setpoint: float | None = setting(
        None, "OD that is asked for; null: the median at which the device dosed", "OD", within=(0.02, 1.5)
    )
    env_file: str | None = setting(None, "a calibrated.yaml, or `latest`, whose growth model the controller is given")
    bench: Bench = part(Bench, "volume of the vial and largest feed rate; the period is that of the readings")
    safety: SafetyConfig = part(SafetyConfig, "limits of the interlock")
    identify: IdentifyConfig = part(IdentifyConfig, "how the recording's twin is found, on which the loop is closed")
