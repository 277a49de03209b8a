"""Graphical report of a bag: one HTML file that works offline, created from the bag alone."""

from spacerobot_ros.report.writing import write_figures, write_picture, write_report

__all__ = ["write_figures", "write_picture", "write_report"]
