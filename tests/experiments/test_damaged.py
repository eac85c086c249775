"""A run folder that was damaged: every file a resume reads ends in one line with file, reason and remedy."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dqn import policy
from envs.scenario import Scenario
from experiments.cli import frame
from experiments.cli.frame import UserError, save_config
from experiments.control.config import DeployConfig
from experiments.control.policies import load_policy
from experiments.record.record import Record
from hardware.emulator.process import EmulatorProcess
from hardware.errors import RecordingError
from tests import programs
from tests.campaigns.rehearsal import Rehearsal, rehearsed
from tests.experiments.test_deploy import inverse_policy
from tests.programs import Program

Change = Callable[[Any], object]
HOLD = Scenario((0.4,), (600.0,), (37.0,))


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Rehearsal:
    """A run that was killed after ten minutes."""
    run = Rehearsal(tmp_path_factory.mktemp("run"), rehearsed(("M0",), HOLD))
    run.begin()
    list(run.run(600.0))
    run.close()
    return run


@pytest.fixture
def run(interrupted: Rehearsal, tmp_path: Path) -> Iterator[Rehearsal]:
    """The same, to be damaged and resumed."""
    shutil.copytree(interrupted.folder, tmp_path, dirs_exist_ok=True)
    whole, interrupted.folder = interrupted.folder, tmp_path
    yield interrupted
    interrupted.folder = whole


def refused(run: Rehearsal, *said: str) -> None:
    """Resuming is refused in one line, and what was recorded stays."""
    files = [run.folder / "journal.jsonl", run.folder / "recordings" / "M0.csv"]
    before = [path.read_bytes() for path in files]
    with pytest.raises(RecordingError) as caught:
        run.begin()
    assert "\n" not in str(caught.value)
    for words in said:
        assert words in str(caught.value)
    for path, content in zip(files, before, strict=True):
        assert path.read_bytes().startswith(content)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[]", "the file has [], expected keys and values"),
        (lambda s: s.pop("journal_row"), "journal_row: missing, expected the number of a row"),
        (lambda s: s.update(journal_row=True), "journal_row: True, expected"),
        (lambda s: s.update(began=5), "loop.began has shape (), this run needs (1,)"),
        (lambda s: s.update(stopped=[False] * 2), "loop.stopped has shape (2,), this run needs (1,)"),
        (lambda s: s.update(interlock=[1]), "interlock: [1]"),
        (lambda s: s["interlock"].pop("fed_ml"), "interlock: its saved state has other fields: fed_ml"),
        (lambda s: s["interlock"].update(fed_ml=["x"]), "interlock.fed_ml: ['x'], expected numbers"),
        (lambda s: s.pop("controller"), "controller: missing, expected keys and values"),
        (lambda s: s.update(controller="warm"), "controller: warm, expected keys and values"),
        (lambda s: s["controller"].update(estimator=[1]), "controller.estimator.mean: missing"),
    ],
)
def test_a_state_that_was_damaged(run: Rehearsal, change: str | Change, why: str) -> None:
    path = run.folder / "state.json"
    if isinstance(change, str):
        path.write_text(change)
    else:
        state = json.loads(path.read_text())
        change(state)
        path.write_text(json.dumps(state))
    refused(run, f"{path}: no state to resume from ({why}", "restore the file as the run wrote it, or start a new run")


@pytest.mark.parametrize(
    ("kind", "change", "why"),
    [
        ("sample", lambda r: r.pop("kind"), "a row without a usable kind"),
        ("intent", lambda r: r.update(sample=None), "(intent) is damaged (TypeError"),
        ("intent", lambda r: r.pop("feed_ml"), "is damaged (KeyError: 'feed_ml')"),
        ("intent", lambda r: r.pop("reactor"), "(intent) is damaged (KeyError: 'reactor')"),
        ("decision", lambda r: r.pop("row"), "a row of M0 is damaged (KeyError: 'row')"),
        ("decision", lambda r: r["row"].pop("od"), "a row of M0 is damaged (KeyError: 'od')"),
        ("device", lambda r: r.update(blank="clear"), "(device) is damaged (ValueError"),
        ("device", lambda r: r.update(blank=[1]), "(device) is damaged (TypeError"),
    ],
)
def test_a_journal_row_that_was_damaged(run: Rehearsal, kind: str, change: Change, why: str) -> None:
    path = run.folder / "journal.jsonl"
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    change(next(row for row in rows if row["kind"] == kind))
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    refused(run, "journal", why, "restore what the run wrote, or start a new run")


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda rows: [b"a,b\n", *rows[1:]], "has the header 'a,b'"),
        (lambda rows: [b"\0\xff\xfe" * 50], "exists and is not a recording"),
        (lambda rows: [rows[0], b"\xff\xfe,1\n"], "damaged near line 1"),
        (lambda rows: [*rows[:2], b"x" * 50 + b"\n"], "damaged near line 3"),
        (lambda rows: [*rows[:2], rows[2].replace(b",0,", b",high,", 1)], "damaged near line 3"),
        (lambda rows: [*rows[:3], b"7.5,2\n"], "damaged near line 4 (a row has no time, or not one cell"),
        (lambda rows: [*rows[:3], b"," + rows[3].split(b",", 1)[1]], "damaged near line 4"),
        (lambda rows: [*rows[:3], b'"' + rows[3]], "damaged near line 4"),
    ],
)
def test_a_recording_that_was_damaged_is_written_anew(run: Rehearsal, change: Change, why: str) -> None:
    path = run.folder / "recordings" / "M0.csv"
    whole = path.read_bytes()
    rows = change(whole.splitlines(keepends=True))
    assert isinstance(rows, list)
    path.write_bytes(b"".join(rows))
    refused(
        run,
        f"{path}: {why}",
        "move the file away and resume the run, which writes it again from the last 20 MB of the journal",
    )
    path.rename(run.folder / "M0_damaged.csv")
    Record(run.folder, ("M0",), fsync=False).close()
    assert path.read_bytes() == whole


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "key backend is missing"),
        (b"[1]\n", "the file has no keys and values"),
        (b"a: [", "in line 1"),
        (b"a: *x\n", "an alias or interpolation in line 1"),
        (b"\xff\xfe\0\1", "no UTF-8 text"),
        (b"backend:\n  kind: [1]\ncontroller:\n  kind: pi\n", "backend.kind = [1]: allowed sim, chibio, emulator"),
        (b"backend:\n  kind: sim\ncontroller:\n  kind: x\n", "controller.kind = x: allowed dqn, pi, pi_tuned, mpc"),
        (b"backend:\n  kind: sim\ncontroller:\n  kind: pi\nfsync: ${nowhere}\n", "an alias or interpolation in line 5"),
        (b"backend: {kind: chibio, speed: fast}\ncontroller: {kind: pi}\n", "backend.speed = fast: allowed a number"),
    ],
)
def test_a_config_that_was_damaged(tmp_path: Path, content: bytes, why: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_bytes(content)
    with pytest.raises(UserError) as caught:
        frame._stored(path, "RUN", DeployConfig())
    assert f"{path}: not the config of this run (" in str(caught.value)
    assert why in str(caught.value)
    assert str(caught.value).endswith("restore the file as the run wrote it, or start a new run")
    assert "\n" not in str(caught.value)


def test_a_config_comes_back_as_it_was_stored(tmp_path: Path) -> None:
    config = DeployConfig(policy="here.npz")
    save_config(config, tmp_path)
    loaded = frame._stored(tmp_path / "config.yaml", "RUN", DeployConfig())
    assert (loaded.policy, loaded.resume) == ("here.npz", "RUN")


@pytest.mark.parametrize("metadata", [{"control_min": "one"}, {"control_min": None}, {"regret_pct": [1]}])
def test_a_policy_whose_metadata_were_damaged(tmp_path: Path, metadata: dict[str, Any]) -> None:
    whole = inverse_policy()
    whole.metadata.update(metadata)
    policy.save(tmp_path / "policy.npz", whole)
    with pytest.raises(UserError, match=r"policy\.npz: damaged \(.*\); give the policy\.npz of a training run"):
        load_policy(str(tmp_path / "policy.npz"), 1.0, 0.02)


@pytest.mark.slow
def test_a_user_who_resumes_reads_one_line(tmp_path: Path) -> None:
    """The same through the entry point: what goes wrong before and after the reactors are opened."""

    folder = tmp_path / "run"
    with EmulatorProcess(["--reactors", "M0", "--speed", "60", "--od", "0.5"]) as device:
        backend = "backend=chibio", f"backend.url={device.url}", "backend.speed=60", "backend.reactors=[M0]"
        patient = "backend.transport.floor_s=10"  # a busy machine may answer late
        words = *backend, patient, "controller=pi", "hydra.run.dir=run"
        with Program("experiments.deploy", *words, cwd=tmp_path, out=tmp_path / "out") as first:
            first.until((folder / "state.json").exists)
        for name, content in (
            ("state.json", b'{"began": [null]}'),
            ("recordings/M0.csv", b"time_min,od\n1,2\n"),
            ("journal.jsonl", b""),
            ("config.yaml", b"- 1\n"),
        ):
            whole = (folder / name).read_bytes()
            (folder / name).write_bytes(content)
            done = programs.run("experiments.deploy", "resume=run", cwd=tmp_path)
            said = [line for line in done.stderr.strip().splitlines() if not line[:2].isdigit()]
            assert (done.returncode, len(said)) == (1, 1), done.stderr
            assert Path(name).name in said[0]
            (folder / name).write_bytes(whole)
