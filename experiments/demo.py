"""All steps in one command, `python -m experiments.demo`: calibrate, train, certify, deploy, report.

The demo prints each step as a user would type it, then runs it in a fork of this process. The fork has all libraries
loaded, which saves most of the start time of five programs.
"""

import argparse
import multiprocessing
import os
import signal
import sys
from importlib import import_module
from pathlib import Path

from experiments.cli import stop
from experiments.cli.sweep import fresh

FIRST = ("matplotlib.pyplot", "scipy.optimize", "experiments.calibrate")  # imports of the first command
OTHERS = (
    "torch.utils.tensorboard", "hardware.emulator.family",
    *(f"experiments.{name}" for name in ("train", "certify", "deploy", "report")),
)  # fmt: skip
PLAN = """\
The demo runs five commands, in about 15 s:
  1 calibrate   fit growth rate and pump to the recording that comes with the program
  2 train       train a DQN policy on the fitted model
  3 certify     prove bounds of the policy's closed loop
  4 deploy      run the policy on an emulated Chi.Bio, with the real driver, in virtual time
  5 report      show all results on one page
Output files: {folder}"""


def commands(folder: Path) -> list[list[str]]:
    """Return the steps: the name of each command and its overrides, each with its own folder below `folder`."""
    calibrated = folder / "1_calibrate" / "calibrated.yaml"
    policy = folder / "2_train" / "policy.npz"
    return [  # seed 3 meets the limits after 1,800 steps; other seeds need up to 10,000
        ["calibrate", f"hydra.run.dir={folder / '1_calibrate'}"],
        ["train", f"env_file={calibrated}", "stop_within=1", "seed=3", f"hydra.run.dir={folder / '2_train'}"],
        ["certify", f"policy={policy}", f"hydra.run.dir={folder / '3_certify'}"],
        [
            "deploy", "backend=emulator", "backend.speed=0", "backend.reactors=[M0]", "backend.plant=shipped",
            f"policy={policy}",
            f"hydra.run.dir={folder / '4_deploy'}",
        ],
        ["report", f"run={folder}", f"hydra.run.dir={folder / '5_report'}"],
    ]  # fmt: skip


def _run(arguments: list[str]) -> None:
    os.setsid()
    for number in stop.SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, stop.SIGNALS)
    name, *overrides = arguments
    sys.argv = [f"python -m experiments.{name}", *overrides]
    import_module(f"experiments.{name}").main()


def step(arguments: list[str], signals: list[int]) -> int:
    """Run one command to its end; return its exit status, or the status of a stopped command.

    The command has its own session, so that each signal reaches it once, through this process. Meanwhile this process
    loads the libraries of later commands.
    Args: signals: signals that this process has received; each is removed and passed on.
    """
    process, stopped = multiprocessing.get_context("fork").Process(target=_run, args=(arguments,)), False
    with stop.blocked(*stop.SIGNALS):
        process.start()
    for module in OTHERS:
        import_module(module)
    while process.is_alive():
        while signals:
            assert process.pid is not None
            os.kill(process.pid, signals.pop(0))
            stopped = True
        process.join(0.2)
    return stop.STATUS if stopped else process.exitcode or 0


def main() -> None:
    """Run all steps; exit with the status of the first step that fails."""
    parser = argparse.ArgumentParser(prog="python -m experiments.demo", description=__doc__)
    _, others = parser.parse_known_args()
    if others:
        text = f"error: {others[0]}: the demo accepts only --help; give values to calibrate, train and deploy"
        print(text, file=sys.stderr)
        sys.exit(1)
    folder = fresh("demo")
    print(PLAN.format(folder=folder), flush=True)
    signals: list[int] = []
    with stop.handled(lambda number, _: signals.append(number), *stop.SIGNALS):
        for module in FIRST:
            import_module(module)
        for name, *overrides in commands(folder):
            print("\n$ python -m", f"experiments.{name}", *overrides, flush=True)
            if status := step([name, *overrides], signals):
                sys.exit(status)
    print(
        f"\npolicy    {folder / '2_train' / 'policy.npz'}"
        f"\nfigures   {folder / '2_train' / 'figures'}, {folder / '4_deploy' / 'figures'}"
        f"\nreport    {folder / 'report.html'}"
        f"\ncurves    tensorboard --logdir {folder}"
    )


if __name__ == "__main__":
    main()
