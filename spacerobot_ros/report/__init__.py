"""Graphical report of a bag: one HTML file that works offline, created only from the bag."""

from spacerobot_ros.report.writing import write_figures, write_picture, write_report

__all__ = ["write_figures", "write_picture", "write_report"]
