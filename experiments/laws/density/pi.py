"""PI control of OD: the Chi.Bio's on-board controller, and a PI tuned by a rule."""

from dataclasses import dataclass

import numpy as np

from conf.schema import setting
from envs.bench import Bench
from envs.task import MAX_PUMP_RATE, EnvConfig
from experiments.laws.base import Array, ControllerConfig, Mask, usable

ASSUMED_FLOW_ML_S = 4.0  # pump flow assumed by the device's controller; real pumps: about 1 (docs/biology.md, Pumps)
LOWEST_OD = 1e-6  # the device uses this for a setpoint of 0 or less


@dataclass(frozen=True)
class ChiBioPIConfig(ControllerConfig):
    """Settings of the device's controller; its gains are constants of the device's code."""

    kind: str = setting("pi", "controller")
    max_pump_rate: float = setting(
        MAX_PUMP_RATE, "largest pump rate, as on the device", "mL/s", above=0.0, at_most=0.05
    )


class ChiBioPI:
    """Exact copy of the Chi.Bio's `RegulateOD` (docs/device.md, Regulation).

    x is the reading, x' the previous reading, r the setpoint, e = x - r, and dt the minutes between the previous two
    cycles, because the device records the time of a cycle after its decision:

      P  = ln(x/r) / dt / (240/V) for x > 0, else 0; times 0.7 if |x - x'| < 0.1, unless I2 is reset
      I1 = 0 if e < 0.01; else I1 + 0.1 e if |x - x'| < 0.05 and e > 0.025; else I1
           (compensates for a gasket that reduces the pump's flow)
      I2 = 0 if |e| > 0.1 and |x - x'| < 0.05; else I2 + 0.01 e if |x - x'| < 0.1; else I2
      u  = clip(P + I1 + I2, 0, 0.02); 0 if x - x' > 0.04 (noise guard); 0 in the first two cycles

    Args: volume_ml: V, culture volume set on the device, mL, (N,) or one for all.
    """

    remembers = ("cycles", "before", "times", "p", "i1", "i2", "rate")

    def __init__(self, config: ChiBioPIConfig, volume_ml: Array | float = Bench.volume_ml) -> None:
        self.config, self._volume_ml = config, volume_ml
        self.reset(1)

    def reset(self, n: int) -> None:
        self._cycles = np.zeros(n, dtype=np.int64)
        self._before = np.zeros(n)
        self._times = np.zeros((2, n))  # of the last two recorded cycles, older first
        self._p, self._i1, self._i2, self._rate = (np.zeros(n) for _ in range(4))

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        now = usable(od, rows)
        self._cycles = self._cycles + now
        regulating = now & (self._cycles >= 3)
        x, r = np.where(now, od, 1.0), np.where(setpoint > 0.0, setpoint, LOWEST_OD)
        error, change = x - r, np.abs(x - self._before)
        interval = self._times[1] - self._times[0]
        interval = np.where(interval > 0.0, interval, 1.0)  # before two records exist, u is 0
        gain = self._volume_ml / (60.0 * ASSUMED_FLOW_ML_S) / interval
        p = np.where(x > 0.0, np.log(np.maximum(x, LOWEST_OD) / r) * gain, 0.0)
        i1 = self._i1 + np.where((change < 0.05) & (error > 0.025), 0.1 * error, 0.0)
        i1 = np.where(error < 0.01, 0.0, i1)
        cleared = (np.abs(error) > 0.1) & (change < 0.05)
        steady = ~cleared & (change < 0.1)
        i2 = np.where(cleared, 0.0, self._i2 + np.where(steady, 0.01 * error, 0.0))
        p = np.where(steady, 0.7 * p, p)
        rate = np.where(x - self._before > 0.04, 0.0, np.clip(p + i1 + i2, 0.0, self.config.max_pump_rate))
        self._p, self._i1, self._i2 = (
            np.where(regulating, new, old) for new, old in ((p, self._p), (i1, self._i1), (i2, self._i2))
        )
        self._rate = np.where(regulating, rate, np.where(now, 0.0, self._rate))
        self._before = np.where(now, od, self._before)
        self._times = np.where(now, np.stack([self._times[1], minute]), self._times)
        return self._rate.copy()

    def explain(self) -> dict[str, Array]:
        """Explain the last decision by its three parts, mL/s."""
        return {"p": self._p.copy(), "i1": self._i1.copy(), "i2": self._i2.copy()}


@dataclass(frozen=True)
class TunedPIConfig(ControllerConfig):
    """Settings of the tuned PI; mu, tau and the largest pump rate come from the model."""

    kind: str = setting("pi_tuned", "controller")
    delay_min: float = setting(1.0, "delay until a decision is visible: one control period", "min", within=(0.5, 60))
    closed_loop_min: float = setting(
        1.0, "closed-loop time constant; SIMC's tight setting equals the delay", "min", within=(0.5, 60)
    )
    feed_forward: bool = setting(True, "start the integrator at the model's mu instead of 0")


class TunedPI:
    """PI controller of the logarithm of OD, tuned by the SIMC rule, with anti-windup.

    In z = ln(x/r) the plant is an integrator, z' = mu - u/tau, with mu as a step disturbance. The controller is

      u = tau (K z + I),   I <- I + K dt z / T,   K = 1 / (t_c + delay),   T = 4 (t_c + delay)

    by the SIMC rule for an integrating process with dead time (Skogestad 2003, J. Process Control 13:291). With the
    rule's tight setting, t_c = delay = one control period, the sampled closed loop has the double pole 0.75.
    Anti-windup: I stays constant while u is at a bound and z would push u beyond the bound.

    Args: config: the rule's two times. model: mu, tau, control period and largest pump rate.
    """

    remembers = ("integral", "p", "rate")

    def __init__(self, config: TunedPIConfig, model: EnvConfig) -> None:
        self.config, self.model = config, model
        self.gain = 1.0 / (config.closed_loop_min + config.delay_min)  # 1/min
        self.integral_gain = self.gain * model.control_min / (4.0 * (config.closed_loop_min + config.delay_min))
        self.reset(1)

    def reset(self, n: int) -> None:
        self._integral = np.full(n, self.model.mu if self.config.feed_forward else 0.0)
        self._p, self._rate = np.zeros(n), np.zeros(n)

    def act(self, od: Array, setpoint: Array, minute: Array, rows: Mask) -> Array:
        now = usable(od, rows)
        z = np.log(np.maximum(np.where(now, od, 1.0), LOWEST_OD) / np.maximum(setpoint, LOWEST_OD))
        p = self.gain * z
        wanted = self.model.tau * (p + self._integral)
        rate = np.clip(wanted, 0.0, self.model.max_pump_rate)
        pushing = ((wanted > rate) & (z > 0.0)) | ((wanted < rate) & (z < 0.0))
        integral = self._integral + np.where(pushing, 0.0, self.integral_gain * z)
        self._integral = np.where(now, integral, self._integral)
        self._p, self._rate = np.where(now, p, self._p), np.where(now, rate, self._rate)
        return self._rate.copy()

    def explain(self) -> dict[str, Array]:
        """Explain the next decision by its two parts, dilution rates in 1/min."""
        return {"p": self._p.copy(), "i": self._integral.copy()}
