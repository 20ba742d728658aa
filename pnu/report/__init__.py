"""Plots, pages with tables and 3D views, and reports of sweeps and comparisons."""
