"""Settings of a certificate: assumptions of the proof, and limits."""

from dataclasses import dataclass, fields
from typing import Any

from conf.schema import check, part, require, setting
from envs.bench import Bench
from envs.task import EnvConfig

ASKED = ("uncertainty", "noise", "error", "error_od", "error_share", "error_gain")  # larger values are stricter


@dataclass(frozen=True)
class Limits:
    """Limits of the requirements; docs/certificate.md has values of good and bad policies.

    Limits whose names begin with `safe_` are safety limits: a device refuses a policy that exceeds such a limit. The
    others are performance limits: a device reports that a policy exceeds them, and runs it.

    Raises: ValueError with key, value and allowed range.
    """

    excess: float = setting(
        0.012,
        "half-width of the band beyond that of the one-line controller, without noise, nominal model",
        "OD",
        within=(0, 1),
    )
    excess_uncertain: float = setting(0.025, "`excess` with noise and uncertainty", "OD", within=(0, 1))
    entry: float = setting(
        1.15,
        "time to enter the allowed half-width, over that of a pump at full rate or off",
        within=(1, 100),
    )
    low_dose: float = setting(
        1.0,
        "largest distance below the setpoint at which half of the largest dose is still given",
        "periods of growth",
        within=(0, 100),
    )
    excess_nominal: float = setting(
        0.005,
        "policy of (error, growth share), exact estimates: half-width beyond the one-line controller's",
        "periods of full pump",
        within=(0, 10),
    )
    excess_share: float = setting(
        1 / 64, "`excess_nominal` with errors, in every case", "periods of full pump", within=(0, 10)
    )
    late: float = setting(1, "delay of the entry after the one-line controller's", "periods", within=(0, 1000))
    late_slow: float = setting(4, "`late` with a lasting error of the gain", "periods", within=(0, 1000))
    reached: float = setting(0.95, "fraction of a band that trajectories must reach, with errors", within=(0, 1))
    reached_nominal: float = setting(0.9, "`reached` with exact estimates", within=(0, 1))
    safe_excess: float = setting(
        0.05, "safety: half-width beyond the one-line controller's, without noise, nominal model", "OD", within=(0, 1)
    )
    safe_excess_median: float = setting(
        0.01,
        "safety: median of `safe_excess` over the setpoints; detects a policy for another pump",
        "OD",
        within=(0, 1),
    )
    safe_excess_uncertain: float = setting(0.2, "safety: `safe_excess` with noise and uncertainty", "OD", within=(0, 1))
    safe_excess_share: float = setting(
        0.025,
        "safety, policy of (error, growth share), in every case: half-width beyond the one-line controller's",
        "periods of full pump",
        within=(0, 10),
    )
    safe_low_dose: float = setting(
        2.0,
        "safety: largest distance below the setpoint at which half of the largest dose is still given",
        "periods of growth",
        within=(0, 100),
    )

    def __post_init__(self) -> None:
        check(self, "limits")


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
    strip: float = setting(0.005, "width of the strips of setpoints, or growth shares", within=(1e-4, 0.1))
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
    watched_od: float = setting(
        0.04, "largest error of the OD estimate at which the supervisor lets the policy act", "OD", within=(0, 0.2)
    )
    watched_share: float = setting(0.5, "like `watched_od`, for the growth share", within=(0, 0.5))
    trajectories: int = setting(
        20_000,
        "simulated worst-case trajectories per case, which try to leave the band",
        within=(0, 10_000_000),
    )
    limits: Limits = part(Limits, "limits of the requirements")

    def laxer(self) -> list[str]:
        """List the values that make the proof of safety less strict than the defaults."""
        usual = CertifyConfig()
        named = [(n, own, by) for n in ASKED if (own := getattr(self, n)) < (by := getattr(usual, n))]
        named += [("strip", self.strip, usual.strip)] if self.strip > usual.strip else []
        for name in ("start_od", "growth_shares"):
            own, by = getattr(self, name), getattr(usual, name)
            named += [(name, list(own), list(by))] if own[0] > by[0] or own[1] < by[1] else []
        return [f"{name} = {own}, default {by}" for name, own, by in named] + self.laxer_limits(safety=True)

    def laxer_limits(self, safety: bool) -> list[str]:
        """List the limits of one kind that are less strict than the defaults; `reached*` are lower limits."""
        found = []
        for name in (f.name for f in fields(Limits) if f.name.startswith("safe_") is safety):
            own, by = getattr(self.limits, name), getattr(Limits(), name)
            if own < by if name.startswith("reached") else own > by:
                found.append(f"limits.{name} = {own}, default {by}")
        return found

    def __post_init__(self) -> None:
        check(self)
        for name in ("start_od", "setpoints", "growth_shares"):
            pair = getattr(self, name)
            require(pair is None or pair[0] < pair[1], name, pair, "[low, high] with low < high")
