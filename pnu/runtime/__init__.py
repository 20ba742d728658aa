"""How things run, not what they are: threads, worker processes, finished parts, progress."""
