"""Writers of a run's curves: TensorBoard events, and a CSV file of the same scalars.

They use TensorBoard's own event writer, so a computer without PyTorch can show a run live. `reporting/curves.py`
describes each tag.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.compat.proto.tensor_pb2 import TensorProto
from tensorboard.compat.proto.tensor_shape_pb2 import TensorShapeProto
from tensorboard.compat.proto.types_pb2 import DT_FLOAT, DT_STRING
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.custom_scalar import metadata as custom
from tensorboard.plugins.hparams import api_pb2, plugin_data_pb2, summary_v2
from tensorboard.plugins.hparams import metadata as hparams
from tensorboard.plugins.image import metadata as image
from tensorboard.plugins.scalar import metadata as scalar
from tensorboard.plugins.text import metadata as text
from tensorboard.summary.writer.event_file_writer import EventFileWriter

from conf.presets import groups
from experiments.cli.files import given
from experiments.cli.stop import undisturbed
from experiments.reporting.curves import METRICS, PARAMETERS, Chart, Column, described
from experiments.reporting.tables import interquartile_mean

MOST_CURVES = 64  # most agents with curves of their own; a larger population has only statistics
LIVE_S = 5.0  # longest time between two flushes while values are written
NUMBER = TensorShapeProto()
LINE, THREE = (TensorShapeProto(dim=[TensorShapeProto.Dim(size=n)]) for n in (1, 3))


class Events:
    """Writer of the TensorBoard events of one run; events are visible within seconds.

    Args: folder: of the event file. first_step: of a resumed run; TensorBoard hides older events from this step on.
    """

    def __init__(self, folder: Path, first_step: int = 0) -> None:
        with undisturbed():
            self._writer = EventFileWriter(str(folder))
        self._known: set[str] = set()
        self._flushed = time.monotonic()
        for _ in range(2 if first_step else 0):  # TensorBoard ignores the first start marker
            started = SessionLog(status=SessionLog.START)
            with undisturbed():
                self._writer.add_event(Event(step=first_step, wall_time=time.time(), session_log=started))

    def _add(self, values: Sequence[Summary.Value], step: int, wall: float | None = None) -> None:
        when = time.time() if wall is None else wall
        with undisturbed():
            self._writer.add_event(Event(step=step, wall_time=when, summary=Summary(value=values)))
        if time.monotonic() - self._flushed >= LIVE_S:
            self.flush()

    def _point(self, tag: str, number: float) -> Summary.Value:
        point = Summary.Value(tag=tag, tensor=TensorProto(dtype=DT_FLOAT, float_val=[number], tensor_shape=NUMBER))
        if tag not in self._known:
            self._known.add(tag)
            point.metadata.CopyFrom(scalar.create_summary_metadata("", described(tag)))
        return point

    def scalars(self, values: Mapping[str, float], step: int, wall: float | None = None) -> None:
        """Write one point of each curve. Args: values: tag -> value. wall: time of the point, s since 1970, or now."""
        self._add([self._point(tag, value) for tag, value in values.items()], step, wall)

    def _strings(self, tag: str, values: list[bytes], shape: Any, metadata: Any, step: int) -> None:
        tensor = TensorProto(dtype=DT_STRING, string_val=values, tensor_shape=shape)
        self._add([Summary.Value(tag=tag, tensor=tensor, metadata=metadata)], step)

    def picture(self, tag: str, png: Path, step: int) -> None:
        """Write a PNG file to TensorBoard's page Images. Raises: OSError for an unreadable file."""
        data = png.read_bytes()
        size = [str(int.from_bytes(data[i : i + 4], "big")).encode() for i in (16, 20)]  # width and height
        self._strings(tag, [*size, data], THREE, image.create_summary_metadata("", described(tag)), step)

    def text(self, tag: str, markdown: str, step: int = 0) -> None:
        """Write a text in Markdown."""
        self._strings(tag, [markdown.encode()], LINE, text.create_summary_metadata("", ""), step)

    def layout(self, categories: Mapping[str, Mapping[str, Chart]]) -> None:
        """Write the layout of the custom page: category -> title -> chart."""
        made = layout_pb2.Layout(
            category=[
                layout_pb2.Category(title=name, chart=[_chart(title, chart) for title, chart in charts.items()])
                for name, charts in categories.items()
            ]
        )
        tag, said = custom.CONFIG_SUMMARY_TAG, custom.create_summary_metadata()
        self._strings(tag, [made.SerializeToString()], NUMBER, said, 0)

    def hyper_parameters(self, values: Mapping[str, float | str], folder: Path, part: str = "") -> None:
        """Write a row of TensorBoard's HPARAMS table. TensorBoard adds the last values of the tags in `METRICS`.

        Each argument of the command line has a column, so a sweep shows every varied key. TensorBoard shows only the
        columns of the first run that it reads; the column "given" lists all arguments of a run.

        Args: values: name -> value; names in `PARAMETERS` or others. folder: run folder; its last two path components
        name the row, because TensorBoard averages rows of one name. part: added to the name if a run has several rows.
        """
        varied = _varied(folder)
        listed = {"given": " ".join(f"{key}={value}" for key, value in varied.items())} if varied else {}
        values = {**{key: _number(value) for key, value in varied.items()}, **values, **listed}
        name = "/".join([*folder.resolve().parts[-2:], *([part] if part else [])])
        own = {
            key: Column(key, "parameter of the task, or argument of the command line", not isinstance(value, str))
            for key, value in sorted(values.items())
            if key not in PARAMETERS
        }
        columns = [_column(key, column) for key, column in (PARAMETERS | own).items()]
        metrics = [
            api_pb2.MetricInfo(name=api_pb2.MetricName(tag=tag), display_name=title, description=described(tag))
            for tag, title in METRICS.items()
        ]
        experiment = api_pb2.Experiment(hparam_infos=columns, metric_infos=metrics)
        said = hparams.create_summary_metadata(plugin_data_pb2.HParamsPluginData(experiment=experiment))
        self._add([Summary.Value(tag=hparams.EXPERIMENT_TAG, metadata=said, tensor=hparams.NULL_TENSOR)], 0)
        self._add(summary_v2.hparams_pb({_ordered(key): values[key] for key in values}, trial_id=name).value, 0)

    def flush(self) -> None:
        with undisturbed():
            self._writer.flush()
        self._flushed = time.monotonic()

    def close(self) -> None:
        with undisturbed():
            self._writer.close()


def _chart(title: str, chart: Chart) -> layout_pb2.Chart:
    if chart.bands:
        series = [layout_pb2.MarginChartContent.Series(value=v, lower=low, upper=up) for v, low, up in chart.bands]
        return layout_pb2.Chart(title=title, margin=layout_pb2.MarginChartContent(series=series))
    tags = [f"{tag}$" for tag in chart.lines]
    return layout_pb2.Chart(title=title, multiline=layout_pb2.MultilineChartContent(tag=tags))


def _varied(folder: Path) -> dict[str, str]:
    words = (word.partition("=") for word in given(folder))
    found = {key: value for key, sign, value in words if sign and key not in groups() and key != "seed"}
    return {k: v for k, v in found.items() if not k.startswith(("hydra.", "hydra/", "~")) and k != "extend"}


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _ordered(key: str) -> str:
    """Return a column's name with a number in front, so that columns sort as in `PARAMETERS`; it is not displayed."""
    return f"{[*PARAMETERS, key].index(key)}_{key}"


def _column(key: str, column: Column) -> api_pb2.HParamInfo:
    kind = api_pb2.DATA_TYPE_FLOAT64 if column.number else api_pb2.DATA_TYPE_STRING
    return api_pb2.HParamInfo(name=_ordered(key), display_name=column.title, description=column.what, type=kind)


class PopulationWriter:
    """Writer of the scalars of S agents: each agent's curves as a separate run, and statistics of all agents.

    One agent: the run folder has its curves. Several agents: `agents/seedNNNN/` has the curves of each agent, and the
    run folder has tag/iqm, tag/min and tag/max over agents. Every value is also a row of progress.csv.

    Args: folder: run folder. seeds: one per agent. first_step: step of the checkpoint that a run resumes from, or 0.
    """

    def __init__(self, folder: Path, seeds: Sequence[int], first_step: int = 0) -> None:
        purge = first_step + 1 if first_step else 0
        self.events = Events(folder, purge)
        singles = seeds if 1 < len(seeds) <= MOST_CURVES else []
        self._agents = [Events(folder / "agents" / f"seed{seed:04d}", purge) for seed in singles]
        self._seeds = list(seeds)
        self._path = folder / "progress.csv"
        kept = self._rows_until(first_step) if first_step else []
        self._file = open(self._path, "w", newline="", encoding="utf-8")  # noqa: SIM115  (closed in close)
        self._csv = csv.writer(self._file)
        self._csv.writerow(["step", "seed", "tag", "value"])
        self._csv.writerows(kept)

    @property
    def agents(self) -> Sequence[Events]:
        """One event writer per agent, for the agent's own curves; empty for more than `MOST_CURVES` agents."""
        return self._agents if len(self._seeds) > 1 else [self.events]

    def _rows_until(self, step: int) -> list[list[str]]:
        if not self._path.is_file():
            return []
        with open(self._path, newline="", encoding="utf-8") as f:
            rows = list(csv.reader(f))[1:]
        return [row for row in rows if len(row) == 4 and row[0].isdigit() and int(row[0]) <= step]

    def scalars(self, step: int, values: Mapping[str, NDArray[np.float64] | float]) -> None:
        """Write values of tags at an environment step. Args: values: tag -> number, or one entry per agent, (S,)."""
        shared: dict[str, float] = {}
        single: list[dict[str, float]] = [{} for _ in self._agents]
        for tag, value in values.items():
            each = np.atleast_1d(np.asarray(value, dtype=np.float64))
            if not np.isfinite(each).any():
                continue
            if each.size == 1:
                shared[tag] = float(each[0])
            else:
                shared |= {
                    f"{tag}/iqm": interquartile_mean(each),
                    f"{tag}/min": float(np.nanmin(each)),
                    f"{tag}/max": float(np.nanmax(each)),
                }
                for own, v in zip(single, each, strict=False):
                    own[tag] = float(v)
            names: Sequence[int | str] = self._seeds if each.size == len(self._seeds) else ["all"]
            self._csv.writerows([step, name, tag, repr(float(v))] for name, v in zip(names, each, strict=True))
        for events, own in zip((self.events, *self._agents), (shared, *single), strict=True):
            if own:
                events.scalars(own, step)

    def flush(self) -> None:
        self._file.flush()
        for events in (self.events, *self._agents):
            events.flush()

    def close(self) -> None:
        self._file.close()
        for events in (self.events, *self._agents):
            events.close()
