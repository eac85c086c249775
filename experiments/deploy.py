"""Run a controller in closed loop and record everything: `python -m experiments.deploy`."""

from __future__ import annotations

import logging
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from experiments.cli import files, frame
from experiments.control.config import DeployConfig, deploy_schema

if TYPE_CHECKING:
    from dqn.policy import Policy
    from envs.scenario import Scenario
    from experiments.control.loop import ClosedLoop, Step
    from experiments.control.record import Record
    from hardware.reactor import Reactor

log = logging.getLogger(__name__)

POOR_REGRET_PCT = 25.0
METRICS = ("ise", "itae", "ise_mean", "itae_mean", "settling_min", "steady_abs_error")


def find_policy(name: str, root: Path = Path("runs/train")) -> Path:
    """A policy.npz from a path, a run folder or `latest`. Raises: UserError saying what to give instead."""
    if name == "latest":
        found = sorted(root.glob("**/policy.npz"), key=lambda p: p.stat().st_mtime)
        if not found:
            raise frame.UserError(f"policy=latest: no policy.npz under {root}; train one first or give policy=PATH")
        return found[-1]
    path = Path(name)
    return path / "policy.npz" if path.is_dir() else path


def load_policy(name: str, control_min: float, max_rate: float) -> Policy:
    """The policy, checked against backend and safety. Raises: UserError naming both values of a mismatch."""
    from dqn import policy as policies

    path = find_policy(name)
    try:
        policy = policies.load(path)
        trained = float(policy.metadata.get("control_min", float("nan")))
        regret = float(policy.metadata.get("regret_pct", float("nan")))
        fastest = float(policy.pump_rates.max())
    except policies.PolicyError as error:
        raise frame.UserError(str(error)) from None
    except Exception as error:  # whatever a damaged file makes NumPy say
        why = (str(error).splitlines() or [type(error).__name__])[0]
        raise frame.UserError(f"policy {path}: damaged ({why}); give the policy.npz of a training run") from None
    if not abs(trained - control_min) <= 1e-9:
        raise frame.UserError(
            f"policy {path} was trained for a control period of {trained} min, the backend has {control_min} min; "
            f"train with env.control_min={control_min}"
        )
    if not fastest <= max_rate + 1e-12:
        raise frame.UserError(
            f"policy {path} pumps up to {fastest} mL/s, the interlock allows {max_rate} mL/s; "
            "train with a smaller env.max_pump_rate or raise safety.max_rate"
        )
    log.info("policy %s: regret %.2f %% against the optimum of its model", path, regret)
    if not regret <= POOR_REGRET_PCT:
        log.warning("this policy is far from optimal (regret %.0f %%): train longer or with another seed", regret)
    return policy


def policy_of(config: DeployConfig, folder: Path) -> Policy:
    """The policy of this run, of which the run folder keeps a copy. A resumed run goes on with that, whatever has been
    trained meanwhile.

    Raises: UserError as `load_policy`, and if the copy cannot be written.
    """
    kept = folder / "policy.npz"
    if config.resume is not None and kept.is_file():
        return load_policy(str(kept), config.backend.control_min, config.safety.max_rate)
    policy = load_policy(config.policy, config.backend.control_min, config.safety.max_rate)
    try:
        shutil.copyfile(find_policy(config.policy), kept)
    except OSError as error:
        raise frame.UserError(f"{kept}: copy of the policy not written ({error.strerror}); free the disk") from None
    return policy


def windows_of(record: Record, schedules: list[Scenario]) -> list[dict[str, Any]]:
    """Metrics of every phase and reactor, as in summary.json."""
    from experiments.control.metrics import window_metrics

    elapsed, od = record.series("elapsed_min"), record.series("od")
    rows = []
    for n, (name, schedule) in enumerate(zip(record.names, schedules, strict=True)):
        for phase, setpoint in enumerate(schedule.setpoints):
            start, end = float(schedule.edges[phase]), float(schedule.edges[phase + 1])
            m = window_metrics(elapsed[n : n + 1], od[n : n + 1], setpoint, start, end)
            window = {"reactor": name, "phase": phase, "setpoint": setpoint, "start_min": start, "end_min": end}
            window["temperature"] = schedule.temperatures[phase]
            rows.append({**window, **{key: float(getattr(m, key)[0]) for key in METRICS}})
    return rows


def _line(w: dict[str, Any]) -> str:
    formats = ("8.4f", "8.2f", "8.5f", "8.3f", "8.1f", "8.4f")
    cells = [f"{w[k]:{f}}" if w[k] == w[k] else f"{'–':>8}" for k, f in zip(METRICS, formats, strict=True)]
    return f"{w['reactor']:8} {w['setpoint']:8.2f} " + " ".join(cells)


def _finish(record: Record, config: DeployConfig, outcome: str) -> None:
    """Figure and summary.json, whatever the outcome."""
    import numpy as np

    from experiments.reporting import charts

    schedules, folder = config.schedules(), record.folder
    volume, minute = np.nansum(record.series("volume_ml"), axis=1), record.series("time_min")
    setpoint = np.where(record.series("phase") >= 0, record.series("setpoint"), np.nan)
    switched = any(len(set(s.temperatures)) > 1 for s in schedules)
    temperature = record.series("temperature_degc").T if switched else None
    series = (minute.T, record.series("od").T, setpoint.T, record.series("pump_rate_ml_s").T)
    figure = charts.culture(*series, record.names, temperature, f"{config.backend.kind}: {outcome}")
    path = charts.save(figure, folder / "figures", "closed_loop")
    record.events.figure("figures/closed_loop", figure, minute.shape[1])
    windows = windows_of(record, schedules)
    reactors = {
        name: {
            "role": config.role(name),
            "volume_ml": float(v),
            "rows": rows,
            "interlock": alarms,
        }
        for name, v, rows, alarms in zip(record.names, volume, record.lengths, record.interlock_rows, strict=True)
    }
    summary = {
        "outcome": outcome,
        "minutes": float(np.nanmax(minute)) if np.isfinite(minute).any() else 0.0,
        "windows": windows,
        "volume_ml": float(volume.sum()),
        "reactors": reactors,
        "repairs": record.repairs,
        "figure": str(path),
    }
    files.write_json(folder / "summary.json", summary)
    log.info("%s after %.0f min, %.1f mL of fresh medium", outcome, summary["minutes"], summary["volume_ml"])
    heads = ("reactor", "setpoint", "ISE", "ITAE", "ISE/T", "ITAE/T", "settled", "steady")
    header = f"{heads[0]:8} " + " ".join(f"{h:>8}" for h in heads[1:])
    lines = "\n".join(_line(w) for w in windows)
    log.info(
        "ISE, ITAE with T = 1 min; /T with T = window; settled: min until |e| stays within 5 %%\n%s\n%s", header, lines
    )
    log.info("recordings %s; figure %s; tensorboard --logdir %s", folder / "recordings", path, folder)


@contextmanager
def handled(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """These signals call `handler` for a while, except those that are ignored on purpose (nohup)."""
    before = {n: old for n in numbers if (old := signal.getsignal(n)) is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def interrupt(number: int, frame: FrameType | None) -> None:
    """SIGTERM (a service manager, a shutting-down PC) and SIGHUP (a closed terminal) end the run like Ctrl-C."""
    raise KeyboardInterrupt


def patience(number: int, frame: FrameType | None) -> None:
    """A second Ctrl-C must not end the program before the pumps are verified off."""
    log.warning("the pumps are being switched off and verified; this takes up to a minute")


class Announcer:
    """Tells what changes, once: phases, words of the interlock, notes of the reactors."""

    def __init__(self, loop: ClosedLoop) -> None:
        self._names = loop.reactors.names
        self._phase = [-2] * len(self._names)
        self._reason: list[str | None] = [None] * len(self._names)
        self._told: set[str] = set()

    def __call__(self, step: Step) -> None:
        """Log what is new in this step."""
        for n, name in enumerate(self._names):
            if step.rows[n] and int(step.phase[n]) != self._phase[n]:
                self._phase[n] = int(step.phase[n])
                what = "recovery" if self._phase[n] < 0 else f"setpoint {step.setpoint[n]:g}"
                log.info("%s: %s from minute %.0f, OD %.3f", name, what, step.minute[n], step.od[n])
            reason = step.reasons[n] or ""
            if not step.rows[n] and (not reason or reason.endswith("earlier in this run")):
                continue  # what a sample was refused for is not over because there is no new one yet
            kinds = reason.split(":")[0]
            if kinds != (self._reason[n] or ""):
                self._reason[n] = kinds
                log.warning("%s: %s", name, step.reasons[n] or "interlock: all well again")
        for note in step.notes:
            kind = re.sub(r"[\d.]+", "#", note)
            if kind not in self._told:  # the journal has every one of them
                self._told.add(kind)
                log.info("%s (noted once here, every time in the journal)", note)


def _run(loop: ClosedLoop, record: Record, reactors: Reactor, config: DeployConfig) -> str:
    """The loop until its end or trouble; returns the outcome. Pumps are verified off, whatever happens."""
    from tqdm import tqdm
    from tqdm.contrib.logging import logging_redirect_tqdm

    from hardware.errors import ReactorError

    announce = Announcer(loop)
    outcome = "failed: see the log"
    record.journal.append("start", {"time_s": round(reactors.elapsed(), 3), "pid": os.getpid()})
    try:
        with logging_redirect_tqdm(), tqdm(disable=None, unit="sample") as bar:
            for step in loop.run():
                record.done(step, loop.state_dict())
                announce(step)
                bar.update(int(step.rows.sum()))
        given_up = [name for name, s in zip(reactors.names, loop.stopped, strict=True) if s]
        outcome = f"stopped by the interlock: {', '.join(given_up)}" if given_up else "completed"
    except KeyboardInterrupt:
        outcome = "stopped by the operator"
    except ReactorError as error:
        outcome = f"failed: {error}"
    except Exception as error:  # whatever it is, what was recorded is worth a summary
        log.exception("the run ends")
        outcome = f"failed: {type(error).__name__}: {error}"
    finally:
        with handled(patience, signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            try:
                reactors.stop()
                left = ", ".join(n for n, h in zip(reactors.names, loop.handed_over, strict=True) if h)
                log.info("pumps verified off%s", f"; {left}: left to the on-board regulation" if left else "")
            except ReactorError as error:
                outcome = f"failed: {error}"
    return outcome


def deploy(config: DeployConfig, folder: Path) -> None:
    """One closed loop over the scenario."""
    from experiments.control import assemble as backends
    from experiments.control.loop import ClosedLoop
    from experiments.control.record import Record
    from hardware.errors import ReactorError
    from hardware.safety.interlock import Interlock

    backend = config.backend
    try:
        schedules = config.schedules()
    except ValueError as error:
        raise frame.UserError(str(error)) from None
    if config.resume is not None and backend.kind == "sim":
        raise frame.UserError(f"resume={config.resume}: a simulated run takes a second; run it again")
    plant, model = backends.plant_of(config), backends.model_of(config)
    policy = None
    if config.controller.kind == "dqn":
        policy = policy_of(config, folder)
    record = None
    try:
        if config.preflight_only:
            backends.run_preflight(config, folder)
            return
        with handled(interrupt, signal.SIGTERM, signal.SIGHUP):
            record = Record(folder, backend.reactors, config.fsync)
            for repair in record.repairs:
                log.warning("%s", repair)
            with backends.opened(config, plant, record) as reactors:
                controller = backends.controller_of(config, model, policy, reactors)
                interlock = Interlock(len(backend.reactors), config.safety)
                loop = ClosedLoop(reactors, controller, interlock, schedules, record.decided)
                if config.resume is not None:
                    backends.continue_loop(loop, record)
                outcome = _run(loop, record, reactors, config)
            try:
                _finish(record, config, outcome)
            except OSError as error:
                why = f"figure and summary not written ({error.strerror or error})"
                outcome = f"failed: {outcome.removeprefix('failed: ')}; {why}"
    except ReactorError as error:
        raise frame.UserError(str(error)) from None
    finally:
        if record is not None:
            record.close()
    if outcome.startswith("failed"):
        raise frame.UserError(outcome)


def _schema(cfg: DictConfig) -> DeployConfig:
    return deploy_schema(str(cfg.backend.kind), str(cfg.controller.kind))


main = frame.Command("deploy", DeployConfig(), deploy, _schema)


if __name__ == "__main__":
    main()
