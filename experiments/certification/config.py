"""Settings of a certificate: assumptions of the proof, and limits."""

from dataclasses import dataclass
from typing import Any

from conf.schema import check, part, require, setting
from envs.bench import Bench
from envs.task import EnvConfig

ASKED = ("uncertainty", "noise", "error", "error_od", "error_share", "error_gain")  # larger values are stricter


@dataclass(frozen=True)
class Limits:
    """Limits of the requirements; docs/certificate.md has values of good and bad policies.

    Limits whose names begin with `safe_` are safety limits: a device refuses a policy that exceeds such a limit. The
    others are performance limits: a device reports that a policy exceeds them, and runs it. Limits of the half-width
    are limits of the part beyond the one-line controller's.

    excess, excess_uncertain: half-width, OD: nominal model without noise; with noise and uncertainty.
    excess_nominal, excess_share: half-width of a policy of (error, growth share), periods of full pump: exact
    estimates; with errors.
    entry: time to enter the allowed half-width, over that of a pump at full rate or off. late, late_slow: delay of the
    entry after the one-line controller's, periods; with a lasting error of the gain.
    low_dose: largest distance below the setpoint at which half of the largest dose is still given, periods of growth.
    reached, reached_nominal: fraction of a band that trajectories must reach: with errors; with exact estimates.
    safe_excess_median: median over the setpoints, OD; detects a policy for another pump.
    watched_od, watched_share: largest errors of the estimates of OD and growth share at which the supervisor lets the
    policy act.
    """

    excess: float = 0.012
    excess_uncertain: float = 0.025
    excess_nominal: float = 0.005
    excess_share: float = 1 / 64
    entry: float = 1.15
    late: float = 1.0
    late_slow: float = 4.0
    low_dose: float = 1.0
    reached: float = 0.95
    reached_nominal: float = 0.9
    safe_excess: float = 0.05
    safe_excess_median: float = 0.01
    safe_excess_uncertain: float = 0.2
    safe_excess_share: float = 0.025
    safe_low_dose: float = 2.0
    watched_od: float = 0.04
    watched_share: float = 0.5


LIMITS = Limits()


@dataclass(frozen=True)
class CertifyConfig:
    """Settings of `python -m experiments.certify`. Raises: ValueError with key, value and allowed range."""

    policy: str = setting("latest", "a policy.npz, a run folder, or `latest`: the newest run of train or demo")
    to: str | None = setting(
        None,
        "folder for a second copy of the certificate; null: that of the policy, unless it is part of the program",
    )
    estimator: dict[str, Any] = setting(
        {}, "policy in relative coordinates: replaces estimator settings of its file, as in deploy's controller"
    )
    bench: Bench = part(Bench, "device: B = max_rate period / tau with tau = volume / 60")
    env: EnvConfig | None = setting(
        None, "nominal model (mu and tau); null: the model of the policy's training, or of the bench"
    )
    env_file: str | None = setting(None, "a calibrated.yaml, or `latest`: the newest calibration; replaces env")
    uncertainty: float = setting(
        0.3, "mu and tau change in every period, within +- this fraction of the nominal values", within=(0, 0.9)
    )
    noise: float = setting(
        0.0108, "largest error of a reading: three times the measured sd of 0.0036", "OD", within=(0, 0.2)
    )
    start_od: tuple[float, float] = setting(
        (0.05, 1.5), "ODs from which the band must be entered", "OD", above=0.0, at_most=10.0, interval=True
    )
    setpoints: tuple[float, float] | None = setting(
        None, "range of setpoints; null: the range of the training", "OD", above=0.0, at_most=4.0, interval=True
    )
    growth_shares: tuple[float, float] = setting(
        (0.05, 0.97), "range of mu h / B, for a policy of (error, growth share)", within=(0, 1), interval=True
    )
    error: float = setting(0.1, "largest error of the estimate of e = ln(x / r) / B", within=(0, 5))
    error_od: float = setting(0.005, "largest error of the OD estimate; above `error` at low OD", "OD", within=(0, 0.2))
    error_share: float = setting(0.05, "largest error of the estimate of the growth share", within=(0, 0.5))
    error_gain: float = setting(
        0.2, "relative error of a dose's effect: random for each dose, or lasting", within=(0, 0.5)
    )
    full_pumps: tuple[float, ...] = setting(
        (0.01, 0.03, 0.06, 0.12, 0.3),
        "values of B, besides that of the bench, for a policy of (error, growth share)",
        within=(1e-3, 2),
    )
    quick: bool = setting(False, "omit errors of the gain and full_pumps; a device refuses such a certificate")
    trajectories: int = setting(
        20_000,
        "simulated worst-case trajectories per case, which try to leave the band",
        within=(0, 10_000_000),
    )

    def laxer(self) -> list[str]:
        """List the values that make the proof of safety less strict than the defaults."""
        usual = CertifyConfig()
        named = [(n, own, by) for n in ASKED if (own := getattr(self, n)) < (by := getattr(usual, n))]
        for name in ("start_od", "growth_shares"):
            own, by = getattr(self, name), getattr(usual, name)
            named += [(name, list(own), list(by))] if own[0] > by[0] or own[1] < by[1] else []
        return [f"{name} = {own}, default {by}" for name, own, by in named]

    def __post_init__(self) -> None:
        check(self)
        for name in ("start_od", "setpoints", "growth_shares"):
            pair = getattr(self, name)
            require(pair is None or pair[0] < pair[1], name, pair, "[low, high] with low < high")
