"""Measurements of speed, one small script each; `python -m bench` runs them all. Never part of the tests."""
