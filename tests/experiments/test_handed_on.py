"""What a command leaves for another one: numbers that every reader of JSON takes, curves with their pair, files."""

import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from envs.coculture.pair import named_pair
from envs.coculture.task import CocultureConfig
from experiments.cli import extensions, files, latest
from experiments.cli.calibrated import read_curves


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


def test_files_of_the_environment_and_of_the_command_line_are_both_loaded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_latest_is_the_file_that_was_written_last_or_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the folders are called; of `resume` and `runs` the folder, of the command itself."""
    monkeypatch.chdir(tmp_path)
    written = [
        "runs/calibrate/b/calibrated.yaml", "runs/calibrate/b/twin.yaml", "runs/demo/z/1_calibrate/calibrated.yaml",
        "runs/demo/a/1_calibrate/calibrated.yaml", "runs/calibrate/a/twin.yaml", "runs/train/c/checkpoint.pt",
        "runs/train/b/sweep.json", "runs/train/a/checkpoint.pt", "runs/deploy/y/state.json", "runs/deploy/x/state.json",
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
        ("policy=latest", "deploy"): "policy=latest",
        ("env_file=x.yaml", "train"): "env_file=x.yaml",
    }
    assert {(arg, command): latest.resolved(arg, command) for arg, command in told} == told
    with pytest.raises(ValueError, match=r"resume=latest: nothing under runs/; run python -m experiments\.benchmark"):
        latest.resolved("resume=latest", "benchmark")
