"""What a certificate is asked to prove."""

from dataclasses import dataclass

from conf.schema import check, part, require, setting
from envs.bench import Bench
from envs.task import EnvConfig

__all__ = ["CertifyConfig", "Limits"]


@dataclass(frozen=True)
class Limits:
    """What a policy has to keep to be certified; docs/certificate.md has the figures of policies that are good and bad.

    Raises: ValueError naming key, value and allowed range.
    """

    excess: float = setting(
        0.012,
        "half-width of the band over that of the one-line law, no noise and the nominal model",
        "OD",
        within=(0, 1),
    )
    excess_uncertain: float = setting(0.025, "the same under noise and uncertainty", "OD", within=(0, 1))
    entry: float = setting(1.15, "entry time over that of the pump at full or at rest", within=(1, 100))
    low_dose: float = setting(
        1.0,
        "how far below the setpoint half of the largest dose may still be given",
        "periods of growth",
        within=(0, 100),
    )
    half_width: float = setting(
        0.25, "of the band in e, of a policy that sees (error, growth share), for inner_shares", within=(0, 10)
    )
    half_width_outer: float = setting(0.45, "the same for all growth_shares", within=(0, 10))
    half_width_watched: float = setting(
        2.0, "the same with errors as large as the supervisor lets them grow, at the middle setpoint", within=(0, 10)
    )
    inner_shares: tuple[float, float] = setting((0.2, 0.8), "growth shares", within=(0, 1), interval=True)

    def __post_init__(self) -> None:
        check(self, "limits")


@dataclass(frozen=True)
class CertifyConfig:
    """`python -m experiments.certify`. Raises: ValueError naming key, value and allowed range."""

    policy: str = setting("latest", "a policy.npz, a run folder, or `latest`: what train or demo wrote last")
    bench: Bench = part(Bench, "where it is to run: full pump is max_rate period / tau with tau = volume / 60")
    env: EnvConfig | None = setting(
        None, "the nominal model: its mu and tau; null: the one the policy was trained on, or that of the bench"
    )
    env_file: str | None = setting(None, "a calibrated.yaml, or `latest`: what calibrate wrote last; replaces env")
    uncertainty: float = setting(
        0.3, "mu and tau are anywhere within +- this share of the nominal ones, in every period anew", within=(0, 0.9)
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
    strip: float = setting(0.005, "setpoints, or growth shares, that are proven together", within=(1e-4, 0.1))
    growth_shares: tuple[float, float] = setting(
        (0.05, 0.97), "range of mu h / B, of a policy that sees (error, growth share)", within=(0, 1), interval=True
    )
    error: float = setting(0.1, "largest error of the estimate of e = ln(x / r) / B", within=(0, 5))
    error_od: float = setting(0.005, "or of the OD estimate, where that is more", "OD", within=(0, 0.2))
    error_share: float = setting(0.05, "largest error of the estimate of the growth share", within=(0, 0.5))
    error_gain: float = setting(0.0, "relative error of a dose's effect", within=(0, 0.5))
    watched_od: float = setting(
        0.04, "error of the OD estimate up to which the supervisor lets a policy act", "OD", within=(0, 0.2)
    )
    watched_share: float = setting(0.5, "the same of the growth share", within=(0, 0.5))
    trajectories: int = setting(20_000, "adversarial ones that try to leave the band", within=(0, 10_000_000))
    limits: Limits = part(Limits, "what is required")

    def __post_init__(self) -> None:
        check(self)
        for name in ("start_od", "setpoints", "growth_shares"):
            pair = getattr(self, name)
            require(pair is None or pair[0] < pair[1], name, pair, "[low, high] with low < high")
