"""Measurements, one small script each: `python -m bench` runs those of speed. Never part of the tests."""
