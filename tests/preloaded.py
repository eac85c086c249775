"""What commands import and read, once, by the process that `tests.programs` forks them from."""

from io import BytesIO

import httpcore  # noqa: F401
import PIL.PngImagePlugin  # noqa: F401
import scipy.optimize
import scipy.signal  # noqa: F401
from hydra.core.plugins import Plugins

import experiments.control.run
import experiments.control.timetable
import experiments.reporting.page
import experiments.training.run  # noqa: F401
import hardware.chibio.family
import hardware.pioreactor.family
import hardware.simulated  # noqa: F401
from experiments.cli import frame
from experiments.reporting import charts

Plugins.instance()
frame.compose("train", [])  # the parser of overrides fills its tables
charts.new_figure(1.0, 1.0)[0].savefig(BytesIO(), format="png")  # fonts
