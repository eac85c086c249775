"""Feed budget: the ledger of feed and level, and the limits on a proposed feed rate."""

import math

import numpy as np

from envs.bench import Bench
from hardware.messages import Fault
from hardware.reactor import Array, Mask
from hardware.safety import messages
from hardware.safety.config import SafetyConfig
from hardware.safety.readings import Finding


class FeedBudget:
    """Feed of N reactors over the last minute, the last hour and the run, and the volume in each vial.

    Args: bench: period and largest rate. tube_ml: volume at the waste tube, mL, (N,). full_ml: volume above which a
      vial overflows, mL, (N,).
    Attributes: fed_ml: feed since the run began. volume_ml: volume in the vial. bottle_ml: feed that the bottles
      provide for the whole run. All in mL, shape (N,).
    """

    remembers = (
        "volume_ml", "fed_ml", "bottle_ml", "_hour", "_minute", "_dose_s", "_dose_ml", "_owed_ml", "_paid_ml",
        "_unusable",
    )  # fmt: skip

    def __init__(self, config: SafetyConfig, bench: Bench, tube_ml: Array, full_ml: Array) -> None:
        self._config, self._bench, n = config, bench, len(tube_ml)
        self._tube_ml, self._full_ml = tube_ml, full_ml
        self.volume_ml = self._tube_ml.copy()
        self.fed_ml, self.bottle_ml = np.zeros(n), np.full(n, bench.bottle_ml)
        self._hour = np.zeros((n, 60))  # feed per minute of the hour
        self._minute = np.full(n, -1.0)  # minute of the newest entry of _hour
        self._dose_s, self._dose_ml = np.full((n, 4), -math.inf), np.zeros((n, 4))  # the newest four doses
        self._owed_ml = np.zeros(n)  # allowed but not dosed since the last dose
        self._paid_ml = np.zeros(n)  # part of it that the last dose settled
        self._unusable = np.zeros(n)  # unusable proposals in a row

    def check(self, rate: Array, fresh: Mask, now: float) -> tuple[Array, list[Finding]]:
        """Limit the proposed feed rates, mL/s, shape (N,), and report what is wrong with them."""
        c, bench = self._config, self._bench
        unusable = fresh & ~(np.isfinite(rate) & (rate >= 0.0))
        self._unusable = np.where(fresh, np.where(unusable, self._unusable + 1, 0), self._unusable)
        lost = unusable & (self._unusable >= c.controller_patience)
        wanted = np.where(fresh & ~unusable, rate, 0.0)
        undosed = fresh & (self._owed_ml > 2.0 * bench.max_rate * bench.period_s)
        most = bench.max_rate
        findings = [
            Finding(messages.ControllerFault, unusable & ~lost, {"rate": rate}),
            Finding(messages.ControllerLostFault, lost, {"count": self._unusable}),
            Finding(messages.LimitFault, wanted > most * (1.0 + 1e-9), {"rate": wanted, "most": most}),
            Finding(messages.DosesNotTaken, undosed, {"owed_ml": self._owed_ml}),
        ]
        allowed = np.minimum(wanted, most)
        for fault, room in self._room(now).items():
            asked = allowed * bench.period_s
            over = asked > room + 1e-9
            if fault is messages.BudgetFault:  # repetitions may exceed it without a request
                over &= asked > 0.0
            findings.append(Finding(fault, over, {"left_ml": np.maximum(room, 0.0), "asked_ml": asked}))
            allowed = np.where(over, 0.0, allowed)
        return allowed, findings

    def _room(self, now: float) -> dict[type[Fault], Array]:
        c = self._config
        self._roll(now)
        recent = np.where(now - self._dose_s < 60.0, self._dose_ml, 0.0).sum(axis=1)
        per_minute = c.ml_a_minute(self._bench)
        left = [per_minute - recent, c.ml_per_hour - self._hour.sum(axis=1), c.ml_per_run - self.fed_ml]
        return {
            messages.BudgetFault: np.minimum.reduce(left),
            messages.BottleFault: self.bottle_ml - self.fed_ml,
            messages.OverflowFault: self._full_ml - self.volume_ml,
        }

    def _roll(self, now: float) -> None:
        """Forget feed of more than an hour ago: entry k of the ring belongs to the minutes with k = minute mod 60."""
        minute = np.maximum(np.floor(now / 60.0), self._minute)
        ages = (minute[:, None] - np.arange(60)) % 60  # how long ago each entry was current, in an up-to-date ring
        stale = ages < np.minimum(minute - self._minute, 60)[:, None]
        self._hour = np.where(stale, 0.0, self._hour)
        self._minute = minute

    def grant(self, rate: Array) -> None:
        """Note the allowed rate, mL/s, shape (N,), as a volume that is owed until the next dose."""
        self._owed_ml = self._owed_ml + rate * self._bench.period_s

    def book(self, feed: Array, waste: Array, now: float) -> None:
        """Book doses at `now`, mL, shape (N,): V <- max(V_tube, V + feed - waste), or V + feed where waste is 0.

        A negative volume corrects an earlier booking. `now` may be earlier than the last booking; a dose more than one
        hour old counts only for the run.
        """
        self._roll(now)
        within = self._minute - now // 60.0 < 60.0
        self._hour[:, int(now // 60.0) % 60] += np.where(within, feed, 0.0)
        self.fed_ml = self.fed_ml + feed
        dosed, newest = feed > 0.0, self._dose_ml[:, -1]
        for mine, new in ((self._dose_s, np.full(len(feed), now)), (self._dose_ml, feed)):
            mine[dosed] = np.column_stack([mine[dosed, 1:], new[dosed]])
        undone = (feed < 0.0) & (-feed >= 0.9 * newest)  # booked when it began, and not given
        self._paid_ml, owed = np.where(dosed, self._owed_ml, self._paid_ml), self._owed_ml + undone * self._paid_ml
        self._owed_ml = np.where(dosed, 0.0, owed)
        level = np.maximum(self.volume_ml + feed - waste, self._tube_ml)
        self.volume_ml = np.where(waste != 0.0, level, self.volume_ml + feed)
