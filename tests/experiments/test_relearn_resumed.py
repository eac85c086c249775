"""A run that learns and is killed now and then knows of each reactor what one knows that was never interrupted."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.control.question import Verdict
from experiments.control.relearn import Relearning
from tests.experiments.test_relearn import QUICK, Flight


def known(learning: Relearning) -> dict[str, Any]:
    """When each reactor last learned and on what, how many trainings there were, who flies, and what they found."""
    told = [{key: row[key] for key in ("number", "reactor", "minute", "flies", "why")} for row in learning.learned]
    return {
        "last_min": learning._last_min.tolist(), "trained": learning._trained.tolist(), "newest": learning._last,
        "flown": learning._law.number.tolist(), "learned": told,
    }  # fmt: skip


@pytest.mark.parametrize("seed", [1])
def test_a_resumed_run_knows_what_an_uninterrupted_one_knows(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trainings of three reactors in any order, judged or failed or cut, and a kill behind each second of them."""
    rng = np.random.default_rng(seed)
    monkeypatch.setattr(Relearning, "_begin", lambda self, asked: None)  # no process: what it finds is said here
    flight, minute, expected = Flight(tmp_path / "run", QUICK, "backend.reactors=[M0,M1,M2]"), 0.0, None
    own, asked_s = np.zeros(3), []
    for _ in range(4):
        with flight.life() as (_, learning, _):
            assert expected is None or known(learning) == expected
            for _ in range(2):
                n, minute = int(rng.integers(3)), minute + float(rng.uniform(60.0, 300.0))
                errors = rng.uniform(-0.2, 0.2, 2)
                monkeypatch.setattr(learning, "_curves", lambda n, errors=errors: (errors, np.full(2, 0.01)))
                learning._ask(n, SimpleNamespace(minute=np.full(3, minute), elapsed=np.full(3, minute)))  # type: ignore[arg-type]
                own[n] = minute
                asked_s.append(minute)
                verdict = (None, Verdict({"old": [0.05] * 8, "new": [0.06] * 8}, 3.0))[int(rng.integers(2))]
                learning._judged(learning._last, f"M{n}", verdict, "by hand")
            assert learning._last_min.tolist() == own.tolist()
            expected = known(learning)
    assert len(set(own.tolist())) == 3
