"""Config of a certificate: what to prove."""

from dataclasses import dataclass, fields
from typing import Any

from conf.schema import check, part, require, setting
from envs.bench import Bench
from envs.task import EnvConfig

ASKED = ("uncertainty", "noise", "error", "error_od", "error_share", "error_gain")  # larger values are stricter


@dataclass(frozen=True)
class Limits:
    """Largest values that a certificate allows; docs/certificate.md has values of good and bad policies.

    Limits whose names begin with `safe_` are limits of safety: a device refuses a policy that exceeds one. All others
    are limits of performance: a device reports them and runs the policy.

    Raises: ValueError naming key, value and allowed range.
    """

    excess: float = setting(
        0.012,
        "half-width of the band beyond that of the one-line controller, without noise, nominal model",
        "OD",
        within=(0, 1),
    )
    excess_uncertain: float = setting(0.025, "the same under noise and uncertainty", "OD", within=(0, 1))
    entry: float = setting(
        1.15,
        "time into the allowed half-width, relative to a pump at full rate or at rest",
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
        "policy of (error, growth share): half-width beyond the one-line controller's, exact estimates",
        "periods of full pump",
        within=(0, 10),
    )
    excess_share: float = setting(1 / 64, "the same with errors, in every case", "periods of full pump", within=(0, 10))
    late: float = setting(1, "its entry after that of the one-line controller", "periods", within=(0, 1000))
    late_slow: float = setting(4, "the same with a slow error of the gain", "periods", within=(0, 1000))
    reached: float = setting(0.95, "smallest fraction of a band that the attack reaches, with errors", within=(0, 1))
    reached_nominal: float = setting(0.9, "the same, exact estimates", within=(0, 1))
    safe_excess: float = setting(
        0.05, "safety: half-width beyond the one-line controller's, without noise, nominal model", "OD", within=(0, 1)
    )
    safe_excess_median: float = setting(
        0.01,
        "safety: median of that over the setpoints; finds a policy of another pump",
        "OD",
        within=(0, 1),
    )
    safe_excess_uncertain: float = setting(
        0.2, "safety: the same as safe_excess under noise and uncertainty", "OD", within=(0, 1)
    )
    safe_excess_share: float = setting(
        0.025,
        "safety, policy of (error, growth share): half-width beyond the one-line controller's in every case",
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
    """`python -m experiments.certify`. Raises: ValueError naming key, value and allowed range."""

    policy: str = setting("latest", "a policy.npz, a run folder, or `latest`: the newest one of train or demo")
    to: str | None = setting(
        None,
        "second place for the certificate, beside the run folder; null: beside the policy, never inside the program",
    )
    estimator: dict[str, Any] = setting(
        {}, "policy in relative coordinates: replaces settings of its file, as in deploy's controller"
    )
    bench: Bench = part(Bench, "device: full pump is max_rate period / tau with tau = volume / 60")
    env: EnvConfig | None = setting(
        None, "nominal model (mu and tau); null: the one the policy was trained on, or the bench's"
    )
    env_file: str | None = setting(None, "a calibrated.yaml, or `latest`: the newest one of calibrate; replaces env")
    uncertainty: float = setting(
        0.3, "mu and tau vary within +- this fraction of their nominal values, anew in every period", within=(0, 0.9)
    )
    noise: float = setting(
        0.0108, "largest error of a reading; three times the measured sd of 0.0036", "OD", within=(0, 0.2)
    )
    start_od: tuple[float, float] = setting(
        (0.05, 1.5), "range of OD from which the band is entered", "OD", above=0.0, at_most=10.0, interval=True
    )
    setpoints: tuple[float, float] | None = setting(
        None, "range; null: from the lowest to the highest trained one", "OD", above=0.0, at_most=4.0, interval=True
    )
    strip: float = setting(0.005, "width of the strips of setpoints, or growth shares", within=(1e-4, 0.1))
    growth_shares: tuple[float, float] = setting(
        (0.05, 0.97), "range of mu h / B, for a policy of (error, growth share)", within=(0, 1), interval=True
    )
    error: float = setting(0.1, "largest error of the estimate of e = ln(x / r) / B", within=(0, 5))
    error_od: float = setting(0.005, "largest error of the OD estimate, if that is more", "OD", within=(0, 0.2))
    error_share: float = setting(0.05, "largest error of the estimate of the growth share", within=(0, 0.5))
    error_gain: float = setting(
        0.2, "relative error of a dose's effect: per dose, and of the gain for a long time", within=(0, 0.5)
    )
    full_pumps: tuple[float, ...] = setting(
        (0.01, 0.03, 0.06, 0.12, 0.3),
        "values of B that are proven beside the bench's, for a policy of (error, growth share)",
        within=(1e-3, 2),
    )
    quick: bool = setting(False, "omit errors of the gain and all B but the bench's; a device requires all")
    watched_od: float = setting(
        0.04, "error of the OD estimate up to which the supervisor lets a policy act", "OD", within=(0, 0.2)
    )
    watched_share: float = setting(0.5, "the same for the growth share", within=(0, 0.5))
    trajectories: int = setting(
        20_000,
        "adversarial trajectories per case, which try to leave the band or reach its ends",
        within=(0, 10_000_000),
    )
    limits: Limits = part(Limits, "limits of the requirements")

    def laxer(self) -> list[str]:
        """Return every value that makes safety less strict than the default."""
        usual = CertifyConfig()
        named = [(n, own, by) for n in ASKED if (own := getattr(self, n)) < (by := getattr(usual, n))]
        named += [("strip", self.strip, usual.strip)] if self.strip > usual.strip else []
        for name in ("start_od", "growth_shares"):
            own, by = getattr(self, name), getattr(usual, name)
            named += [(name, list(own), list(by))] if own[0] > by[0] or own[1] < by[1] else []
        return [f"{name} = {own}, by itself {by}" for name, own, by in named] + self.laxer_limits(safety=True)

    def laxer_limits(self, safety: bool) -> list[str]:
        """Return the limits of one kind that are less strict than the default. Only `reached` are lower limits."""
        found = []
        for name in (f.name for f in fields(Limits) if f.name.startswith("safe_") is safety):
            own, by = getattr(self.limits, name), getattr(Limits(), name)
            if own < by if name.startswith("reached") else own > by:
                found.append(f"limits.{name} = {own}, by itself {by}")
        return found

    def __post_init__(self) -> None:
        check(self)
        for name in ("start_od", "setpoints", "growth_shares"):
            pair = getattr(self, name)
            require(pair is None or pair[0] < pair[1], name, pair, "[low, high] with low < high")
