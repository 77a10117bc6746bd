"""Experiments: excitation, the catalogue, rehearsal in simulation, fault injection."""
