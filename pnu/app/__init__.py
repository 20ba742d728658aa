"""Pages that this machine shows itself in a browser."""
