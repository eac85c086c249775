"""Commands and their rooms.

A file directly in this folder is a command, `python -m experiments.NAME`, and is not imported.
"""

from experiments.cli.start import begin

begin()
