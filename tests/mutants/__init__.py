"""Mutation testing: small faults are put into the code one at a time, and the tests must notice each of them.

    python -m tests.mutants                                       # all of the table, in some minutes
    python -m tests.mutants module=hardware/safety,dqn/agent.py   # some of it
    python -m tests.mutants sample=200 seed=1                     # a sample of it
    python -m tests.mutants again=runs/mutants.json               # what survived then

For each row of the table one process imports everything and collects the tests. A fork of it runs them once and notes
which test runs which line, and how long it takes. Then each mutant gets a fork of its own, in which the code object of
the changed function is exchanged and only the tests that run the changed line are run, the fastest first, until one
fails or some seconds of tests have passed: what only the longest tests notice counts as not noticed. A fork costs some
hundredths of a second where a fresh interpreter would take seconds to import torch. Code that runs at import
(constants, config fields, default arguments) cannot be exchanged; for it a fork of the bare process imports the mutated
module in place of the real one.

`operators` makes the mutants, `server` tries them, `__main__` holds the table and prints and stores the scores.
"""
