"""Simulation in compiled code: one record, many side by side, sensitivities."""
