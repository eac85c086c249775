"""Tables of results on the pages, from the files that commands leave: `python -m tests.studies.results`.

  python -m tests.studies.results --check            every table equals its file
  python -m tests.studies.results NAME=RUN           RUN/table.json becomes docs/results/NAME.json, and the pages follow
  python -m tests.studies.results NAME=RUN/week.json the same of another table of the run
  python -m tests.studies.results NAME=RUN/tables/X.csv  the same of a table of a report

A table stands between `<!-- result NAME -->` and `<!-- end -->`, or the page links to `results/NAME.json`. The file
holds columns and rows as they are shown, and command, commit and date of the run.
"""

import csv
import json
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.cli import files
from experiments.cli.files import given
from experiments.reporting.tables import markdown

__all__ = ["adopt", "differences", "leave", "main", "write", "write_csv"]

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"(<!-- result (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
LINK = re.compile(r"\(\.\./results/(\w+)\.json\)")


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Write a table as JSON, one row a line."""
    head = json.dumps({**content, "rows": []}, ensure_ascii=False).removesuffix("]}")
    lines = ",\n".join(json.dumps(row, ensure_ascii=False) for row in content["rows"])
    path.write_text(f"{head}\n{lines}\n]}}\n", encoding="utf-8")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows under the keys of the first one."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def leave(
    folder: Path, module: str, columns: Iterable[str], rows: Iterable[Iterable[object]], name: str = "table"
) -> None:
    """A table of a run: Markdown to read, and JSON with command, commit and date for a page.

    Args: folder: of the run. module: file of the command.
    """
    words = [word for word in given(folder) if not word.startswith("hydra.")]
    command = " ".join(["python -m", ".".join(Path(module).relative_to(ROOT).with_suffix("").parts), *words])
    newest = ["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(newest, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
    head, cells = [*columns], [[str(cell) for cell in row] for row in rows]
    origin = {"command": command, "commit": commit, "date": time.strftime("%Y-%m-%d")}
    files.write_json(folder / f"{name}.json", {**origin, "columns": head, "rows": cells})
    (folder / f"{name}.md").write_text(markdown(head, cells), encoding="utf-8")


def shown(stored: dict[str, Any]) -> str:
    """What stands on a page of a file: the table, and where it is from."""
    source = f"`{stored['command']}`, commit {stored['commit']}, {stored['date']}."
    return f"\n{markdown(stored['columns'], stored['rows'])}\n{source}\n\n"


def differences(docs: Path) -> list[str]:
    """What of pages and files does not agree, a line each."""
    stored = {path.stem: json.loads(path.read_text("utf-8")) for path in sorted((docs / "results").glob("*.json"))}
    found, used = [], set()
    for page in sorted(docs.rglob("*.md")):
        used.update(LINK.findall(page.read_text("utf-8")))
        for _, name, text, _ in BLOCK.findall(page.read_text("utf-8")):
            used.add(name)
            if name not in stored:
                found.append(f"{page.name}: result {name}: no file docs/results/{name}.json")
            elif text != shown(stored[name]):
                found.append(f"{page.name}: result {name}: the page is not what docs/results/{name}.json says")
    return found + [f"docs/results/{name}.json: on no page" for name in stored if name not in used]


def of_report(path: Path) -> dict[str, Any]:
    """A table of RUN/tables as a study would have left it; its commit is the newest one when the run began."""
    run = path.parents[1]
    (entry,) = re.findall(r"^    name: (.+)$", (run / ".hydra" / "hydra.yaml").read_text("utf-8"), re.MULTILINE)
    began = (run / ".hydra" / "config.yaml").stat().st_mtime
    newest = ["git", "-C", str(ROOT), "rev-list", "-1", "--abbrev-commit", f"--before={began:.0f}", "HEAD"]
    commit = subprocess.run(newest, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
    command = " ".join([f"python -m experiments.{entry}", *(word for word in given(run) if "hydra." not in word)])
    columns, *rows = csv.reader(path.read_text("utf-8").splitlines())
    date = time.strftime("%Y-%m-%d", time.gmtime(began))
    return {"command": command, "commit": commit, "date": date, "columns": columns, "rows": rows}


def adopt(docs: Path, name: str, run: Path) -> None:
    """The table of a run becomes the result of this name, on every page that shows it.

    Raises: OSError, ValueError or LookupError for a run that left no table.
    """
    path = run if run.suffix in (".json", ".csv") else run / "table.json"
    table = of_report(path) if path.suffix == ".csv" else json.loads(path.read_text("utf-8"))
    content = {key: table[key] for key in ("command", "commit", "date", "columns", "rows")}
    (docs / "results").mkdir(exist_ok=True)
    write(docs / "results" / f"{name}.json", content)
    for page in docs.rglob("*.md"):
        text = page.read_text("utf-8")
        new = BLOCK.sub(lambda m: m[1] + shown(content) + m[4] if m[2] == name else m[0], text)
        if new != text:
            page.write_text(new, encoding="utf-8")


def main(arguments: list[str], docs: Path = ROOT / "docs") -> int:
    """Entry point; returns the status: 1 where something differs or cannot be read."""
    wrong: list[str] = []
    for argument in (a for a in arguments if a != "--check"):
        name, given, run = argument.partition("=")
        if not given:
            print(__doc__)
            return 2
        try:
            adopt(docs, name, Path(run))
        except (OSError, ValueError, LookupError) as error:
            wrong.append(f"{argument}: no table.json of a study ({error})")
    wrong += differences(docs)
    print(
        "\n".join(wrong) if wrong else f"{len(list((docs / 'results').glob('*.json')))} results, all as the pages say"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
