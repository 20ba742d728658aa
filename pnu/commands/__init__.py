"""The verbs of the command line, one file each: `pnu VERB`, see `pnu.__main__`."""
