"""What a command leaves for another one: numbers that every reader of JSON takes, curves with their pair, files."""

import errno
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.coculture.pair import named_pair
from envs.coculture.task import SCALES, CocultureConfig
from experiments.cli import extensions, files, frame, latest, start
from experiments.cli.help_page import shown
from experiments.coculture.config import read_curves


def refused(constant: str) -> None:
    raise ValueError(f"{constant}: no JSON")


def test_numbers_that_are_not_finite_are_null_in_json(tmp_path: Path) -> None:
    inf, nan = math.inf, math.nan
    content: dict[str, Any] = {
        "alone": inf, "list": [1.0, -inf, nan], "tuple": (2.0, inf), "array": np.array([[0.5, inf], [nan, 3.0]]),
        "one": np.float64(-inf), "deep": {1: {"x": [{"y": inf}]}}, "whole": [1.0, 2.0], "text": "inf", "yes": True,
    }  # fmt: skip
    files.write_json(tmp_path / "summary.json", content, fsync=False)
    found = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refused)
    assert found == {
        "alone": None, "list": [1.0, None, None], "tuple": [2.0, None], "array": [[0.5, None], [None, 3.0]],
        "one": None, "deep": {"1": {"x": [{"y": None}]}}, "whole": [1.0, 2.0], "text": "inf", "yes": True,
    }  # fmt: skip


def left(run: Path, pair: str | None, **why: list[tuple[float, float]]) -> str:
    """A run whose reactors believed of both growth curves that they are off by so much, decision by decision."""
    run.mkdir()
    (run / "config.yaml").write_text("backend: {kind: sim}\n" + (f"pair: {pair}\n" if pair else ""))
    rows: list[dict[str, Any]] = [{"kind": "start"}]
    for reactor, believed in why.items():
        rows += [{"kind": "decision", "reactor": reactor, "why": {"bias_e": e, "bias_p": p}} for e, p in believed]
        rows.append({"kind": "decision", "reactor": reactor, "why": {}})
    lines = [json.dumps({"n": n, "wall": float(n), "mono": float(n), **row}) for n, row in enumerate(rows)]
    (run / "journal.jsonl").write_text("\n".join(lines) + "\n")
    return str(run)


@pytest.mark.parametrize("pair", ["ecoli_psyringae", "ecoli_pputida", None])
def test_curves_that_a_run_has_found_are_those_of_its_own_pair(pair: str | None, tmp_path: Path) -> None:
    given = CocultureConfig(control_min=20.0)
    for asked in (given, CocultureConfig(pair=named_pair("ecoli_psyringae"), control_min=20.0)):
        folder = left(tmp_path / f"run{asked.pair.second.name[-3:]}", pair, M0=[(0.3, 0.3), (-0.1, 0.05)])
        env = read_curves(folder, asked)
        assert env.pair == named_pair(pair or "ecoli_pputida")
        assert (env.scale_e, env.scale_p, env.control_min) == (pytest.approx(0.9), pytest.approx(1.05), 20.0)
    own = tmp_path / "own"
    left(own, pair, M0=[(0.1, 0.2)], M1=[(0.0, -0.1)])
    (own / "recordings").mkdir()
    env = read_curves(str(own / "recordings" / "M1.csv"), given)
    assert (env.scale_e, env.scale_p) == pytest.approx((1.0, 0.9))
    for path, word in ((own, "several reactors"), (own / "recordings" / "M7.csv", "env_file"), (tmp_path, "env_file")):
        with pytest.raises(frame.UserError, match=word):
            read_curves(str(path), given)


def test_curves_beyond_what_a_training_allows_are_taken_to_its_ends(tmp_path: Path) -> None:
    """E. coli at three times its curve, the other at a hundredth; before, both were believed to be right."""
    folder = left(tmp_path / "run", None, M0=[(0.0, 0.0), (2.0, -0.99)])
    env = read_curves(folder, CocultureConfig())
    assert (env.scale_e, env.scale_p) == (SCALES[1], SCALES[0])


def test_files_of_the_environment_and_of_the_command_line_are_both_loaded(tmp_path, monkeypatch):
    """Each once, first those that are known; a worker is told of all of them."""
    paths = [tmp_path / f"added_{name}_for_a_test.py" for name in ("first", "second", "third")]
    for path in paths:
        path.write_text("LOADED = True\n")
        monkeypatch.setitem(sys.modules, path.stem, None)  # so that it is gone afterwards
        del sys.modules[path.stem]
    monkeypatch.setattr(extensions, "_loaded", {})
    monkeypatch.setenv(extensions.VARIABLE, str(paths[0]))
    words = [f"extend={paths[1]},{paths[0]}", "controller=pi", f"extend={paths[2]}"]
    assert extensions.taken(words) == ["controller=pi"]
    assert os.environ[extensions.VARIABLE].split(os.pathsep) == [str(path) for path in paths]
    assert all(sys.modules[path.stem].LOADED for path in paths)
    extensions.keep(tmp_path)
    assert sorted(path.name for path in (tmp_path / "extensions").iterdir()) == sorted(path.name for path in paths)
    assert extensions.taken(["controller=pi"]) == ["controller=pi"]
    assert os.environ[extensions.VARIABLE].split(os.pathsep) == [str(path) for path in paths]


def test_latest_is_the_file_that_was_written_last_or_its_folder(tmp_path, monkeypatch):
    """Whatever the folders are called; of `resume` and `runs` the folder, of the command itself."""
    monkeypatch.chdir(tmp_path)
    written = [
        "runs/calibrate/b/calibrated.yaml", "runs/calibrate/b/twin.yaml", "runs/demo/z/1_calibrate/calibrated.yaml",
        "runs/demo/a/1_calibrate/calibrated.yaml", "runs/calibrate/a/twin.yaml", "runs/train/c/checkpoint.pt",
        "runs/train/b/sweep.json", "runs/train/a/checkpoint.pt", "runs/deploy/y/state.json", "runs/deploy/x/state.json",
        "runs/deploy/y/recordings", "runs/demo/a/4_deploy/recordings",
    ]  # fmt: skip
    for age, name in enumerate(written):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (1e9 + age, 1e9 + age))
    told = {
        ("env_file=latest", "train"): "env_file=runs/demo/a/1_calibrate/calibrated.yaml",
        ("+env_file=latest", "deploy"): "+env_file=runs/demo/a/1_calibrate/calibrated.yaml",
        ("plant_file=latest", "deploy"): "plant_file=runs/calibrate/a/twin.yaml",
        ("resume=latest", "train"): "resume=runs/train/a",
        ("resume=latest", "deploy"): "resume=runs/deploy/x",
        ("runs=latest", "report"): "runs=runs/train/b",
        ("run=latest", "report"): "run=latest",
        ("run=latest", "mark"): "run=runs/demo/a/4_deploy",
        ("policy=latest", "deploy"): "policy=latest",
        ("env_file=x.yaml", "train"): "env_file=x.yaml",
    }
    assert {(arg, command): latest.resolved(arg, command) for arg, command in told} == told
    with pytest.raises(ValueError, match=r"resume=latest: no such output .*python -m experiments\.benchmark"):
        latest.resolved("resume=latest", "benchmark")


def test_a_run_folder_tells_its_presets_and_the_words_it_was_started_with(tmp_path: Path) -> None:
    """Hydra's own groups and those without a preset are none; a word stands as it was typed, whatever it holds."""
    assert (files.choices(tmp_path), files.given(tmp_path)) == ({}, [])
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "hydra.yaml").write_text(
        "hydra:\n  runtime:\n    version: 1.3\n    choices:\n      composition: null\n      plant: bench\n"
        "      backend/transport: serial\n      hydra/launcher: slurm\n      scenario: day\n    cwd: /home\n"
        "  verbose: false\n"
    )
    chosen = {"plant": "bench", "backend/transport": "serial", "scenario": "day"}
    assert files.choices(tmp_path) == chosen
    words = ["plant=bench", "++each.M1.minutes=[90,30]", "+env=sim", "scenario.until=['od >= 0.8']"]
    (tmp_path / ".hydra" / "overrides.yaml").write_text("".join(f"- {word}\n" for word in words))
    assert files.given(tmp_path) == [word.lstrip("+") for word in words]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "null"), (True, "true"), (False, "false"), ("", "''"), ("sim", "sim"), (0, "0"), (0.02, "0.02"),
        (1e-05, "1e-05"), (1 / 3, "0.333333"), ((0.5, None, "x"), "[0.5,null,x]"), ({"a": (1, 2.5)}, "{a: [1,2.5]}"),
    ],
)  # fmt: skip
def test_a_value_is_shown_as_it_is_typed(value: Any, text: str) -> None:
    assert shown(value) == text


def test_what_a_disk_answers_is_told_with_its_remedy_however_it_is_wrapped() -> None:
    """Of a full disk another than of a folder that is somebody else's; what is none of both is shown whole."""
    free, place = "free disk space", "choose a folder that can be written, with hydra.run.dir=FOLDER"
    remedies = dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), free)
    remedies |= dict.fromkeys((errno.EACCES, errno.EROFS, errno.EEXIST), place)
    for number, remedy in remedies.items():
        error = OSError(number, os.strerror(number), "run/a.csv")
        said = f"run/a.csv: {os.strerror(number)}; {remedy}"
        assert frame._refusal(error) == said
        wrapped, then = RuntimeError("torch"), ValueError("logging")
        wrapped.__cause__, then.__context__ = error, wrapped
        assert frame._refusal(then) == said
    assert frame._refusal(OSError(errno.ENOSPC, "No space left")) == f"writing: No space left; {free}"
    assert frame._refusal(OSError(errno.ECONNREFUSED, "refused")) is None
    assert frame._refusal(ValueError("x")) is None


def test_what_a_run_leaves_is_named_with_the_command_that_goes_on(tmp_path: Path) -> None:
    """Its config, log, events and what was not written to its end are no results."""
    folder = tmp_path / "my run"
    for name in ("config.yaml", "deploy.log", "events.out.1", "x.csv.part", ".hydra", "reactors"):
        (folder / name).mkdir(parents=True)
    command = frame.EntryPoint("deploy", None, lambda config, folder: None, resumes="state.json")
    assert command._left(folder) == f"{folder} keeps no result; to try again, start a new run"
    (folder / "journal.jsonl").touch()
    (folder / "recordings").mkdir()
    assert command._left(folder) == f"{folder} keeps journal.jsonl, recordings/; to try again, start a new run"
    (folder / "state.json").touch()
    kept = f"{folder} keeps journal.jsonl, recordings/, state.json"
    assert command._left(folder) == f"{kept}; continue with: python -m experiments.deploy resume='{folder}'"


@pytest.mark.parametrize(
    ("words", "pumps"),
    [
        (["python", "-m", "experiments.deploy", "resume=x"], True), (["/a/turbidostat", "deploy", "+resume=x"], True),
        (["python", "/a/experiments/deploy.py", "resume=x"], True), (["turbidostat", "deploy", "scenario=hold"], False),
        (["turbidostat", "train", "resume=x"], False), (["python", "-m", "experiments.train", "resume=deploy"], False),
    ],
)  # fmt: skip
def test_a_stop_before_anything_began_says_whether_a_pump_may_run(words, pumps, monkeypatch):
    monkeypatch.setattr(sys, "orig_argv", words)
    assert start.stopped() == "stopped before the command started" + "; pumps not verified off: resume the run" * pumps
