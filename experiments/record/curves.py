"""TensorBoard curves of a closed loop, during the run and at its end."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.loop.loop import Step
from experiments.reporting import tables
from experiments.reporting.curves import BAND, CALLED, COLUMNS, DEPLOYMENT, PAGES, error_tag, signals_in
from experiments.reporting.tensorboard import Events

Array = NDArray[np.float64]

WINDOW = {
    "reactor": "reactor", "setpoint": "setpoint, OD", "start_min": "from, min", "end_min": "to, min",
    "steady_abs_error": "steady error, OD", "settling_min": "settled after, min", "ise": "ISE, OD² min",
    "itae": "ITAE, OD min²", "abs_error": "mean error, OD",
}  # fmt: skip


class Curves:
    """Curves of N reactors over minutes of the run, in the run folder for one reactor, in reactors/NAME/ for several.

    Points carry run time, so the axes "relative" and "wall" show culture hours, even for a simulation of seconds.

    Args:
      folder: run folder. names: names of the reactors. columns: columns of the recordings.
      first_minute: minute at which a run is resumed, else 0.
      began: start of the run, s since 1970; None: now.
    """

    def __init__(
        self, folder: Path, names: Sequence[str], columns: Sequence[str], first_minute: int, began: float | None
    ) -> None:
        self._folder, self._names, self._last = folder, tuple(names), first_minute
        self._began = time.time() if began is None else began
        self.run = Events(folder, first_minute)
        single = len(names) == 1
        self._each = [self.run if single else Events(folder / "reactors" / name, first_minute) for name in names]
        further = [PAGES[column] for column in columns if column in PAGES]
        self.run.layout({page: charts for pages in (DEPLOYMENT, *further) for page, charts in pages.items()})
        path = folder / "config.yaml"
        if path.is_file():
            self.run.text("run/config", f"```yaml\n{path.read_text(encoding='utf-8')}\n```")
        self.run.flush()

    def step(self, step: Step) -> None:
        """Add a point to every curve of the reactors with a new sample. Raises: OSError if the disk is full."""
        setpoint = np.where(step.phase >= 0, step.setpoint, np.nan)
        named: dict[str, Array] = {
            "culture/od": step.od if step.believed is None else np.where(step.believed, step.od, np.nan),
            "culture/setpoint": setpoint,
            "culture/setpoint_low": setpoint * (1.0 - BAND),
            "culture/setpoint_high": setpoint * (1.0 + BAND),
            "culture/temperature_degc": step.temperature,
            "pump/rate_ml_s": step.rate,
            **{COLUMNS.get(key, f"further/{key}"): value for key, value in step.columns.items()},
            **{f"controller/{key}": value for key, value in step.explanation.items() if value.ndim == 1},
        }
        for n in map(int, np.flatnonzero(step.rows)):
            minute = max(self._last, round(float(step.minute[n])))
            values = {tag: float(value[n]) for tag, value in named.items() if np.isfinite(value[n])}
            values["safety/interlock"] = float(bool(step.reasons[n]))
            self._each[n].scalars(values, minute, self._began + 60.0 * minute)
            self._last = minute

    def end(self, summary: Mapping[str, Any], row: Mapping[str, float | str], pictures: Mapping[str, Path]) -> None:
        """Write the results: figures, the windows as a table, and a row of the HPARAMS table.

        Args: summary: content of summary.json. row: values of this row without results. pictures: name -> PNG.
        """
        when = self._began + 60.0 * self._last
        for name, path in pictures.items():
            self.run.picture(f"figures/{name}", path, self._last)
        windows = summary["windows"]
        self.run.text("run/summary", f"{summary['outcome']}\n\n{windows_table(windows)}", self._last)
        self.run.scalars({tag: v for tag, v in _results(summary).items() if np.isfinite(v)}, self._last, when)
        self.run.hyper_parameters(row, self._folder)

    def flush(self) -> None:
        """Write all points so far to the disk, where TensorBoard reads them. Raises: OSError if the disk is full."""
        for events in {self.run, *self._each}:
            events.flush()

    def close(self) -> None:
        """Flush and close. Idempotent."""
        for events in {self.run, *self._each}:
            events.close()


def _results(summary: Mapping[str, Any]) -> dict[str, float]:

    def known(key: str) -> Array:
        values = [w.get(key) for w in summary["windows"]]
        return np.array([v for v in values if v is not None and np.isfinite(v)])

    steady, ise = known("steady_abs_error"), known("ise")
    errors = {signal: known(f"{signal}_abs_error_mean") for signal in signals_in(summary["windows"])}
    return {
        "result/steady_abs_error": float(steady.max()) if steady.size else float("nan"),
        "result/ise": float(ise.sum()) if ise.size else float("nan"),
        **{error_tag(signal): float(found.mean()) for signal, found in errors.items() if found.size},
        "result/medium_ml": float(summary["volume_ml"]),
    }


def windows_table(windows: Sequence[Mapping[str, Any]]) -> str:
    """Return the windows of a summary as a Markdown table, with the errors of further signals."""
    of_signals = {f"{s}_abs_error_mean": f"error of the {CALLED.get(s, s)}" for s in signals_in(windows)}
    titles = {key: title for key, title in (WINDOW | of_signals).items() if any(key in w for w in windows)}
    rows = [[w[key] if key == "reactor" else tables.number(w.get(key)) for key in titles] for w in windows]
    return tables.markdown(list(titles.values()), rows)
