"""Measurements, one small script each: `python -m bench` runs those of speed. Never part of the tests."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # as the commands of pnu set it, before torch is there
