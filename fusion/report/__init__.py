"""One page for people: what was concluded, how sure it is, and how far from truth."""

from fusion.report.page import write_report as write_report
from fusion.report.plot import write_trajectory_plot as write_trajectory_plot
