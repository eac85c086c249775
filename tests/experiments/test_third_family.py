"""A family of one's own, in one file: preflight, fit, dry run, stake, a run, and a resume after a kill in a dose."""

import csv
import importlib.util
import json
import sys
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conf import presets
from dqn import policy as policies
from experiments.cli import frame
from experiments.control import assemble
from experiments.control.timetable import timetable
from experiments.deploy import main
from hardware import family
from hardware.storage.journal import read_journal
from tests.evolver_stub import VIALS, EvolverStub
from tests.experiments import laws
from tests.programs import ROOT, Program, run

DRIVER = ROOT / "tests" / "evolver.py"
AWAY = "http://127.0.0.1:9"


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver's file is loaded, as by `extend=`, and forgotten afterwards."""
    monkeypatch.setattr(presets, "_added", dict(presets._added))
    monkeypatch.setattr(family, "_loaded", dict(family._loaded))
    spec = importlib.util.spec_from_file_location("evolver_of_the_tests", DRIVER)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)


@pytest.fixture
def device() -> Iterator[EvolverStub]:
    with EvolverStub() as stub:
        yield stub


def words(url: str, *more: str) -> list[str]:
    hold = ["scenario=hold", "scenario.setpoints=[0.5]", "scenario.minutes=[25]", "fsync=false"]
    return ["backend=evolver", f"backend.url={url}", "controller=pi", *hold, *more]


def looked_at(url: str, folder: Path) -> None:
    assemble.run_preflight(assemble.unpack(main.config(words(url, "preflight_only=true")), folder), folder)


def test_its_preflight_samples_every_vial_and_fails_where_a_pump_runs_on_or_the_server_is_away(
    known: None, device: EvolverStub, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level("INFO"):
        looked_at(device.url, tmp_path)
    said = [record.getMessage() for record in caplog.records]
    assert sum("pass  v" in line and " sample: OD 0." in line for line in said) == VIALS
    assert said.count("pass  v3 pumps: verified off") == 1
    assert not device.fed_ml.any()
    device.stuck = {3}
    away = rf"1 of 1 checks failed, the first: FAIL  reactors: no answer from {AWAY}/off .*check cable"
    for url, words in ((device.url, "FAIL  reactors: v3: pumps still on; switch them off by hand"), (AWAY, away)):
        with pytest.raises(frame.UserError, match=words):
            looked_at(url, tmp_path)


@pytest.mark.parametrize(
    ("given", "refusal"),
    [
        (["scenario.ratios=[0.5]", "scenario.temperatures=[33]"], "backend=evolver measures no fluorescence, by which"),
        (["scenario.outputs=['pump3 2 mL/h']"], "scenario.outputs: backend=evolver has no pump [34] to spare; drop it"),
        (["at_end=regulate"], "at_end = regulate: backend=evolver has no regulation of its own; allowed hold, stop"),
        (["controller=oracle"], "oracle: knows a simulated plant; allowed with backend=sim only, not backend=evolver"),
        (["backend.reactors=[a,b]"], "backend.reactors = .*: allowed 16 different names"),
        (["plant_file=twin.yaml"], "backend.kind = evolver: allowed sim with plant_file"),
    ],
)
def test_what_it_cannot_do_is_refused(known: None, tmp_path: Path, given: list[str], refusal: str) -> None:
    with pytest.raises(frame.UserError, match=refusal):
        assemble.unpack(assemble.completed(main.config(words(AWAY, *given))), tmp_path)
    assert not (tmp_path / "policy.npz").exists()


def test_a_culture_is_at_stake(known: None, tmp_path: Path) -> None:
    policies.save(tmp_path / "policy.npz", laws.law())
    poor = ["controller=dqn", f"policy={tmp_path / 'policy.npz'}"]
    with pytest.raises(frame.UserError, match="policy refused: .*force_policy=true runs it all the same"):
        assemble.unpack(main.config(words(AWAY, *poor)), tmp_path)
    assert assemble.unpack(main.config(words(AWAY, *poor, "force_policy=true")), tmp_path).policy is not None


def test_its_dry_run_says_where_it_is(known: None) -> None:
    text = timetable(main.config(words(AWAY)), "HERE", datetime(2026, 3, 2, 12, 0))
    assert f"backend evolver ({AWAY}), reactors v0, v1" in text
    assert text.count("bench.bottle_ml=2000 lasts") == VIALS


def fed(run: Path) -> np.ndarray[Any, Any]:
    """What the recordings say that each vial got, mL."""
    found = []
    for n in range(VIALS):
        with open(run / f"recordings/v{n}.csv", newline="", encoding="utf-8") as f:
            found.append(sum(float(row["volume_ml"]) for row in csv.DictReader(f)))
    return np.array(found)


def test_a_run_is_killed_in_a_dose_and_goes_on(device: EvolverStub, tmp_path: Path) -> None:
    """A dose that was given and not answered is counted once, none is given twice, and all sixteen are held."""
    device.hold_at = "15"
    given = "experiments.deploy", f"extend={DRIVER}", *words(device.url), "hydra.run.dir=here"
    with Program(*given, cwd=tmp_path, out=tmp_path / "out", WITHOUT_FIGURES="1") as first:
        assert device.held.wait(120.0), first.said()
    device.go.set()
    done = run("experiments.deploy", "resume=here", cwd=tmp_path, WITHOUT_FIGURES="1")
    assert done.returncode == 0, done.stderr + done.stdout
    summary = json.loads((tmp_path / "here/summary.json").read_text())
    assert summary["outcome"] == "completed"
    assert len(summary["reactors"]) == VIALS
    np.testing.assert_allclose(fed(tmp_path / "here"), device.fed_ml, rtol=1e-9)
    assert device.fed_ml.min() > 1.0
    intents = [row for row in read_journal(tmp_path / "here/journal.jsonl")[0] if row["kind"] == "intent"]
    assert len({(row["id"], row["reactor"]) for row in intents}) == len(intents)
    assert max(w["steady_abs_error"] for w in summary["windows"]) < 0.05
