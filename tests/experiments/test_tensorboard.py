"""What runs write for TensorBoard: every tag explained, named and laid out, and dated for whoever reads it."""

import csv
import io
import json
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from tensorboard.backend.event_processing import plugin_event_accumulator as shown
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.custom_scalar import metadata as custom
from tensorboard.plugins.hparams import metadata as hparams
from tensorboard.plugins.hparams.backend_context import Context

from experiments.cli import frame
from experiments.control import run as control
from experiments.deploy import main as deploy
from experiments.record.record import Record
from experiments.recordings.reader import read_recording
from experiments.reporting.curves import CURVES, METRICS, PARAMETERS, POPULATION, described
from experiments.reporting.tensorboard import Events, PopulationWriter
from experiments.train import main as train
from experiments.training import run as training

PAGE = Path(__file__).parents[2] / "docs" / "tensorboard.md"
ROW = re.compile(r"^- `(\w+/\w+)`(?: \((.*?)\))?: ", re.MULTILINE)
TEN = ["fsync=false", "scenario=hold", "scenario.setpoints=[0.45]", "scenario.minutes=[12]", "scenario.recovery_od=0.1"]
SHORT = ["agent.total_steps=300", "agent.learn_start=100"]
SLOW = ["controller=pi", "backend.reactors=[M0,M1]", "bench.period_s=120", "safety.ml_per_run=3"]
SLOW += ["scenario.minutes=[20]", "plant.start_od=0.4", "scenario.recovery_od=0.44"]
PAGES = ["Density", "Pump, heat, interlock"]  # of a deployment
RUNS = {
    "learning": [*SHORT, "seed=3"],
    "population": [*SHORT, "n_agents=2"],
    "dqn": [*TEN, "backend.seed=5"],
    "pi": [*TEN, *SLOW],
    "pi_tuned": [*TEN, "controller=pi_tuned"],
    "shares": [*TEN, "plant=coculture", "composition=dqn_preview", "scenario.ratios=[0.4]"],
}
pytestmark = [pytest.mark.xdist_group("curves"), pytest.mark.numeric]  # its tests share these runs


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs that together write every curve."""
    root = tmp_path_factory.mktemp("runs")
    for name, words in RUNS.items():
        command = train if name in ("learning", "population") else deploy
        config, folder = command.config(words), root / name
        (folder / ".hydra").mkdir(parents=True)  # as Hydra leaves it
        (folder / ".hydra" / "overrides.yaml").write_text("".join(f"- {word}\n" for word in words))
        frame.save_config(config, folder)
        (training.train if command is train else control.deploy)(config, folder)
    return root


def parts(folder: Path) -> Iterator[EventAccumulator]:
    """The events of a run folder, and of the agents or reactors below it."""
    for path in sorted({p.parent for p in folder.rglob("events.out*")}):
        yield EventAccumulator(str(path), size_guidance={"tensors": 0}).Reload()


def curve(events: EventAccumulator, tag: str) -> np.ndarray:
    """Step and value of each point, (K, 2)."""
    return np.array([[e.step, e.tensor_proto.float_val[0]] for e in events.Tensors(tag)])


def scalars(events: EventAccumulator, kind: str = "scalars") -> set[str]:
    """Tags of this kind."""
    try:
        return set(events.PluginTagToContent(kind))
    except KeyError:
        return set()


def folded(tag: str) -> str:
    """The tag without the statistic of a population."""
    base, _, end = tag.rpartition("/")
    return base if base in CURVES and end in POPULATION else tag


@pytest.mark.slow
def test_the_page_explains_the_curves_that_runs_write_and_no_other(runs: Path) -> None:
    written = {folded(tag) for events in parts(runs) for tag in scalars(events)}
    explained = dict(ROW.findall(PAGE.read_text(encoding="utf-8")))
    assert written == set(explained)
    assert not [tag for tag, unit in explained.items() if len(unit) > 25]  # the unit, and not the meaning


def test_every_curve_has_the_unit_that_the_page_gives_it() -> None:
    """Where a curve says more, of which task or law: before that."""
    explained = dict(ROW.findall(PAGE.read_text(encoding="utf-8")))
    assert {tag: re.split(" for |; ", CURVES[tag].unit)[0] for tag in explained} == explained
    assert described("culture/od") == "optical density as measured. Unit: OD."
    assert described("eval/regret_pct/min").endswith(". Unit: %. Lowest agent.")
    assert described("eval/regret_pct/iqm").endswith("Mean of the middle half of the agents.")


def test_a_population_is_told_by_the_mean_of_its_middle_half_and_by_its_ends(tmp_path: Path) -> None:
    """Of 1, 2, 3, 6 and 100 one is cut at either end; a seed without a value counts for nothing."""
    writer = PopulationWriter(tmp_path, [9, 4, 7, 5, 6])
    writer.scalars(10, {"eval/regret_pct": np.array([100.0, 2.0, 1.0, 6.0, 3.0]), "train/epsilon": 0.25})
    writer.scalars(20, {"eval/regret_pct": np.array([np.nan, 2.0, 1.0, 6.0, 3.0])})
    writer.close()
    whole = EventAccumulator(str(tmp_path), size_guidance={"tensors": 0}).Reload()
    for end, values in (("iqm", (11.0 / 3.0, 2.5)), ("min", (1.0, 1.0)), ("max", (100.0, 6.0))):
        np.testing.assert_allclose(
            curve(whole, f"eval/regret_pct/{end}"), [[10.0, values[0]], [20.0, values[1]]], rtol=1e-6
        )
    assert curve(whole, "train/epsilon").tolist() == [[10.0, 0.25]]
    for seed, value in ((9, 100.0), (4, 2.0), (7, 1.0), (5, 6.0), (6, 3.0)):
        own = EventAccumulator(str(tmp_path / "agents" / f"seed000{seed}"), size_guidance={"tensors": 0}).Reload()
        assert curve(own, "eval/regret_pct")[0].tolist() == [10.0, value]


@pytest.mark.slow
def test_every_curve_and_figure_says_what_it_is_and_configuration_and_results_stand_as_text(runs: Path) -> None:
    for events in parts(runs):
        for tag in (*scalars(events), *scalars(events, "images")):
            assert events.SummaryMetadata(tag).summary_description == described(tag) != "", tag
    for name in RUNS:
        texts = {tag: e for e in parts(runs / name) for tag in e.Tags()["tensors"] if tag.startswith("run/")}
        assert set(texts) == {"run/config", "run/summary"}
        (point,) = texts["run/config"].Tensors("run/config")
        assert (runs / name / "config.yaml").read_text() in point.tensor_proto.string_val[0].decode()
    (events,) = parts(runs / "dqn")
    (image,) = events.Tensors("figures/closed_loop")
    width, height, png = image.tensor_proto.string_val
    assert (int(height), int(width)) == imread(io.BytesIO(png)).shape[:2]


@pytest.mark.slow
def test_charts_of_the_custom_page_show_curves_that_exist(runs: Path) -> None:
    """Learning with its limits; OD with the setpoint's band; share with its band."""
    for name, titles in (
        ("learning", ["Learning"]),
        ("population", ["Learning, several agents"]),
        ("dqn", PAGES),
        ("shares", [*PAGES, "Two species"]),
    ):
        *_, events = sorted(parts(runs / name), key=lambda e: custom.CONFIG_SUMMARY_TAG in e.Tags()["tensors"])
        tags = {tag for part in parts(runs / name) for tag in scalars(part)}
        (point,) = events.Tensors(custom.CONFIG_SUMMARY_TAG)
        layout = layout_pb2.Layout.FromString(point.tensor_proto.string_val[0])
        assert [c.title for c in layout.category] == titles
        charts = [chart for category in layout.category for chart in category.chart]
        for chart in charts:
            patterns = [t for t in chart.multiline.tag]
            patterns += [f"{t}$" for s in chart.margin.series for t in (s.value, s.lower, s.upper)]
            shown = [p for p in patterns if any(re.match(p, tag) for tag in tags)]
            assert shown, chart.title
            assert shown == patterns or "supervised" in str(patterns) or "target" in str(patterns), chart.title
        bands = [(s.value, s.lower, s.upper) for chart in charts for s in chart.margin.series]
        if name == "population":  # one limit for all agents, of whose own curves there is a range
            for tag in ("limit/regret_pct", "limit/steady_abs_error", "train/epsilon"):
                assert (tag,) * 3 in bands
            for tag in ("eval/regret_pct", "eval/steady_abs_error", "train/loss", "train/return", "q/min", "q/max"):
                assert (f"{tag}/iqm", f"{tag}/min", f"{tag}/max") in bands
        if name in ("dqn", "shares"):
            assert ("culture/setpoint", "culture/setpoint_low", "culture/setpoint_high") in bands
            assert ("culture/od",) * 3 in bands


@pytest.mark.slow
def test_hparams_has_a_row_for_each_policy_with_seed_model_and_results(runs: Path) -> None:
    rows = {}
    for events in parts(runs):
        if hparams.SESSION_START_INFO_TAG not in events.summary_metadata:
            continue
        content = {tag: events.SummaryMetadata(tag).plugin_data.content for tag in events.summary_metadata}
        start = hparams.parse_session_start_info_plugin_data(content[hparams.SESSION_START_INFO_TAG])
        columns = hparams.parse_experiment_plugin_data(content[hparams.EXPERIMENT_TAG])
        titles = [c.display_name for c in columns.hparam_infos]
        assert titles[: len(PARAMETERS)] == [c.title for c in PARAMETERS.values()]
        assert [c.name for c in columns.hparam_infos] == sorted(c.name for c in columns.hparam_infos)
        assert {m.name.tag: m.display_name for m in columns.metric_infos} == METRICS
        names = {c.name: c.display_name for c in columns.hparam_infos}
        given = {names[key]: v.string_value or v.number_value for key, v in start.hparams.items()}
        above, _, name = start.group_name.partition("/")
        assert above == runs.name  # job 0 of another sweep has a row of its own
        rows[name] = (given, events)
    assert set(rows) == {*RUNS, "population/seed0000", "population/seed0001"} - {"population"}
    given, _ = rows["pi"]
    assert (given["bench.period_s"], given["safety.ml_per_run"], given["scenario.minutes"]) == (120.0, 3.0, "[20]")
    assert {"bench.period_s=120", "safety.ml_per_run=3", "scenario.minutes=[20]"} <= set(given["given"].split())
    assert not {"controller", "backend.seed"} & given.keys()  # a preset has its own column; nobody gave the other here
    given, events = rows["learning"]
    summary = json.loads((runs / "learning" / "summary.json").read_text())
    assert (given["seed"], given["mu, 1/min"], given["tau"]) == (3.0, 0.03, pytest.approx(1 / 3))
    for key in ("regret_pct", "steady_abs_error"):
        assert curve(events, f"result/{key}")[-1, 1] == pytest.approx(summary[key][0])
    given, events = rows["dqn"]
    summary = json.loads((runs / "dqn" / "summary.json").read_text())
    assert (given["agent or controller"], given["seed"]) == ("dqn", 5.0)
    assert curve(events, "result/steady_abs_error")[-1, 1] == pytest.approx(summary["windows"][0]["steady_abs_error"])
    assert curve(events, "result/medium_ml")[-1, 1] == pytest.approx(summary["volume_ml"])


def test_what_a_sweep_varied_is_seen_beside_runs_of_other_words(tmp_path: Path) -> None:
    """TensorBoard takes its columns from one run: here those of a deployment, which was begun before the sweep."""
    words = {"deploy/1": [], "train/2/0": ["agent.learning_rate=0.01"], "train/2/1": ["agent.learning_rate=0.02"]}
    for name, overrides in words.items():
        folder = tmp_path / name
        (folder / ".hydra").mkdir(parents=True)
        (folder / ".hydra" / "overrides.yaml").write_text("".join(f"- {word}\n" for word in overrides))
        with closing(Events(folder)) as events:
            events.hyper_parameters({"decides": "dqn", "seed": 1.0}, folder)
            events.scalars({"result/ise": 0.1}, 0)
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(tmp_path)).Reload()
    board = TBContext(data_provider=MultiplexerDataProvider(multiplexer, str(tmp_path)), multiplexer=multiplexer)
    context, ask = Context(board), RequestContext()
    contents = context.hparams_metadata(ask, "")
    first = {name: contents[name] for name in sorted(contents)}
    experiment = context.experiment_from_metadata(ask, "", True, first, [])
    columns = {c.display_name: c.name for c in experiment.hparam_infos}
    assert "agent.learning_rate" not in columns
    told = [
        hparams.parse_session_start_info_plugin_data(content[hparams.SESSION_START_INFO_TAG]).hparams
        for content in first.values()
    ]
    seen = [row[columns["given"]].string_value if columns["given"] in row else "" for row in told]
    assert seen == ["", *(word for name in ("train/2/0", "train/2/1") for word in words[name])]
    assert {m.name.tag: m.display_name for m in experiment.metric_infos} == METRICS


def test_a_run_can_be_watched_while_it_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A point a minute is visible at once, without a word from whoever writes; a burst of them at its end."""
    now = [0.0]
    monkeypatch.setattr("experiments.reporting.tensorboard.time.monotonic", lambda: now[0])
    events = Events(tmp_path)
    for minute in range(3):
        now[0] += 60.0
        events.scalars({"culture/od": 0.5}, minute)
        (live,) = parts(tmp_path)
        assert curve(live, "culture/od")[:, 0].tolist() == list(range(minute + 1))
    events.close()


def test_a_resumed_training_keeps_what_is_older_than_its_checkpoint_and_that_of_its_own_step(tmp_path, monkeypatch):
    """Evaluated at steps 100, 200 and 300 and at 250 and 300 of its second life, which began at 200."""
    tag = "eval/regret_pct"
    for first, steps in ((0, (100, 200, 300)), (200, (250, 300))):
        monkeypatch.setattr("time.time", lambda began=first: 1e9 + began)  # files of events are read by their second
        writer = PopulationWriter(tmp_path, [4, 9], first)
        for step in steps:
            writer.scalars(step, {tag: np.array([1.0, 2.0]) * step + first, "train/epsilon": 0.5})
        writer.close()
    with open(tmp_path / "progress.csv", newline="", encoding="utf-8") as f:
        rows = [(int(row["step"]), row["seed"], float(row["value"])) for row in csv.DictReader(f)]
    curves = {100: (100.0, 200.0), 200: (200.0, 400.0), 250: (450.0, 700.0), 300: (500.0, 800.0)}
    assert rows == [
        line for k, each in curves.items() for line in ((k, "4", each[0]), (k, "9", each[1]), (k, "all", 0.5))
    ]
    for where, name, n in ((".", f"{tag}/max", 1), ("agents/seed0004", tag, 0), ("agents/seed0009", tag, 1)):
        events = shown.EventAccumulator(str(tmp_path / where)).Reload()
        assert curve(events, name).tolist() == [[k, each[n]] for k, each in curves.items()]


@pytest.mark.slow
def test_a_resumed_run_keeps_the_curves_of_all_reactors_where_one_stopped_early(runs, tmp_path, monkeypatch):
    """M1 has three rows, M0 those of the whole run; files of events are read by their second."""
    folder = tmp_path / "run"
    shutil.copytree(runs / "pi", folder)
    (folder / "journal.jsonl").unlink()  # or M1's rows were completed from it
    stopped = folder / "recordings" / "M1.csv"
    stopped.write_text("".join(stopped.read_text().splitlines(keepends=True)[:4]))
    later = time.time() + 10.0
    monkeypatch.setattr("time.time", lambda: later)
    Record(folder, ("M0", "M1"), fsync=False).close()
    events = shown.EventAccumulator(str(folder / "reactors" / "M0")).Reload()
    recorded = read_recording(folder / "recordings" / "M0.csv")
    assert recorded.od.size > 9
    assert curve(events, "culture/od")[:, 0].tolist() == recorded.time_min.tolist()
