"""What stands on the pages is what the files of the commands say, and a page that was changed by hand is found."""

import json
from pathlib import Path

import pytest

from tests.studies import results


def test_every_table_of_the_pages_equals_its_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert results.main(["--check"]) == 0, capsys.readouterr().out


def test_a_run_s_table_comes_to_its_place_and_what_differs_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    docs, run = tmp_path / "docs", tmp_path / "run"
    (docs / "records").mkdir(parents=True)
    run.mkdir()
    page = (docs / "records" / "one").with_suffix(".md")
    page.write_text("# A\n\n<!-- result one -->\nold\n<!-- end -->\n\n<!-- result two -->\nkept<!-- end -->\nrest\n")
    results.leave(run, results.__file__, ("law", "error"), (("pi", 0.25), ("mpc", 0.5)))
    assert (run / "table.md").read_text() == "| law | error |\n|---|---|\n| pi | 0.25 |\n| mpc | 0.5 |\n"
    assert results.main([f"one={run}"], docs) == 1  # two has no file
    assert capsys.readouterr().out == f"{page.name}: result two: no file docs/results/two.json\n"
    text = page.read_text()
    assert "| law | error |\n|---|---|\n| pi | 0.25 |\n| mpc | 0.5 |\n" in text
    left = json.loads((run / "table.json").read_text())
    assert f"`python -m tests.studies.results`, commit {left['commit']}, {left['date']}." in text
    assert text.endswith("<!-- result two -->\nkept<!-- end -->\nrest\n")
    page.write_text(text.replace("| 0.25 |", "| 0.24 |").partition("<!-- result two")[0])
    assert results.differences(docs) == [f"{page.name}: result one: the page is not what docs/results/one.json says"]
    page.write_text("# A\n")
    assert results.differences(docs) == ["docs/results/one.json: on no page"]
    page.write_text("[rows](../results/one.json)\n")
    assert not results.differences(docs)
    other = run / "week.json"
    other.write_text(json.dumps(left | {"rows": [["day", "1"]]}))
    page.write_text("# A\n<!-- result one -->\n<!-- end -->\n")
    assert results.main([f"one={other}"], docs) == 0
    assert "| day | 1 |" in page.read_text()
    report = run / "tables" / "ise.csv"
    report.parent.mkdir()
    report.write_text('law,"error, OD"\npi,0.25 ± 0.1\n')
    (run / ".hydra").mkdir()
    (run / ".hydra" / "overrides.yaml").write_text("- experiment=paper\n- ++replicates=7\n- hydra.run.dir=x\n")
    (run / ".hydra" / "hydra.yaml").write_text("hydra:\n  job:\n    name: benchmark\n")
    (run / ".hydra" / "config.yaml").write_text("{}\n")
    assert results.main([f"one={report}"], docs) == 0
    stood = page.read_text()
    assert "| law | error, OD |\n|---|---|\n| pi | 0.25 ± 0.1 |\n" in stood
    newest = left["commit"][:7]
    assert f"`python -m experiments.benchmark experiment=paper replicates=7`, commit {newest}" in stood
    assert results.main([f"two={docs}"], docs) == 1
    assert "no table.json of a study" in capsys.readouterr().out
