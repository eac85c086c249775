"""The paper's Table 2 against its numbers typed by hand, and the sides of every table that shows it."""

import numpy as np

from experiments.comparison import page
from experiments.comparison.config import SETTLING_MIN, TABLE_2

CONTROLLERS = ("dqn", "pi", "mpc")
ISE = {
    ("setpoint_steps", "0.8"): (0.039, 0.046, 0.035),
    ("setpoint_steps", "0.65"): (0.032, 0.039, 0.092),
    ("setpoint_steps", "0.5"): (0.051, 0.111, 0.117),
    ("temperature_switch", "37"): (0.045, 0.033, 0.032),
    ("temperature_switch", "30"): (0.031, 0.025, 0.042),
}
ITAE = {
    ("setpoint_steps", "0.8"): (12.21, 12.38, 10.44),
    ("setpoint_steps", "0.65"): (11.90, 10.50, 9.38),
    ("setpoint_steps", "0.5"): (7.43, 11.49, 12.98),
    ("temperature_switch", "37"): (12.42, 9.65, 11.60),
    ("temperature_switch", "30"): (11.84, 9.12, 11.54),
}


def ours(factor: float) -> list[dict[str, object]]:
    """Rows of a run whose every value is the paper's times `factor`."""
    return [
        {
            "controller": c, "plant": "nominal_noise", "scenario": scenario, "window": window, "n": 3,
            "ise_mean": factor * ISE[scenario, window][k], "ise_sd": 0.0, "ise_ci95": [np.nan, np.nan],
            "itae_mean": factor * ITAE[scenario, window][k], "itae_sd": 0.0, "itae_ci95": [np.nan, np.nan],
        }
        for scenario, window in ISE
        for k, c in enumerate(CONTROLLERS)
    ]  # fmt: skip


def test_every_published_value_is_the_papers():
    found = {(p.scenario, p.window, p.controller): (p.ise, p.itae) for p in TABLE_2}
    assert found == {(*cell, c): (ISE[cell][k], ITAE[cell][k]) for cell in ISE for k, c in enumerate(CONTROLLERS)}
    setpoints = {"0.8": 0.8, "0.65": 0.65, "0.5": 0.5, "37": 0.5, "30": 0.5}
    assert all(p.setpoint == setpoints[p.window] for p in TABLE_2)
    assert SETTLING_MIN == 10.0


def test_published_stands_left_and_ours_right():
    table = page.table_2(ours(2.0), "ise")
    assert table.columns == (
        "window", "dqn, published", "pi, published", "mpc, published", "dqn, here", "pi, here", "mpc, here",
        "lowest published", "lowest of the three here",
    )  # fmt: skip
    assert [str(cell) for cell in table.rows[1]] == [
        "OD 0.65", "0.032", "0.039", "0.092", "0.064", "0.078", "0.184", "dqn", "dqn",
    ]  # fmt: skip
    itae = page.table_2(ours(2.0), "itae")
    assert [str(cell) for cell in itae.rows[3]] == [
        "37 °C", "12.42", "9.65", "11.6", "24.8", "19.3", "23.2", "pi", "pi",
    ]  # fmt: skip


def test_cell_by_cell_says_whose_is_lower():
    lower = page.cell_by_cell(ours(0.5))
    assert [str(cell) for cell in lower.rows[0]] == [
        "OD 0.8, dqn", "0.039 (0.0013)", "0.0195 (0.00065)", "here", "12.21 (0.407)", "6.11 (0.204)", "here",
    ]  # fmt: skip
    assert {row[3] for row in page.cell_by_cell(ours(2.0)).rows} == {"published"}
