"""Commands, one file each, and the packages that they use.

A file directly in this folder is a command, `python -m experiments.NAME`. No other module imports it.
"""

from experiments.cli.start import begin

begin()
