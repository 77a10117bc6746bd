"""The report: one self-contained page from the facts of a diagnosis and its curves."""

from cg_sysid.report.page import render, write_report

__all__ = ['render', 'write_report']
