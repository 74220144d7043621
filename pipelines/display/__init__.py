"""Figures, tables, units and drawings as data, numpy alone: methods declare them, reports render them."""
