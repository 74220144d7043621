"""Figures, tables, units and drawings as data, numpy alone: methods declare them, reports render them.

A leaf: imports `alidade.factors.so3` and nothing of the other rooms.
"""
