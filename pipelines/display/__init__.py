"""Figures, tables, units and drawings as data: methods declare them, reports render them."""
