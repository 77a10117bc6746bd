"""Balancing, trajectory optimisation, tracking, trees and transverse control."""
