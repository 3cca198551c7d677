"""Figures as PNG files; the only room that imports matplotlib.

Import a module of it only where a figure was asked for.  Figures are built without pyplot, so there
is no display, no backend and no global state.  Every function takes plain arrays, writes one file
and returns its path.
"""
