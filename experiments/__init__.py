"""Commands, and the rooms they are put together from.

A file directly in this folder is a command, `python -m experiments.NAME`, and nobody imports it.
"""

from experiments.cli.start import begin

begin()
