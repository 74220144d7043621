"""Simulators with exact physics, one a method."""
