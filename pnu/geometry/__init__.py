"""Geometry: pure functions on arrays and tensors."""
