"""Training: what Lightning runs, its callbacks, run folders that go on, sweeps and searches."""
