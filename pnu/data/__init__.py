"""Training data: procedural shapes, patch files, data module."""
