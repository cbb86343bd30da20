"""Static figures for the pages of experiments, drawn by matplotlib as SVG.

Interactive plots of a run's report are in `page`.
"""
