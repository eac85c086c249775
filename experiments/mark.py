"""Record an event at the bench in a run's folder: `python -m experiments.mark run=RUN text=inoculated`.

A running deployment uses three kinds of marks. It sets its ledger to a level read from the vial, corrects its estimate
by a counted share of B, and continues to dose from a refilled bottle.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from conf.schema import check, require, setting
from experiments.cli import files, frame
from hardware.errors import RecordingError
from hardware.storage.journal import read_journal
from hardware.storage.marks import Mark, add_mark

LONGEST = 80  # characters of a text
USUAL_SD = 0.03


@dataclass(frozen=True)
class MarkConfig:
    """Config of a mark: event, run, reactor and time."""

    run: str = setting("", "folder of a running or finished deployment, or `latest`")
    reactor: str = setting("", "reactor position or unit; '': all")
    text: str = setting("inoculated", "event, in one line of at most 80 characters")
    level_ml: float | None = setting(
        None, "volume read from the vial; a running deployment sets its ledger and the unit's ledger to it", "mL",
        within=(0, 40),
    )  # fmt: skip
    share: float | None = setting(
        None, "share of B, counted in a sample; a running deployment uses it in its estimate", above=0.0, below=1.0
    )
    sd: float | None = setting(None, "sd of that share; null: 0.03", within=(0.001, 0.5))
    bottle_ml: float | None = setting(
        None, "volume in the bottle after filling; a running deployment counts down from it", "mL", within=(1, 100_000)
    )
    minute: float | None = setting(
        None,
        "minute of the run at which the event or sample took place; null: now",
        "min",
        within=(-1440.0, 1_000_000.0),
    )

    def __post_init__(self) -> None:
        check(self)
        require(
            0 < len(self.text) <= LONGEST and self.text.isprintable(),
            "text",
            repr(self.text),
            "1 to 80 characters, one line",
        )
        require(self.sd is None or self.share is not None, "sd", self.sd, "null, or together with share=SHARE")
        measured = [key for key in ("level_ml", "share", "bottle_ml") if getattr(self, key) is not None]
        if measured:
            require(bool(self.reactor), "reactor", repr(self.reactor), f"a reactor, because {measured[0]} is given")
        if self.bottle_ml is not None:
            require(measured == ["bottle_ml"], "bottle_ml", self.bottle_ml, "alone; mark the other value separately")
            require(self.minute is None, "minute", self.minute, "null with bottle_ml, which applies now")
        if self.level_ml is not None:
            require(self.share is None, "share", self.share, "null together with level_ml; mark each separately")
            require(self.minute is None, "minute", self.minute, "null with level_ml, which applies now")


def _minute_now(folder: Path, stored: Any) -> float:
    from hardware.clock import run_time
    from hardware.family import family, known  # and with it the plant, only for this

    kind = str(OmegaConf.select(stored, "backend.kind"))
    over = frame.UserError(f"run={folder}: the run is over; give the time of the event by minute=MINUTE")
    if kind in known() and family(kind).simulated:
        raise over
    rows, _ = read_journal(folder / "journal.jsonl")
    if [row["kind"] for row in rows if row["kind"] in ("start", "stop")][-1:] == ["stop"]:
        raise over
    if not rows:
        raise frame.UserError(f"run={folder}: the run has not begun; wait for its first sample")
    speed = OmegaConf.select(stored, "backend.speed")  # an emulated device can be faster
    return run_time(rows, 1.0 if speed is None else float(speed)).s / 60.0


def _latest(folder: Path, stored: Any) -> float:
    try:
        return _minute_now(folder, stored)
    except frame.UserError:
        last = [path.read_text(encoding="utf-8").splitlines()[-1] for path in (folder / "recordings").glob("*.csv")]
        begun = [line.split(",")[0] for line in last if line[:1].isdigit()]
        return max(map(float, begun), default=0.0)


def mark(config: MarkConfig) -> str:
    """Append a mark; return a message of one line. Raises: UserError with the missing or invalid value."""
    folder = Path(config.run)
    known = sorted(path.stem for path in (folder / "recordings").glob("*.csv")) if config.run else []
    if not known:
        raise frame.UserError(f"run={config.run}: not a deployment folder (no recordings/); give a folder of deploy")
    if config.reactor and config.reactor not in known:
        raise frame.UserError(f"reactor={config.reactor}: not in this run; allowed {', '.join(known)}")
    try:
        minute = config.minute
        stored = files.load_yaml(folder / "config.yaml")
        if minute is None:
            minute = _minute_now(folder, stored)
        elif config.share is not None and minute > (now := _latest(folder, stored)):
            raise frame.UserError(f"minute={minute:g}: allowed up to {now:.0f}, the present minute of the run")
        said = [f"level {config.level_ml:g} mL"] if config.level_ml is not None else []
        sd = None if config.share is None else USUAL_SD if config.sd is None else config.sd
        said += [f"bottle {config.bottle_ml:g} mL"] if config.bottle_ml is not None else []
        said += [f"share {config.share:g} +- {sd:g}"] if config.share is not None else []
        own = [config.text] if config.text != MarkConfig.text or not said else []
        text = ", ".join([*said, *own])[:LONGEST]
        path = add_mark(folder, Mark(minute, config.reactor, text, config.level_ml, config.share, sd, config.bottle_ml))
    except (OSError, RecordingError) as error:
        raise frame.UserError(f"run={folder}: {error}") from None
    taken = "; a running deployment uses this value at its next sample" if said else ""
    return f"{config.reactor or 'all reactors'}: {text} at minute {minute:.1f}, in {path}{taken}"


def _quoted(argument: str) -> str:
    key, _, value = argument.partition("=")
    if key.lstrip("+") != "text" or value[:1] in ("'", '"'):
        return argument
    escaped = value.replace("'", "\\'")
    return f"{key}='{escaped}'"


class _Mark(frame.EntryPoint[MarkConfig]):
    """Entry point of `mark`, which writes into the folder of another run and makes none itself."""

    def _answer(self, given: list[str]) -> None:
        if any(a.startswith("-") for a in given):
            super()._answer(given)
        else:
            print(mark(self.config([_quoted(a) for a in given])))


main = _Mark("mark", MarkConfig(), lambda config, folder: print(mark(config)))


if __name__ == "__main__":
    main()
