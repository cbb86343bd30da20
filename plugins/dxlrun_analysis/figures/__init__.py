"""Figures by matplotlib, as SVG, for the pages of experiments."""
